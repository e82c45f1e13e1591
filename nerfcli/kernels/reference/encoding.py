"""Interpolation in a multiresolution hash grid. Letters as in `interface`."""

import torch
from torch import Tensor

HASH_PRIMES = (1, 2654435761, 805459861)


def corner_rows(cells: Tensor, resolution: int, rows: int) -> Tensor:
    """Return the table row of each grid vertex: its index in the dense grid if that fits, else its spatial hash.

    hash(i, j, k) = (i * 1 xor j * 2654435761 xor k * 805459861) mod rows, in unsigned 32-bit arithmetic.

    Args:
        cells: (..., 3) int64 vertex indices, 0 .. resolution.
        resolution: cells per axis; the level has (resolution + 1)^3 vertices.
        rows: rows of the table, a power of two.

    Source: Müller et al. 2022, Instant NGP, arXiv:2201.05989, eq. 4.
    """
    side = resolution + 1
    if side**3 <= rows:
        return (cells[..., 2] * side + cells[..., 1]) * side + cells[..., 0]
    mixed = cells[..., 0] * HASH_PRIMES[0]
    for axis in (1, 2):
        mixed = mixed ^ (cells[..., axis] * HASH_PRIMES[axis])
    return mixed & (rows - 1)  # the low bits are the same in 32 and in 64 bits


def hash_encode(points: Tensor, table: Tensor, resolutions: tuple[int, ...], widths: Tensor | None = None) -> Tensor:
    """Interpolate a multiresolution hash table trilinearly.

    With widths, a level of n cells per axis is weighted by min(1, 1 / (n width)): details smaller than a pixel's
    footprint fade out.

    Args:
        points: (N, 3) in [0, 1]; values outside are clamped.
        table: (L, T, F), T a power of two.
        resolutions: cells per axis of each of the L levels; 0 leaves a level out.
        widths: (N,) width of a pixel at the points, as a fraction of the cube's side, >= 0; without gradient.

    Returns:
        (N, L * F), level after level; 0 for a level that is left out.

    Raises:
        ValueError: the table does not have one level per resolution, or T is not a power of two.

    Differentiable in the table, and in points inside the cells: the gradient is that of the piecewise trilinear
    function. It jumps where a point crosses a face of a cell of any level, where it takes the value of the upper cell;
    outside [0, 1] it is 0.
    Source: Müller et al. 2022, Instant NGP, arXiv:2201.05989, section 3; for the widths Barron et al. 2023, Zip-NeRF,
    arXiv:2304.06706, eq. 3, with a cheaper function of similar fall-off.
    """
    levels, rows, _ = table.shape
    if levels != len(resolutions):
        raise ValueError(f"table must have {len(resolutions)} levels, got shape {tuple(table.shape)}")
    if rows & (rows - 1):
        raise ValueError(f"rows must be a power of two, got {rows}")
    corners = torch.tensor([[i >> axis & 1 for axis in range(3)] for i in range(8)], device=points.device)
    encoded = []
    for level, resolution in enumerate(resolutions):
        if resolution == 0:
            encoded.append(table.new_zeros(len(points), table.shape[2]))
            continue
        scaled = points.clamp(0.0, 1.0) * resolution
        cell = scaled.detach().floor().clamp_max(resolution - 1)  # the far border belongs to the last cell
        inside = (scaled - cell)[:, None, :]  # (N, 1, 3)
        weights = torch.where(corners == 1, inside, 1.0 - inside).prod(-1)  # (N, 8)
        index = corner_rows(cell.long()[:, None, :] + corners, resolution, rows)  # (N, 8)
        if widths is not None:
            weights = weights / (resolution * widths).clamp_min(1.0)[:, None]
        encoded.append((table[level][index] * weights[..., None]).sum(1))
    return torch.cat(encoded, dim=-1)
