"""Extent of the photos' subject, and the resolution at which they show it."""

from collections.abc import Sequence

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.render.model import Model
from nerfcli.surface.views import DepthView, depth_views, spread_frames

# Cameras and pixels along the longer side that a first look takes.
LOOK_VIEWS, LOOK_PX = 24, 64
# Of the points seen, those that the box leaves out at each of its sides, and by how much it is then made larger.
_OUTSIDE, _MARGIN = 0.01, 0.05
# Where the ball holds less of the points seen than this, cameras look out of it.
_LEAST_INSIDE = 0.05
# Voxels along the longest side of a box, at most and at least, by default.
FINEST_CELLS, COARSEST_CELLS = 384, 64
# Pixels that a voxel is wide.
_PIXELS_PER_VOXEL = 1.5


def scene_box(model: Model, frames: Sequence[Frame]) -> tuple[float, ...]:
    """Return the box x0, y0, z0, x1, y1, z1 along the axes of the scene's frame that holds what the photos are about.

    It holds the median depths that some cameras see inside the unit ball of the training frame, where space is not
    contracted, but for the outermost; the far background is left out. Where cameras look out of the ball, it is what
    lies beyond twice the typical distance.

    Raises:
        UserError: no ray meets anything.
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
    """Return the voxel size at which the photos resolve what is in a box: 1.5 pixels of the median view, in bounds."""
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
