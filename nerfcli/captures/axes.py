"""Camera axes by name, and conventions that override those of a file format.

Axes are written as three letters for the directions in which the camera's +x, +y and +z point: r(ight) or l(eft),
d(own) or u(p), f(orward) or b(ackward). OpenCV's are rdf. Some have names.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations, product

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.capture import Capture
from nerfcli.errors import UserError

# Sources: docs.opencv.org calib3d; docs.nerf.studio "Data conventions", also for Blender, NeRF and instant-ngp
# (docs/nerf_dataset_tips.md); Fyusion/LLFF README, "Using your own poses without running COLMAP": "[-y, x, z]" of the
# NeRF axes; pytorch3d.org/docs/cameras; ROS REP 103, body frames.
NAMED_AXES = {"opencv": "rdf", "opengl": "rub", "llff": "drb", "pytorch3d": "luf", "ros": "flu"}

_DIRECTIONS = {"r": (1, 0, 0), "l": (-1, 0, 0), "d": (0, 1, 0), "u": (0, -1, 0), "f": (0, 0, 1), "b": (0, 0, -1)}


@cache
def opencv_from_axes(axes: str) -> np.ndarray:
    """Return the rotation (4, 4) whose columns are the axes of a camera, expressed in OpenCV's axes; read-only.

    Args:
        axes: a name ("opencv", "opengl", "llff", "pytorch3d", "ros") or three letters such as "rub".

    Raises:
        UserError: the name is unknown, the letters do not span space, or the axes are left-handed.
    """
    letters = NAMED_AXES.get(axes, axes)
    columns = np.array([_DIRECTIONS.get(letter, (0, 0, 0)) for letter in letters], dtype=np.float64).T
    if columns.shape != (3, 3) or abs(np.linalg.det(columns)) < 0.5:
        hint = f"choose {', '.join(NAMED_AXES)}, or three letters for where x, y and z point: rdf, rub, ..."
        raise UserError(f"unknown camera axes {axes!r}", hint)
    if np.linalg.det(columns) < 0:
        raise UserError(f"camera axes {axes!r} are left-handed", "reverse one of the axes")
    turn = rigid.from_parts(columns, np.zeros(3))
    turn.flags.writeable = False
    return turn


def opencv_pose(world_from_file_cam: np.ndarray, axes: str) -> np.ndarray:
    """Return `world_from_cam` (..., 4, 4) with OpenCV axes, given a pose with these; the world stays the same."""
    return world_from_file_cam @ rigid.inverse(opencv_from_axes(axes))


def pose_in_axes(world_from_cam: np.ndarray, axes: str) -> np.ndarray:
    """Return a pose (..., 4, 4) with these camera axes, given `world_from_cam` with OpenCV axes."""
    return world_from_cam @ opencv_from_axes(axes)


def all_axes() -> Iterator[str]:
    """Yield the 24 right-handed camera axes: names where they have one, else letters; the named ones first."""
    yield from NAMED_AXES
    for pairs in permutations(("rl", "du", "fb")):
        for letters in product(*pairs):
            axes = "".join(letters)
            columns = np.array([_DIRECTIONS[letter] for letter in axes])
            if axes not in NAMED_AXES.values() and np.linalg.det(columns) > 0:
                yield axes


@dataclass(frozen=True)
class Convention:
    """Convention of the numbers in a file, where it may differ from that of the format.

    Args:
        axes: the camera axes of the file's poses; "" for those of the format.
        inverted: whether the file holds the inverse of the transform that its format prescribes.
        pixel_centre: the coordinate of the top-left pixel's centre in cx, cy and pixel positions: 0.5, or 0 as in
            OpenCV.
        intrinsics_scale: the size of the picture that the intrinsics are for, over the size that the file states.
    """

    axes: str = ""
    inverted: bool = False
    pixel_centre: float = 0.5
    intrinsics_scale: float = 1.0


def reinterpreted(capture: Capture, true_convention: Convention, *, parsed_axes: str) -> Capture:
    """Return the capture that a file describes if its numbers are in another convention than its format's.

    Args:
        parsed_axes: the camera axes that the format prescribes.
    """
    poses = reinterpreted_poses(poses_of(capture), true_convention, parsed_axes=parsed_axes)
    shift = 0.5 - true_convention.pixel_centre
    scale = true_convention.intrinsics_scale
    return _with_views(capture, poses, lambda camera: for_picture(camera.shifted(shift, shift), scale), shift)


def expressed(capture: Capture, wanted: Convention, *, written_axes: str) -> Capture:
    """Return a capture that is in the requested convention when it is written in the format's own.

    The inverse of `reinterpreted`.
    """
    turn = opencv_from_axes(wanted.axes) @ rigid.inverse(opencv_from_axes(written_axes))
    shift = wanted.pixel_centre - 0.5
    return _with_views(capture, poses_of(capture) @ turn, lambda camera: camera.shifted(shift, shift), shift)


def reinterpreted_poses(world_from_cam: np.ndarray, true_convention: Convention, *, parsed_axes: str) -> np.ndarray:
    """Return the poses (frames, 4, 4), OpenCV axes, of a file in another convention than the one it was parsed in."""
    in_file = pose_in_axes(world_from_cam, parsed_axes)
    return opencv_pose(rigid.inverse(in_file) if true_convention.inverted else in_file, true_convention.axes)


def poses_of(capture: Capture) -> np.ndarray:
    """Return `world_from_cam` of all frames, (frames, 4, 4)."""
    return np.stack([frame.world_from_cam for frame in capture.frames])


def for_picture(camera: Camera, intrinsics_scale: float) -> Camera:
    """Return the camera for the stated picture size, if its parameters are for one `intrinsics_scale` times as large.

    A principal point exactly in the middle stays there: the file did not give one.
    """
    if intrinsics_scale == 1 or camera.is_spherical:
        return camera
    in_the_middle = camera == camera.centred()
    scaled = ("f", "fx", "fy") if in_the_middle else ("f", "fx", "fy", "cx", "cy")
    return camera.with_values({n: value / intrinsics_scale for n, value in camera.values.items() if n in scaled})


def _with_views(capture: Capture, poses: np.ndarray, changed: Callable[[Camera], Camera], shift: float) -> Capture:
    cameras = {camera: changed(camera) for camera in {frame.camera for frame in capture.frames}}
    frames = tuple(
        replace(frame, camera=cameras[frame.camera], world_from_cam=pose)
        for frame, pose in zip(capture.frames, poses, strict=True)
    )
    observations = capture.observations
    if observations is not None and shift:
        observations = replace(observations, pixels=observations.pixels + shift)
    return replace(capture, frames=frames, observations=observations)
