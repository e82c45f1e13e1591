"""Compare a written file, as the parser of its format reads it, with the capture: points, cameras, poses and rays."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Capture
from nerfcli.captures.axes import poses_of
from nerfcli.captures.formats.registry import Format
from nerfcli.errors import GATE_NOT_MET, UserError

TOLERANCE_PX = 1e-6
# Coordinates are rounded to 2^-53 of their size, several times, by the writer and by the parser.
_ROUNDINGS = 64 * 2.0**-53


@dataclass(frozen=True)
class Check:
    """Differences between a written file and its capture.

    Args:
        rays: number of rays compared.
        max_px: the largest distance between the pixels in which the two show a point on a ray.
        tolerance_px: the largest max_px that passes: 1e-6, or what the rounding of far coordinates may cause.
    """

    rays: int
    max_px: float
    tolerance_px: float


def check(capture: Capture, again: Capture, form: Format, *, own_lenses: bool) -> Check:
    """Compare a capture with what was read back from the file that it was written to.

    Args:
        own_lenses: compare poses only, with the lenses of the capture for both.

    Raises:
        UserError: there are other points, or another number of views.
    """
    if "points" not in form.lacks and not np.array_equal(again.points, capture.points):
        raise differs(f"{len(again.points)} points instead of {len(capture.points)}, or other positions")
    if "poses" in form.lacks:
        return Check(0, 0.0, TOLERANCE_PX)
    frames = sorted(capture.frames, key=form.listed_by)
    if len(again.frames) != len(frames):
        raise differs(f"{len(again.frames)} views instead of {len(frames)}")
    centres = poses_of(capture)[:, :3, 3]
    distance = float(np.linalg.norm(np.ptp(centres, axis=0))) or 1.0

    @cache
    def points_on_rays(camera: Camera) -> np.ndarray:
        steps = (np.arange(6) + 0.5) / 6  # columns and rows of pixels
        directions, valid = camera.bearings(np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * camera.size)
        return directions[valid] * distance

    rays, max_px = 0, 0.0
    for frame, other in zip(frames, again.frames, strict=True):
        camera = frame.camera if own_lenses else other.camera.resized(*frame.camera.size)
        points = points_on_rays(frame.camera)
        moved = rigid.apply(rigid.inverse(other.world_from_cam) @ frame.world_from_cam, points)
        off = np.linalg.norm(camera.project(moved)[0] - frame.camera.project(points)[0], axis=1)
        rays, max_px = rays + len(off), max(max_px, float(off.max(initial=0.0)))
    focal_px = max(frame.camera.focal_px for frame in frames)
    return Check(rays, max_px, max(TOLERANCE_PX, _ROUNDINGS * focal_px * float(np.abs(centres).max()) / distance))


def differs(what: str) -> UserError:
    """Return the error for a file that does not hold what was written."""
    hint = "nothing was kept; this is a bug in nerfcli, please report it"
    return UserError(f"the file that was written differs from the capture: {what}", hint, exit_code=GATE_NOT_MET)
