"""Change a capture's world frame: its up direction, its origin, and its unit of length.

Each change is a `Similarity` new_from_old, which can be inverted and saved (`Similarity.to_json`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import centres_of, focus_point, horizontal_axes, up_direction
from nerfcli.cameras.rigid import Similarity
from nerfcli.captures.capture import Capture
from nerfcli.errors import UserError

WORLD_AXES = {f"{sign}{'xyz'[i]}": float(f"{sign}1") * np.eye(3)[i] for sign in ("", "-") for i in range(3)}
ORIGINS = ("centre-of-cameras", "focus")


def transformed(capture: Capture, new_from_world: Similarity) -> Capture:
    """Return the same capture in another world frame.

    Poses and points are mapped, and depths along the cameras' axes are scaled. Pictures, observations and cameras do
    not change, since a similarity preserves angles. The unit is kept if the scale is 1, else it becomes "arbitrary".
    """
    poses = new_from_world.apply_pose(np.stack([frame.world_from_cam for frame in capture.frames] or [np.eye(4)]))
    bounds = capture.depth_bounds
    return replace(
        capture,
        # Not strict: for a capture without frames there is one pose too many.
        frames=tuple(replace(f, world_from_cam=pose) for f, pose in zip(capture.frames, poses, strict=False)),
        points=new_from_world.apply(capture.points),
        depth_bounds=None if bounds is None else new_from_world.scale * bounds,
        unit=capture.unit if new_from_world.scale == 1 else "arbitrary",
        unit_source=capture.unit_source if new_from_world.scale == 1 else None,
    )


def up_aligned(frames: Sequence[Frame], axis: str, *, up: np.ndarray | None = None) -> Similarity:
    """Return the smallest rotation about the origin that turns the up direction onto an axis of the new frame.

    Args:
        frames: give the up direction through `up_direction`, unless `up` is given.
        axis: x, y, z, -x, -y or -z.
        up: (3,) of any length, if it is known better (such as from gravity).

    Raises:
        UserError: an unknown axis, an `up` of length 0, or neither frames nor `up`.
    """
    if axis not in WORLD_AXES:
        raise UserError(
            f"unknown axis {axis!r} for the up direction", f"choose one of {', '.join(WORLD_AXES)}", exit_code=2
        )
    if up is None:
        if not frames:
            raise UserError("the capture has no cameras to estimate the up direction from", "give the up direction")
        up = up_direction(frames)
    length = float(np.linalg.norm(up))
    if not (np.isfinite(length) and length > 0):
        raise UserError(f"{up} is not a direction", "expected three finite numbers, not all 0")
    return Similarity(1.0, smallest_rotation(np.asarray(up, dtype=np.float64) / length, WORLD_AXES[axis]), np.zeros(3))


def moved_to_origin(frames: Sequence[Frame], origin: str, *, depth_hint: float | None = None) -> Similarity:
    """Return the translation that moves a place of the old frame to the origin of the new one.

    Args:
        origin: centre-of-cameras: the mean of their centres; focus: the point that they look at; or the coordinates
            "x,y,z" of the place in the old frame.
        depth_hint: the distance to the focus in scene units, for cameras with parallel axes.

    Raises:
        UserError: an unknown place, or no cameras to compute it from.
    """
    if origin not in ORIGINS:
        return Similarity(1.0, np.eye(3), -point_of(origin, f"choose {', '.join(ORIGINS)}, or x,y,z"))
    if not frames:
        raise UserError(f"the capture has no cameras to compute the {origin} from", "give the origin as x,y,z")
    place = centres_of(frames).mean(axis=0) if origin == ORIGINS[0] else focus_point(frames, depth_hint=depth_hint)
    return Similarity(1.0, np.eye(3), -place)


def point_of(text: str, hint: str) -> np.ndarray:
    """Parse a point (3,) from "x,y,z".

    Raises:
        UserError: the text is not a point; `hint` says what is expected.
    """
    try:
        point = np.array([float(part) for part in text.split(",")])
    except ValueError as error:
        raise UserError(f"{text!r} is not a point", hint, exit_code=2) from error
    if point.shape != (3,) or not np.isfinite(point).all():
        raise UserError(f"{text!r} is not a point of three finite numbers", hint, exit_code=2)
    return point


def smallest_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) by the smallest angle that turns unit vector a into unit vector b; exact at any angle.

    It is the product of two half turns, about a and then about the bisector w: (2 w w^T - 1)(2 a a^T - 1). If a and b
    are nearly opposite, w is lost to rounding, so the rotation is composed of two, through a vector between them.
    """
    if a @ b < -0.5:
        between = b - (b @ a) * a
        if np.linalg.norm(between) < 1e-8:  # opposite: all ways around are equally short
            between = horizontal_axes(a)[0]
        between = between / np.linalg.norm(between)
        return smallest_rotation(between, b) @ smallest_rotation(a, between)
    w = (a + b) / np.linalg.norm(a + b)
    return (2 * np.outer(w, w) - np.eye(3)) @ (2 * np.outer(a, a) - np.eye(3))
