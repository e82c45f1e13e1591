"""Colours of a field at points of space, from where they are looked at."""

import numpy as np
import torch

from nerfcli.render.model import Model
from nerfcli.render.tracing import render_cut_rays

_BLOCK = 2**15
# Nothing is left out of colours that end in 8 bits.
_TOLERANCE = 1e-4
# Directions from which a point without a surface is looked at.
_AXES = np.concatenate([np.eye(3), -np.eye(3)])
# A surface is looked at over so many voxels before and behind it, in so many steps.
_REACH_VOXELS, _STEPS = 3.0, 24


def surface_colours(model: Model, points: np.ndarray, normals: np.ndarray, *, voxel_size: float) -> np.ndarray:
    """Return the colours (N, 3) uint8 of points of a surface, looked at along its normals from outside.

    What a ray through a few voxels around the surface sees, without what is behind it. Where it meets nothing, the
    colour is that of the field at the point.

    Args:
        model: the trained model.
        points, normals: (N, 3) scene's frame; normals unit, outwards.
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
        colours[thin] = point_colours(model, points[thin])[0]
    return _levels(colours)


def point_colours(model: Model, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return colours (N, 3) in [0, 1] of points, the mean over six directions, and densities (N,) per scene unit.

    Both are 0 in cells that hold nothing.
    """
    scale = model.training_from_scene.scale
    places = model.training_from_scene.apply(points)
    # A ray of a single interval has its colour evaluated in its middle, and nothing else.
    cuts = torch.tensor([0.0, 2.0])
    total = np.zeros((len(points), 3))
    density = np.zeros(len(points))
    for axis in _AXES:
        directions = np.broadcast_to(axis, places.shape)
        colours, opacity = _looked_at(model, places - axis, directions, cuts)
        total += colours / len(_AXES)
        density = -np.log1p(-np.minimum(opacity, 1 - 1e-12)) / 2.0 * scale
    return total, density


def _looked_at(
    model: Model, starts: np.ndarray, directions: np.ndarray, cuts: torch.Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (N, 3) of what rays see between the cuts, and opacities (N,)."""
    colours, opacities = [], []
    for first in range(0, len(starts), _BLOCK):
        part = slice(first, first + _BLOCK)
        origins, towards = (
            torch.from_numpy(np.array(values[part], dtype=np.float32)).to(model.device)
            for values in (starts, directions)
        )
        seen = render_cut_rays(
            model,
            origins,
            towards,
            cuts=cuts.to(origins),
            background=torch.zeros(3, device=model.device),
            shares=(),
            tolerance=_TOLERANCE,
        )
        opacity = seen.ends.opacity
        colours.append((seen.rgb / opacity[:, None].clamp_min(1e-9)).clamp(0.0, 1.0).cpu().numpy())
        opacities.append(opacity.cpu().numpy())
    if not colours:
        return np.zeros((0, 3)), np.zeros(0)
    return np.concatenate(colours).astype(np.float64), np.concatenate(opacities).astype(np.float64)


def _levels(colours: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)
