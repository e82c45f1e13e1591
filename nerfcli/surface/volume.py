"""Colours of a field at points, seen along surface normals or averaged over directions; its values on a grid."""

from collections.abc import Callable

import numpy as np
import torch

from nerfcli.kernels import grid_coordinates
from nerfcli.render.model import Model
from nerfcli.render.tracing import render_rays
from nerfcli.surface.extent import Grid

_BLOCK = 2**15
# Rendering tolerance, far below a level of 8-bit colours.
_TOLERANCE = 1e-4
# Viewing directions of a point without a surface.
_AXES = np.concatenate([np.eye(3), -np.eye(3)])
# Rays to a surface cover this many voxels before and behind it, in this many steps.
_REACH_VOXELS, _STEPS = 3.0, 24
# Default number of voxels along the longest side.
CELLS = 160
_LAYERS_AT_A_TIME = 8
# Voxels with a smaller optical depth get no colour, since it would not be visible.
_VISIBLE = 1e-3


def surface_colours(model: Model, points: np.ndarray, normals: np.ndarray, *, voxel_size: float) -> np.ndarray:
    """Return the colours (N, 3) uint8 of surface points, seen from outside along the normals.

    The colour is that of a ray through a few voxels around the surface, excluding everything farther behind. If the
    ray is nearly transparent, it is the field's colour at the point.

    Args:
        points, normals: (N, 3) in the scene's frame; normals of unit length, outwards.
        voxel_size: scene units.
    """
    to_training = model.training_from_scene
    reach = _REACH_VOXELS * voxel_size * to_training.scale
    cuts = torch.linspace(0.0, 2 * reach, _STEPS + 1)
    inwards = -normals @ to_training.rotation.T
    starts = to_training.apply(points) - reach * inwards
    colours, opacity = _looked_at(model, starts, inwards, cuts)
    thin = opacity < 0.1
    if thin.any():
        colours[thin] = point_colours(model, points[thin])
    return np.rint(255 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)


def point_colours(model: Model, points: np.ndarray) -> np.ndarray:
    """Return colours (N, 3) in [0, 1] of points, averaged over six directions; 0 in unoccupied cells."""
    places = model.training_from_scene.apply(points)
    # A ray of a single interval evaluates the field only at its middle, which is the point.
    cuts = torch.tensor([0.0, 2.0])
    total = np.zeros((len(points), 3))
    for axis in _AXES:
        directions = np.broadcast_to(axis, places.shape)
        total += _looked_at(model, places - axis, directions, cuts)[0] / len(_AXES)
    return total


def _looked_at(
    model: Model, starts: np.ndarray, directions: np.ndarray, cuts: torch.Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Render rays between the first and last cut: colours (N, 3) without background, and opacities (N,)."""
    colours, opacities = [], []
    for first in range(0, len(starts), _BLOCK):
        part = slice(first, first + _BLOCK)
        origins, towards = (
            torch.from_numpy(np.array(values[part], dtype=np.float32)).to(model.device)
            for values in (starts, directions)
        )
        seen = render_rays(
            model,
            origins,
            towards,
            cuts=cuts.to(origins),
            background=torch.zeros(3, device=model.device),
            tolerance=_TOLERANCE,
        )
        opacity = seen.ends.opacity
        colours.append((seen.rgb / opacity[:, None].clamp_min(1e-9)).clamp(0.0, 1.0).cpu().numpy())
        opacities.append(opacity.cpu().numpy())
    if not colours:
        return np.zeros((0, 3)), np.zeros(0)
    return np.concatenate(colours).astype(np.float64), np.concatenate(opacities).astype(np.float64)


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
