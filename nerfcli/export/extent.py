"""Settings of an extracted surface, the extent of the photos' subject, and the resolution at which they show it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras.frame import Frame, chosen_evenly
from nerfcli.errors import UserError
from nerfcli.export.depth_views import DepthView, depth_views
from nerfcli.render.model import Model

# Longer side in pixels of the pictures whose depths are fused, and most photos to render.
MAX_SIZE, MOST_VIEWS = 480, 150
FACES = 300_000


@dataclass(frozen=True)
class SurfaceSettings:
    """Settings for extracting geometry from a field.

    Args:
        box: low and high corner x0, y0, z0, x1, y1, z1 in the scene's frame and unit; None for the photos'
            subject.
        voxel_size: scene units; None for the resolution of the photos.
        faces: most triangles.
        max_size: longer side of the pictures whose depths are fused, pixels.

    Raises:
        UserError: the box is not six finite numbers with the low corner first.
    """

    box: tuple[float, ...] | None = None
    voxel_size: float | None = None
    faces: int = FACES
    max_size: int = MAX_SIZE

    def __post_init__(self) -> None:
        box = self.box
        if box is not None and not (len(box) == 6 and np.isfinite(box).all() and np.less(box[:3], box[3:]).all()):
            raise UserError(
                f"invalid --box {','.join(f'{value:g}' for value in box)}",
                "expected X0,Y0,Z0,X1,Y1,Z1 in the scene's units, the low corner first",
                exit_code=2,
            )


# Most voxels along a side; beyond, not even the index of the blocks fits into memory.
MOST_CELLS = 2048
# Cameras look out of the ball if it contains less than this fraction of the seen points.
_LEAST_INSIDE = 0.05
# Largest and smallest default number of voxels along the longest side of a box.
FINEST_CELLS, COARSEST_CELLS = 384, 64


@dataclass(frozen=True)
class Grid:
    """Voxel (i, j, k) is a cube of side `voxel_size` whose centre is low + voxel_size * (i + 1/2, j + 1/2, k + 1/2).

    Args:
        low: (3,) low corner of the first voxel.
        voxel_size: > 0, scene units.
        shape: voxels along x, y and z.
    """

    low: np.ndarray
    voxel_size: float
    shape: tuple[int, int, int]

    @staticmethod
    def over(box: tuple[float, ...], voxel_size: float) -> "Grid":
        """Return the grid that covers a box, starting at its low corner.

        Raises:
            UserError: it would have too many voxels.
        """
        low, high = np.array(box[:3], dtype=np.float64), np.array(box[3:], dtype=np.float64)
        shape = tuple(max(1, math.ceil(round(length / voxel_size, 6))) for length in high - low)
        if max(shape) > MOST_CELLS:
            raise UserError(
                f"a voxel size of {voxel_size:.4g} gives {max(shape)} voxels along a side of the box; at most "
                f"{MOST_CELLS} are supported",
                f"use a smaller --box, or a --voxel-size of at least {(high - low).max() / MOST_CELLS:.4g}",
            )
        return Grid(low, voxel_size, (shape[0], shape[1], shape[2]))

    def centres(self, indices: np.ndarray) -> np.ndarray:
        """Return the centres (..., 3) of voxels with indices (..., 3)."""
        return self.low + self.voxel_size * (indices + 0.5)

    @property
    def high(self) -> np.ndarray:
        """The corner (3,) opposite to `low`."""
        return self.low + self.voxel_size * np.array(self.shape)


def scene_box(model: Model, frames: Sequence[Frame]) -> tuple[float, ...]:
    """Return the axis-aligned box x0, y0, z0, x1, y1, z1 of the photos' subject in the scene's frame.

    It contains the median-depth points that some cameras see inside the unit ball of the training frame, where space is
    not contracted, except for the outermost 1 % at each side; the far background is left out. If cameras look out of
    the ball, points up to twice the median distance are used instead.

    Raises:
        UserError: no ray sees a surface.
    """
    # A few small views show the extent.
    views = depth_views(model, chosen_evenly(frames, 24), max_size=64)
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
    # Without the outermost percent on each side, and with a margin.
    low, high = np.quantile(points, 0.01, axis=0), np.quantile(points, 0.99, axis=0)
    margin = 0.05 * float((high - low).max()) or 0.05 / model.training_from_scene.scale
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
    width = 1.5 * float(np.median(widths)) if widths else 0.0
    return min(max(width, longest / FINEST_CELLS), longest / COARSEST_CELLS)
