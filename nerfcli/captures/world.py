"""Change a capture's world frame: its up direction, its origin, and its unit of length.

Each change is a `Similarity` new_from_old, which can be inverted and saved (`Similarity.to_json`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import centres_of, focus_point, horizontal_axes, up_direction
from nerfcli.cameras.rigid import Similarity
from nerfcli.captures.axes import poses_of
from nerfcli.captures.boards import CharucoBoard, scale_from_charuco, scale_from_markers
from nerfcli.captures.capture import Capture
from nerfcli.captures.orientation import UPRIGHT, in_pixels, upright
from nerfcli.captures.scale import (
    ScaleEstimate,
    gps_positions,
    known_distance,
    point_of,
    scale_from_distances,
    scale_from_gps,
)
from nerfcli.errors import UserError

WORLD_AXES = {f"{sign}{'xyz'[i]}": float(f"{sign}1") * np.eye(3)[i] for sign in ("", "-") for i in range(3)}
ORIGINS = ("centre-of-cameras", "focus")


def transformed(capture: Capture, new_from_world: Similarity) -> Capture:
    """Return the same capture in another world frame.

    Poses and points are mapped, and depths along the cameras' axes are scaled. Pictures, observations and cameras do
    not change, since a similarity preserves angles. The unit is kept if the scale is 1, else it becomes "arbitrary".
    """
    poses, bounds = new_from_world.apply_pose(poses_of(capture)), capture.depth_bounds
    return replace(
        capture,
        frames=tuple(replace(f, world_from_cam=pose) for f, pose in zip(capture.frames, poses, strict=True)),
        points=new_from_world.apply(capture.points),
        depth_bounds=None if bounds is None else new_from_world.scale * bounds,
        unit=capture.unit if new_from_world.scale == 1 else "arbitrary",
        unit_source=capture.unit_source if new_from_world.scale == 1 else None,
    )


def up_aligned(frames: Sequence[Frame], axis: str) -> Similarity:
    """Return the smallest rotation about the origin that turns the up direction onto an axis of the new frame."""
    if axis not in WORLD_AXES:
        hint = f"choose one of {', '.join(WORLD_AXES)}"
        raise UserError(f"unknown axis {axis!r} for the up direction", hint, exit_code=2)
    return Similarity(1.0, smallest_rotation(up_direction(frames), WORLD_AXES[axis]), np.zeros(3))


def moved_to_origin(frames: Sequence[Frame], origin: str) -> Similarity:
    """Return the translation that moves a place of the old frame to the origin of the new one.

    Args:
        origin: centre-of-cameras: the mean of their centres; focus: the point that they look at; or the coordinates
            "x,y,z" of the place in the old frame.
    """
    if origin not in ORIGINS:
        return Similarity(1.0, np.eye(3), -point_of(origin, f"choose {', '.join(ORIGINS)}, or x,y,z"))
    place = centres_of(frames).mean(axis=0) if origin == ORIGINS[0] else focus_point(frames)
    return Similarity(1.0, np.eye(3), -place)


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


GPS = "gps"
# Beyond this factor or its inverse, squares of lengths of ordinary scenes come near the ends of float32.
SMALLEST_SCALE = 1e-9


@dataclass(frozen=True)
class WorldFrame:
    """The requested world frame of a capture; None leaves a property unchanged.

    Args:
        up: the axis that points up: x, y, z, -x, -y or -z.
        origin: centre-of-cameras, focus, or a point "x,y,z" in the old frame.
        scale: a factor for all lengths, or "gps" for metres from the positions in the photos' EXIF.
        markers: ArUco markers in the photos, "DICTIONARY:SIDE", or a ChArUco board,
            "DICTIONARY:COLUMNSxROWS:SQUARE:MARKER", with sides in metres: lengths become metres. Append ":legacy" for
            boards with an even number of rows that were made with OpenCV before 4.6.
        distances: known distances, "A B METRES", between images by name or points x,y,z: lengths become metres.
    """

    up: str | None = None
    origin: str | None = None
    scale: str | None = None
    markers: str | None = None
    distances: Sequence[str] = ()


@dataclass(frozen=True)
class Moved:
    """A capture in another world frame."""

    capture: Capture
    new_from_old: Similarity
    scale: ScaleEstimate | None = None


def in_world_frame(capture: Capture, wanted: WorldFrame) -> Moved:
    """Move a capture to another world frame: first the origin, then the up axis, then the scale about that origin."""
    given = {"--scale": wanted.scale, "--markers": wanted.markers, "--distance": wanted.distances or None}
    if len(named := [name for name, value in given.items() if value is not None]) > 1:
        raise UserError(f"{' and '.join(named)} cannot be combined", "give only one of them", exit_code=2)
    estimate = _estimate(capture, wanted)
    change = Similarity.identity()
    if wanted.origin is not None:
        change = moved_to_origin(capture.frames, wanted.origin)
    if wanted.up is not None:
        # Stored pixels of portrait photos lie on their side.
        change = up_aligned(in_pixels(capture, UPRIGHT).capture.frames, wanted.up).compose(change)
    factor = _factor(wanted.scale) if estimate is None else estimate.metres_per_unit
    if factor != 1:
        change = Similarity(factor, np.eye(3), np.zeros(3)).compose(change)
    moved = transformed(capture, change)
    if estimate is not None:
        moved = replace(moved, unit="metre", unit_source=_source(estimate))
    return Moved(moved, change, estimate)


def _source(estimate: ScaleEstimate) -> str:
    """Describe how the scale in metres was determined, with its relative error."""
    relative = None if estimate.standard_error is None else estimate.standard_error / estimate.metres_per_unit
    return estimate.source if relative is None else f"{estimate.source}, ± {100 * relative:.2g} %"


def _estimate(capture: Capture, wanted: WorldFrame) -> ScaleEstimate | None:
    if wanted.distances:
        return scale_from_distances([known_distance(text, capture.frames) for text in wanted.distances])
    frames = [frame for frame in capture.frames if frame.has_photo]
    if wanted.markers is not None:
        return _scale_from_markers([upright(frame, capture.pixels) for frame in frames], wanted.markers)
    if wanted.scale == GPS:
        return scale_from_gps(frames, gps_positions(frames))
    return None


def _scale_from_markers(frames: Sequence[Frame], text: str) -> ScaleEstimate:
    dictionary, *numbers = text.split(":")
    try:
        if len(numbers) == 1:
            return scale_from_markers(frames, float(numbers[0]), dictionary=dictionary)
        size, square, marker, *more = numbers
        if more not in ([], ["legacy"]):
            raise ValueError(more)
        columns, rows = (int(part) for part in size.split("x"))
        board = CharucoBoard(columns, rows, float(square), float(marker), dictionary, legacy=bool(more))
        return scale_from_charuco(frames, board)
    except ValueError as error:
        hint = "expected markers DICT_4X4_50:0.05, or a ChArUco board DICT_5X5_100:7x5:0.04:0.03, sides in metres"
        raise UserError(f"invalid --markers {text!r}", hint, exit_code=2) from error


def _factor(text: str | None) -> float:
    if text is None:
        return 1.0
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not SMALLEST_SCALE <= factor <= 1 / SMALLEST_SCALE:
        hint = f"expected a number from {SMALLEST_SCALE:g} to {1 / SMALLEST_SCALE:g}, or gps"
        raise UserError(f"invalid --scale {text!r}", hint, exit_code=2)
    return factor
