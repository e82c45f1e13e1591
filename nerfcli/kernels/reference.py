"""The definition of every hot operation, in plain torch: short, any dtype, any device, never optimised.

Letters: rays R; samples N of all rays together, packed ray after ray; `offsets` (R + 1,) int64 with ray r owning
samples offsets[r] up to offsets[r + 1]; table levels L, rows per level T, features per row F. A fast kernel in
another module of this folder agrees with these functions in value and gradient.
"""

import torch
from torch import Tensor

from nerfcli.kernels.activations import density_from_log, opacity
from nerfcli.kernels.contraction import grid_coordinates, sample_widths

HASH_PRIMES = (1, 2654435761, 805459861)


def corner_rows(cells: Tensor, resolution: int, rows: int) -> Tensor:
    """The table row of each grid vertex: its place in the dense grid where that fits, else its spatial hash.

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
    """Trilinear interpolation in a multiresolution hash table.

    With widths, a level of n cells per axis counts min(1, 1 / (n width)): details smaller than what a pixel covers
    fade out of what it sees.

    Args:
        points: (N, 3) in [0, 1]; values outside are clamped.
        table: (L, T, F), T a power of two.
        resolutions: cells per axis of each of the L levels; 0 leaves a level out.
        widths: (N,) of a pixel at the points, as a share of the cube's side, >= 0; without gradient.

    Returns:
        (N, L * F), level after level; 0 for a level that is left out.

    Raises:
        ValueError: the table does not have one level per resolution, or T is not a power of two.

    Differentiable in the table, and in points inside the cells: the gradient is that of the piecewise trilinear
    function. It jumps where a point crosses a face of a cell of any level, and is there that of the upper cell; outside
    [0, 1] it is 0.
    Source: Müller et al. 2022, Instant NGP, arXiv:2201.05989, section 3; for the widths Barron et al. 2023, Zip-NeRF,
    arXiv:2304.06706, eq. 3, with a cheaper function that falls off alike.
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


def march(
    origins: Tensor,
    directions: Tensor,
    edges: Tensor,
    *,
    jitter: Tensor,
    occupied: Tensor,
    contraction: str,
) -> tuple[Tensor, Tensor, Tensor]:
    """Cut rays into intervals and keep those whose midpoint lies in an occupied cell.

    Ray r is cut at edges[k] + jitter[r] * (edges[k + 1] - edges[k]).

    Args:
        origins, directions: (R, 3), unit directions, training frame.
        edges: (S + 2,) increasing distances, shared by the rays, for S intervals.
        jitter: (R,) in [0, 1).
        occupied: (G, G, G) bool over the unit cube of `grid_coordinates`, indexed [z, y, x].
        contraction: see `grid_coordinates`; outside the cube of a bounded scene nothing is occupied.

    Returns:
        starts (N,), ends (N,), offsets (R + 1,).
    """
    cuts = edges[:-1] + jitter[:, None] * (edges[1:] - edges[:-1])  # (R, S + 1)
    starts, ends = cuts[:, :-1], cuts[:, 1:]
    middles = origins[:, None, :] + directions[:, None, :] * ((starts + ends) / 2)[..., None]  # (R, S, 3)
    coordinates = grid_coordinates(middles, contraction)
    side = occupied.shape[0]
    inside = ((coordinates >= 0) & (coordinates <= 1)).all(-1)
    x, y, z = (coordinates.clamp(0, 1) * side).long().clamp_max(side - 1).unbind(-1)
    kept = inside & occupied[z, y, x]
    offsets = torch.zeros(len(origins) + 1, dtype=torch.int64, device=origins.device)
    offsets[1:] = kept.sum(1).cumsum(0)
    return starts[kept], ends[kept], offsets


def pixel_rays(
    chosen: Tensor, first_pixel: Tensor, first_bearing: Tensor, *, bearings: Tensor, poses: Tensor, photos: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The rays of chosen pixels of many photos, and their colours.

    Args:
        chosen: (N,) int64 numbers of pixels, counted through all photos, row by row.
        first_pixel: (P,) int64, the number of the first pixel of each photo, increasing from 0.
        first_bearing: (P,) int64, where the bearings of a photo's camera begin.
        bearings: (B, 3) directions of pixels in the axes of their cameras.
        poses: (P, 4, 4) `world_from_cam`.
        photos: (M, C) uint8 values of all pixels.

    Returns:
        origins (N, 3), directions (N, 3) = rotation @ bearing, colours (N, C) in [0, 1].
    """
    photo = torch.searchsorted(first_pixel, chosen, right=True) - 1
    bearing = bearings[first_bearing[photo] + chosen - first_pixel[photo]]
    pose = poses[photo]
    directions = (pose[:, :3, :3] * bearing[:, None, :]).sum(-1)  # a batched product of 3x3 is slower
    return pose[:, :3, 3], directions, photos[chosen].to(poses.dtype) / 255.0


def ray_indices(offsets: Tensor) -> Tensor:
    """The ray of each packed sample, (N,) int64."""
    counts = offsets.diff()
    return torch.repeat_interleave(torch.arange(len(counts), device=offsets.device), counts)


def optical_depth_before(density: Tensor, lengths: Tensor, offsets: Tensor) -> Tensor:
    """Optical depth between the ray's origin and the near end of each interval.

    tau_i = sum_{j < i} density_j * length_j over the samples of the same ray.

    Shifted, then accumulated: to accumulate and subtract the own part loses all digits at a much denser interval.

    Args:
        density: (N,) >= 0, finite, in 1 / unit of length.
        lengths: (N,) >= 0.
        offsets: (R + 1,).

    Returns:
        (N,), 0 at the first sample of each ray. Differentiable in density and lengths.
    """
    rays = ray_indices(offsets)
    place = torch.arange(len(density), device=density.device) - offsets[rays]
    longest = int(offsets.diff().max()) if len(offsets) > 1 else 0
    rows = density.new_zeros(len(offsets) - 1, longest + 1)
    rows = rows.index_put((rays, place + 1), density * lengths)
    return rows.cumsum(1)[rays, place]


def interval_weights(density: Tensor, lengths: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """The share of light that ends in each interval, and the share that passes them all.

    alpha_i = 1 - exp(-density_i * length_i),  T_i = exp(-tau_i),  weight_i = T_i * alpha_i

    Args:
        density: (N,) >= 0, finite.
        lengths: (N,) >= 0.
        offsets: (R + 1,).

    Returns:
        weights (N,), transmittance (R,) behind the last interval; per ray they sum to 1.

    Differentiable in density and lengths. 1 - exp would lose every digit below 1e-7 in float32.
    Source: Max 1995, Optical models for direct volume rendering; Mildenhall et al. 2020, arXiv:2003.08934, eq. 3.
    """
    before = optical_depth_before(density, lengths, offsets)
    depth = density * lengths
    weights = torch.exp(-before) * opacity(depth)
    total = torch.zeros(len(offsets) - 1, dtype=density.dtype, device=density.device)
    total = total.index_add(0, ray_indices(offsets), depth)
    return weights, torch.exp(-total)


def sum_along_rays(values: Tensor, offsets: Tensor) -> Tensor:
    """Sums of the samples of each ray: (N, ...) to (R, ...). Differentiable."""
    total = torch.zeros((len(offsets) - 1, *values.shape[1:]), dtype=values.dtype, device=values.device)
    return total.index_add(0, ray_indices(offsets), values)


def composite(
    density: Tensor, rgb: Tensor, lengths: Tensor, *, offsets: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour of rays through an emitting, absorbing medium in front of a background.

    colour = sum_i weight_i * rgb_i + T * background; see `interval_weights`.

    Args:
        density: (N,) >= 0, finite.
        rgb: (N, 3).
        lengths: (N,) >= 0.
        offsets: (R + 1,).
        background: (R, 3) or (3,).

    Returns:
        colour (R, 3), transmittance (R,), weights (N,). A ray without samples has the background's colour and T = 1.

    Differentiable in density, rgb, lengths and background.
    Source: Mildenhall et al. 2020, NeRF, arXiv:2003.08934, eq. 3.
    """
    weights, transmittance = interval_weights(density, lengths, offsets)
    colour = sum_along_rays(weights[:, None] * rgb, offsets)
    return colour + transmittance[:, None] * background, transmittance, weights


def distortion(weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
    """How far the light of each ray ends apart: the mean distance between two places where it ends.

    sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (ends_i - starts_i), with m the middles; 0 without samples.

    Args:
        weights: (N,) >= 0, see `interval_weights`.
        starts, ends: (N,) increasing along each ray, in whatever measure of distance counts.
        offsets: (R + 1,).

    Returns:
        (R,). Differentiable in weights.

    The double sum is 2 sum_i (m_i - m_(i-1)) W_i B_i with the weights W_i in front of interval i and B_i from it on: a
    gap between two middles counts for all pairs on its two sides. Nothing is subtracted from a sum.
    Source: Barron et al. 2022, Mip-NeRF 360, arXiv:2111.12077, eq. 15.
    """
    middles, ones = (starts + ends) / 2, torch.ones_like(weights)
    before = optical_depth_before(weights, ones, offsets)
    behind = optical_depth_before(weights.flip(0), ones, offsets[-1] - offsets.flip(0)).flip(0)
    gaps = torch.nn.functional.pad(middles.diff(), (1, 0))[: len(middles)]  # at a ray's first sample `before` is 0
    terms = 2 * gaps * before * (weights + behind) + weights.square() * (ends - starts) / 3
    return sum_along_rays(terms, offsets)


def sample_coordinates(
    origins: Tensor, directions: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, contraction: str
) -> Tensor:
    """The middles of intervals as coordinates of the field's unit cube: (N, 3). See `grid_coordinates`.

    Differentiable in origins and directions.
    """
    rays = ray_indices(offsets)
    points = origins[rays] + directions[rays] * ((starts + ends) / 2)[:, None]
    return grid_coordinates(points, contraction)


def geometry(encoded: Tensor, weights: tuple[Tensor, ...]) -> Tensor:
    """The density network: (N, E) to (N, G), W2 relu(W1 x); the first output is the log of the density."""
    return torch.relu(encoded @ weights[0].t()) @ weights[1].t()


def density(encoded: Tensor, weights: tuple[Tensor, ...]) -> Tensor:
    """Density of encoded positions.

    density = exp((W2 relu(W1 x))_0), the exponent clipped to [-15, 15]; see `density_from_log`.

    Args:
        encoded: (N, E).
        weights: W1 (H, E), W2 (G, H), and whatever follows.

    Returns:
        (N,).
    """
    return density_from_log(geometry(encoded, weights)[:, 0])


def radiance(encoded: Tensor, harmonics: Tensor, rays: Tensor, weights: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Density and colour of encoded positions seen along rays.

    g = W2 relu(W1 x),  density = exp(g_0),  rgb = sigmoid(C3 relu(C2 relu(C1 [g, harmonics of the ray])))

    Args:
        encoded: (N, E).
        harmonics: (R, S) encoded direction of each ray.
        rays: (N,) int64, the ray of each sample.
        weights: W1 (H, E), W2 (G, H), C1 (H, G + S), C2 (H, H), C3 (3, H); no biases.

    Returns:
        density (N,), rgb (N, 3) in (0, 1).

    Differentiable in encoded, harmonics and weights.
    """
    shape = geometry(encoded, weights)
    hidden = torch.relu(torch.cat([shape, harmonics[rays]], dim=-1) @ weights[2].t())
    hidden = torch.relu(hidden @ weights[3].t())
    return density_from_log(shape[:, 0]), torch.sigmoid(hidden @ weights[4].t())


def visible_samples(
    origins: Tensor,
    directions: Tensor,
    edges: Tensor,
    *,
    jitter: Tensor,
    occupied: Tensor,
    contraction: str,
    table: Tensor,
    resolutions: tuple[int, ...],
    weights: tuple[Tensor, ...],
    deepest: float,
    cones: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The samples of `march` in front of which the optical depth is below a limit, with what the field says of them.

    What is left out takes at most exp(-deepest) of a ray's light.

    Args:
        origins, directions, edges, jitter, occupied, contraction: see `march`.
        table, resolutions: see `hash_encode`.
        weights: see `density`.
        deepest: > 0; each ray ends with the sample that brings its optical depth to this.
        cones: (R,) width of the pixel of each ray per distance, for `hash_encode` with widths; None for without.

    Returns:
        starts (N,), ends (N,), density (N,), encoded (N, L * F), coordinates (N, 3) in the field's unit cube,
        offsets (R + 1,). Without gradients.
    """
    with torch.no_grad():
        starts, ends, offsets = march(
            origins, directions, edges, jitter=jitter, occupied=occupied, contraction=contraction
        )
        coordinates = sample_coordinates(origins, directions, starts, ends, offsets=offsets, contraction=contraction)
        widths = None
        if cones is not None:
            rays = ray_indices(offsets)
            widths = sample_widths(origins, directions, starts, ends, rays=rays, cones=cones, contraction=contraction)
        encoded = hash_encode(coordinates, table, resolutions, widths)
        thickness = density(encoded, weights)
        seen = optical_depth_before(thickness, ends - starts, offsets) < deepest
        kept = torch.nn.functional.pad(seen.cumsum(0), (1, 0))[offsets]
    return starts[seen], ends[seen], thickness[seen], encoded[seen], coordinates[seen], kept


@torch.no_grad()
def adam_rows(
    table: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    *,
    step: int,
    rate: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """One step of Adam, in place, on the rows whose gradient is not zero; the gradient is set to zero.

    m = b1 m + (1 - b1) g,  v = b2 v + (1 - b2) g^2
    table -= rate (m / (1 - b1^step)) / (sqrt(v / (1 - b2^step)) + eps)

    A row that no sample touched keeps its moments and its value: it does not drift on old momentum, and costs nothing.

    Args:
        table, gradient, first, second: (..., F), all of one shape.
        step: number of this step, from 1.
        rate, betas, eps: of Adam.

    Source: Kingma and Ba 2015, Adam, arXiv:1412.6980, algorithm 1; skipping untouched rows as in Müller et al. 2022.
    """
    touched = (gradient != 0).any(-1)
    g = gradient[touched]
    first[touched] = betas[0] * first[touched] + (1 - betas[0]) * g
    second[touched] = betas[1] * second[touched] + (1 - betas[1]) * g * g
    mean = first[touched] / (1 - betas[0] ** step)
    spread = (second[touched] / (1 - betas[1] ** step)).sqrt()
    table[touched] -= rate * mean / (spread + eps)
    gradient.zero_()
