"""Extent of the photos' subject, and the resolution at which the photos show it."""

from collections.abc import Sequence

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.render.model import Model
from nerfcli.surface.views import DepthView, depth_views, spread_frames

# Number of cameras, and pixels along the longer side, for finding the extent.
LOOK_VIEWS, LOOK_PX = 24, 64
# Fraction of the seen points outside each side of the box, and margin by which the box is then enlarged.
_OUTSIDE, _MARGIN = 0.01, 0.05
# Cameras look out of the ball if it contains less than this fraction of the seen points.
_LEAST_INSIDE = 0.05
# Largest and smallest default number of voxels along the longest side of a box.
FINEST_CELLS, COARSEST_CELLS = 384, 64
# Default width of a voxel in pixels.
_PIXELS_PER_VOXEL = 1.5


def scene_box(model: Model, frames: Sequence[Frame]) -> tuple[float, ...]:
    """Return the axis-aligned box x0, y0, z0, x1, y1, z1 of the photos' subject in the scene's frame.

    It contains the median-depth points that some cameras see inside the unit ball of the training frame, where space is
    not contracted, except for the outermost 1 % at each side; the far background is left out. If cameras look out of
    the ball, points up to twice the median distance are used instead.

    Raises:
        UserError: no ray sees a surface.
    """
    views = depth_views(model, spread_frames(frames, LOOK_VIEWS), max_size=LOOK_PX)
    points = np.concatenate([view.points()[np.isfinite(view.depth)] for view in views])
    reach = np.sqrt(3.0) if model.contraction == "none" else 1.0
    if not len(points):
        raise UserError(
            "no camera of the run sees a surface: the opacity is below 0.5 everywhere",
            "train longer, or check the run with nerfcli report RUN",
        )
    distances = np.linalg.norm(model.training_from_scene.apply(points), axis=-1)
    if (distances <= reach).mean() < _LEAST_INSIDE:
        reach = 2.0 * float(np.median(distances))
    points = points[distances <= reach]
    low, high = np.quantile(points, _OUTSIDE, axis=0), np.quantile(points, 1 - _OUTSIDE, axis=0)
    margin = _MARGIN * float((high - low).max()) or _MARGIN / model.training_from_scene.scale
    return tuple(np.concatenate([low - margin, high + margin]).tolist())


def automatic_voxel(views: Sequence[DepthView], box: tuple[float, ...]) -> float:
    """Return the voxel size that the photos resolve in a box: 1.5 pixels of the median view, within limits."""
    low, high = np.array(box[:3]), np.array(box[3:])
    longest = float((high - low).max())
    widths = []
    for view in views:
        points = view.points()
        inside = ((points >= low) & (points <= high)).all(-1)  # False at NaN
        if inside.any():
            widths.append(float(np.median(view.depth[inside])) / view.frame.camera.focal_px)
    width = float(np.median(widths)) * _PIXELS_PER_VOXEL if widths else 0.0
    return min(max(width, longest / FINEST_CELLS), longest / COARSEST_CELLS)
