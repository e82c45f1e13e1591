"""Colours of a field at points, seen along surface normals or averaged over directions."""

import numpy as np
import torch

from nerfcli.render.model import Model
from nerfcli.render.tracing import render_rays

# Viewing directions of a point without a surface.
_AXES = np.concatenate([np.eye(3), -np.eye(3)])


def surface_colours(model: Model, points: np.ndarray, normals: np.ndarray, *, voxel_size: float) -> np.ndarray:
    """Return the colours (N, 3) uint8 of surface points, seen from outside along the normals.

    The colour is that of a ray through a few voxels around the surface, excluding everything farther behind. If the
    ray is nearly transparent, it is the field's colour at the point.

    Args:
        points, normals: (N, 3) in the scene's frame; normals of unit length, outwards.
        voxel_size: scene units.
    """
    to_training = model.training_from_scene
    # Rays to a surface cover three voxels before and behind it, in 24 steps.
    reach = 3.0 * voxel_size * to_training.scale
    cuts = torch.linspace(0.0, 2 * reach, 25)
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
    block = 2**15
    for first in range(0, len(starts), block):
        part = slice(first, first + block)
        origins, towards = (
            torch.from_numpy(np.array(values[part], dtype=np.float32)).to(model.device)
            for values in (starts, directions)
        )
        # Rendering tolerance, far below a level of 8-bit colours.
        seen = render_rays(
            model,
            origins,
            towards,
            cuts=cuts.to(origins),
            background=torch.zeros(3, device=model.device),
            tolerance=1e-4,
        )
        opacity = seen.ends.opacity
        colours.append((seen.rgb / opacity[:, None].clamp_min(1e-9)).clamp(0.0, 1.0).cpu().numpy())
        opacities.append(opacity.cpu().numpy())
    if not colours:
        return np.zeros((0, 3)), np.zeros(0)
    return np.concatenate(colours).astype(np.float64), np.concatenate(opacities).astype(np.float64)
