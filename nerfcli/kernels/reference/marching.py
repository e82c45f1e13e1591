"""Samples along rays: those in occupied cells, and those among them that light reaches. Letters as in `interface`."""

import numpy as np
import torch
from scipy.ndimage import distance_transform_cdt
from torch import Tensor

from nerfcli.kernels.contraction import grid_coordinates, sample_widths
from nerfcli.kernels.interface import HashGrid, March, Rays, Samples
from nerfcli.kernels.reference.compositing import optical_depth_before, ray_indices
from nerfcli.kernels.reference.encoding import hash_encode
from nerfcli.kernels.reference.networks import density


def march(rays: Rays, along: March) -> tuple[Tensor, Tensor, Tensor]:
    """Cut rays into intervals and keep those whose midpoint lies in an occupied cell: starts (N,), ends (N,), offsets.

    Ray r is cut at edges[k] + jitter[r] * (edges[k + 1] - edges[k]).
    """
    edges, occupied = along.edges, along.occupied
    cuts = edges[:-1] + rays.jitter[:, None] * (edges[1:] - edges[:-1])  # (R, S + 1)
    starts, ends = cuts[:, :-1], cuts[:, 1:]
    middles = rays.origins[:, None, :] + rays.directions[:, None, :] * ((starts + ends) / 2)[..., None]  # (R, S, 3)
    coordinates = grid_coordinates(middles, along.contraction)
    side = occupied.shape[0]
    inside = ((coordinates >= 0) & (coordinates <= 1)).all(-1)
    x, y, z = (coordinates.clamp(0, 1) * side).long().clamp_max(side - 1).unbind(-1)
    kept = inside & occupied[z, y, x]
    offsets = torch.zeros(len(rays.origins) + 1, dtype=torch.int64, device=edges.device)
    offsets[1:] = kept.sum(1).cumsum(0)
    return starts[kept], ends[kept], offsets


def sample_coordinates(
    origins: Tensor, directions: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, contraction: str
) -> Tensor:
    """Return the midpoints of intervals as coordinates of the field's unit cube: (N, 3). See `grid_coordinates`.

    Differentiable in origins and directions.
    """
    rays = ray_indices(offsets)
    points = origins[rays] + directions[rays] * ((starts + ends) / 2)[:, None]
    return grid_coordinates(points, contraction)


def ray_gradients(
    origins: Tensor,
    directions: Tensor,
    starts: Tensor,
    ends: Tensor,
    *,
    offsets: Tensor,
    contraction: str,
    gradient: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the gradients (R, 3) by origins and directions, from those (N, 3) by `sample_coordinates`."""
    origins, directions = (x.detach().requires_grad_() for x in (origins, directions))
    with torch.enable_grad():
        found = sample_coordinates(origins, directions, starts, ends, offsets=offsets, contraction=contraction)
    by_origin, by_direction = torch.autograd.grad(found, (origins, directions), gradient)
    return by_origin, by_direction


def occupied_samples(rays: Rays, along: March) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the samples of `march` with their coordinates: starts, ends, coordinates (N, 3), offsets."""
    starts, ends, offsets = march(rays, along)
    coordinates = sample_coordinates(
        rays.origins, rays.directions, starts, ends, offsets=offsets, contraction=along.contraction
    )
    return starts, ends, coordinates, offsets


def keep_largest(cells: Tensor, coordinates: Tensor, values: Tensor) -> None:
    """Raise each cell of a grid (C, C, C) to the largest value at the points in it, in place; NaN is ignored.

    Args:
        cells: indexed [z, y, x].
        coordinates, values: (N, 3) in the unit cube, and (N,).
    """
    side = len(cells)
    x, y, z = (coordinates * side).long().clamp(0, side - 1).unbind(-1)
    cells.view(-1).scatter_reduce_(0, (z * side + y) * side + x, values.nan_to_num(-torch.inf), "amax")


@torch.no_grad()
def visible_samples(rays: Rays, along: March, grid: HashGrid, cell_depths: Tensor | None = None) -> Samples:
    """Return the samples of `march` in front of which the optical depth is below a limit, with their encoding.

    A sample of optical depth d behind an optical depth D is left out if d exp(-D) < least_weight: it absorbs less than
    this fraction of its ray's light. Everything behind the limit absorbs at most exp(-max_optical_depth). Samples whose
    density is NaN are kept. If all samples of all rays are that faint, none is left out, so that a field that has
    become transparent can learn again. `cell_depths` (C, C, C) is raised to the optical depths of all samples
    before the limit, including those left out for their weight, see `keep_largest`. Without gradients.
    """
    starts, ends, coordinates, offsets = occupied_samples(rays, along)
    widths = None
    if grid.antialias and rays.cones is not None:
        widths = sample_widths(rays, starts, ends, index=ray_indices(offsets), contraction=along.contraction)
    encoded = hash_encode(coordinates, grid.table, grid.resolutions, widths)
    thickness = density(encoded, grid.layers)
    lengths = ends - starts
    before = optical_depth_before(thickness, lengths, offsets)
    reached = before < along.max_optical_depth
    if cell_depths is not None:
        keep_largest(cell_depths, coordinates[reached], (thickness * lengths)[reached])
    faint = thickness * lengths * torch.exp(-before) < along.least_weight
    faint &= ~faint.all()
    seen = reached & ~faint
    kept = torch.nn.functional.pad(seen.cumsum(0), (1, 0))[offsets]
    index = ray_indices(kept)
    return Samples(starts[seen], ends[seen], thickness[seen], encoded[seen], coordinates[seen], kept, index)


# Blocks per axis of `distances_to_occupied` at most: their distances then stay in a processor's cache.
_MOST_BLOCKS = 128


def distances_to_occupied(occupied: Tensor) -> Tensor:
    """Return how far it is from each block of cells to the nearest that has an occupied cell.

    Args:
        occupied: (G, G, G) bool on the CPU; G is a power of two, or at most 128.

    Returns:
        (B, B, B) uint8, B = min(G, 128): the largest of the distances along the axes, in blocks; 0 for a block that has
        an occupied cell itself, 255 for that distance and more.
    """
    side = len(occupied)
    blocks = min(side, _MOST_BLOCKS)
    cells = side // blocks
    filled = occupied.view(blocks, cells, blocks, cells, blocks, cells).any(5).any(3).any(1)
    if not filled.any():
        return torch.full(filled.shape, 255, dtype=torch.uint8)
    distance = distance_transform_cdt(~filled.numpy(), metric="chessboard")
    return torch.from_numpy(distance.clip(0, 255).astype(np.uint8))
