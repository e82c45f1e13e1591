"""Coverage and parallax of the surface on the grid of a page."""

from collections.abc import Sequence

import numpy as np
import torch

from nerfcli.kernels import grid_coordinates
from nerfcli.render.coverage import DepthMap, coverage_and_parallax
from nerfcli.render.model import Model

# Candidate numbers of cells along each axis of the unit cube: the first with at least this many pixels per occupied
# cell is used. Large cells mix seen and unseen places; small ones may fall between the pixels of all depth maps.
SIDES, _LEAST_PIXELS = (192, 128, 96, 64, 48, 32), 10
_MOST_PIXELS = 4_000_000
_MOST_PHOTOS = 255


def seen_cells(model: Model, photos: Sequence[DepthMap]) -> np.ndarray:
    """Return coverage and parallax of the surface in the cells of the unit cube, measured at one point per cell.

    Args:
        model: its contraction maps the scene to the cube.
        photos: depths of all training photos.

    Returns:
        uint16 (side, side, side), indexed [z, y, x], side from `SIDES`: coverage, at most 255, + 256 times the
        parallax in whole degrees; 0 where no photo sees a surface.
    """
    step = 1 + sum(int(np.isfinite(view.distances).sum()) for view in photos) // _MOST_PIXELS
    points = np.concatenate([view.points()[::step] for view in photos])
    in_training = torch.from_numpy(model.training_from_scene.apply(points))
    places = grid_coordinates(in_training, model.contraction).numpy()
    inside = ((places >= 0) & (places <= 1)).all(axis=1)
    points, places = points[inside], places[inside]
    side = next((side for side in SIDES if _pixels_per_cell(places, side) >= _LEAST_PIXELS), SIDES[-1])
    keys, first = np.unique(_cells_of(places, side), return_index=True)
    coverage, parallax = coverage_and_parallax(photos, points[first])
    cells = np.zeros(side**3, "<u2")
    cells[keys] = np.minimum(coverage, _MOST_PHOTOS) + 256 * np.rint(parallax)
    return cells.reshape(side, side, side)


def _cells_of(places: np.ndarray, side: int) -> np.ndarray:
    """Return the indices (N,) of the cells that contain points (N, 3) of the unit cube."""
    x, y, z = np.minimum((places * side).astype(np.int64), side - 1).T
    return (z * side + y) * side + x


def _pixels_per_cell(places: np.ndarray, side: int) -> float:
    return len(places) / max(1, len(np.unique(_cells_of(places, side))))
