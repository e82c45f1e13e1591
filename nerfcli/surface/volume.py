"""Sample a field on a grid: density and colour at the centres of voxels."""

from collections.abc import Callable

import numpy as np
import torch

from nerfcli.kernels import grid_coordinates
from nerfcli.render.model import Model
from nerfcli.surface.colours import point_colours
from nerfcli.surface.extent import Grid

# Default number of voxels along the longest side.
CELLS = 160
_LAYERS_AT_A_TIME = 8
# Voxels with a smaller optical depth get no colour, since it would not be visible.
_VISIBLE = 1e-3


def automatic_volume_voxel(box: tuple[float, ...]) -> float:
    """Return the voxel size that gives `CELLS` voxels along the longest side of a box."""
    return float(np.max(np.array(box[3:]) - np.array(box[:3]))) / CELLS


def sample_volume(
    model: Model, grid: Grid, *, on_progress: Callable[[float], None] = lambda fraction: None
) -> dict[str, np.ndarray]:
    """Return arrays on a grid: density (X, Y, Z) float32 in 1 / scene unit, and colour (X, Y, Z, 3) uint8 sRGB.

    The density is the field's at the voxel's centre, 0 in cells that rays skip. The colour is averaged over six
    directions, and 0 if the optical depth of the voxel is at most a thousandth.
    """
    density = np.zeros(grid.shape, np.float32)
    colour = np.zeros((*grid.shape, 3), np.uint8)
    for first in range(0, grid.shape[0], _LAYERS_AT_A_TIME):
        layers = slice(first, min(first + _LAYERS_AT_A_TIME, grid.shape[0]))
        shape = (layers.stop - first, *grid.shape[1:])
        indices = np.indices(shape).reshape(3, -1).T + np.array([first, 0, 0])
        points = grid.centres(indices)
        values = density_at(model, points)
        seen = values * grid.voxel_size > _VISIBLE
        levels = np.zeros((len(points), 3), np.uint8)
        levels[seen] = np.rint(255 * point_colours(model, points[seen]))
        density[layers], colour[layers] = values.reshape(shape), levels.reshape(*shape, 3)
        on_progress(layers.stop / grid.shape[0])
    return {"density": density, "colour": colour}


@torch.no_grad()
def density_at(model: Model, points: np.ndarray) -> np.ndarray:
    """Return the field's density (N,) float32 per scene unit at points in the scene's frame; 0 in skipped cells."""
    places = torch.as_tensor(model.training_from_scene.apply(points), dtype=torch.float32, device=model.device)
    coordinates = grid_coordinates(places, model.contraction)
    inside = ((coordinates >= 0) & (coordinates <= 1)).all(-1)
    side = model.occupied.shape[0]
    x, y, z = (coordinates.clamp(0, 1) * side).long().clamp_max(side - 1).unbind(-1)
    kept = (inside & model.occupied[z, y, x]).nonzero()[:, 0]
    density = torch.zeros(len(places), device=model.device)
    medium = model.field.medium()
    for part in kept.split(2**18):
        density[part] = model.field.backend.density(coordinates[part].contiguous(), medium)
    return (density * model.training_from_scene.scale).cpu().numpy()
