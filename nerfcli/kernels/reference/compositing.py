"""Compositing along rays: optical depth, weights of intervals, colours, distortion. Letters: `interface`."""

import torch
from torch import Tensor

from nerfcli.kernels.activations import opacity

# Relative distance from a target beyond which light counts fully as off target.
MOST_DEVIATION = 0.25


def ray_indices(offsets: Tensor) -> Tensor:
    """Return the ray of each packed sample, (N,) int64."""
    counts = offsets.diff()
    return torch.repeat_interleave(torch.arange(len(counts), device=offsets.device), counts)


def optical_depth_before(density: Tensor, lengths: Tensor, offsets: Tensor) -> Tensor:
    """Return the optical depth (N,) between the ray's origin and the near end of each interval.

    tau_i = sum_{j < i} density_j * length_j over the samples of the same ray.

    Shifted, then accumulated: subtracting the interval's own depth from the sum loses all digits if it is much denser.

    Args:
        density, lengths: (N,) >= 0, finite.

    Differentiable in density and lengths.
    """
    rays = ray_indices(offsets)
    place = torch.arange(len(density), device=density.device) - offsets[rays]
    longest = int(offsets.diff().max()) if len(offsets) > 1 else 0
    rows = density.new_zeros(len(offsets) - 1, longest + 1)
    rows = rows.index_put((rays, place + 1), density * lengths)
    return rows.cumsum(1)[rays, place]


def interval_weights(density: Tensor, lengths: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the fraction of light absorbed in each interval, (N,), and the fraction that passes all of them, (R,).

    alpha_i = 1 - exp(-density_i * length_i),  T_i = exp(-tau_i),  weight_i = T_i * alpha_i

    Per ray they sum to 1. Differentiable in density and lengths (N,), >= 0 and finite. alpha is computed by expm1: 1 -
    exp loses all digits below 1e-7 in float32.
    Source: Max 1995, Optical models for direct volume rendering; Mildenhall et al. 2020, arXiv:2003.08934, eq. 3.
    """
    before = optical_depth_before(density, lengths, offsets)
    depth = density * lengths
    weights = torch.exp(-before) * opacity(depth)
    return weights, torch.exp(-sum_along_rays(depth, offsets))


def sum_along_rays(values: Tensor, offsets: Tensor) -> Tensor:
    """Return the sum over the samples of each ray: (N, ...) to (R, ...). Differentiable."""
    total = torch.zeros((len(offsets) - 1, *values.shape[1:]), dtype=values.dtype, device=values.device)
    return total.index_add(0, ray_indices(offsets), values)


def composite(
    density: Tensor, rgb: Tensor, lengths: Tensor, *, offsets: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the colour of rays through an emitting, absorbing medium in front of a background.

    colour = sum_i weight_i * rgb_i + T * background; see `interval_weights`.

    Args:
        rgb: (N, 3).
        background: (R, 3) or (3,).

    Returns:
        colour (R, 3), transmittance (R,), weights (N,). A ray without samples has the background's colour and T = 1.

    Differentiable in density and rgb.
    Source: Mildenhall et al. 2020, NeRF, arXiv:2003.08934, eq. 3.
    """
    weights, transmittance = interval_weights(density, lengths, offsets)
    colour = sum_along_rays(weights[:, None] * rgb, offsets)
    return colour + transmittance[:, None] * background, transmittance, weights


def distortion(weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
    """Compute the distortion of each ray: the mean distance between two points at which its light is absorbed.

    sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (ends_i - starts_i), with m the midpoints; 0 without samples.

    Args:
        weights: (N,) >= 0, see `interval_weights`.
        starts, ends: (N,) increasing along each ray, in any measure of distance.
        offsets: (R + 1,).

    Returns:
        (R,). Differentiable in weights.

    The double sum is 2 sum_i (m_i - m_(i-1)) W_i B_i, with the total weights W_i before interval i and B_i from it on:
    the gap between two midpoints counts for every pair across it. Nothing is subtracted from a sum.
    Source: Barron et al. 2022, Mip-NeRF 360, arXiv:2111.12077, eq. 15.
    """
    middles, ones = (starts + ends) / 2, torch.ones_like(weights)
    before = optical_depth_before(weights, ones, offsets)
    behind = optical_depth_before(weights.flip(0), ones, offsets[-1] - offsets.flip(0)).flip(0)
    gaps = torch.nn.functional.pad(middles.diff(), (1, 0))[: len(middles)]  # at a ray's first sample `before` is 0
    terms = 2 * gaps * before * (weights + behind) + weights.square() * (ends - starts) / 3
    return sum_along_rays(terms, offsets)


def contracted_distance(distance: Tensor) -> Tensor:
    """Return s(t) = t / 2 for t <= 1, else 1 - 1 / (2 t): from 0 at the camera to 1 at infinity."""
    return torch.where(distance <= 1.0, distance, 2.0 - 1.0 / distance.clamp_min(1.0)) / 2.0


def depth_loss(weights: Tensor, transmittance: Tensor, middles: Tensor, *, rays: Tensor, distances: Tensor) -> Tensor:
    """Compute how far from known distances the light of the last K rays is absorbed.

    sum_i weight_i min(1, |middle_i - distance| / (c distance)) + transmittance,  c = 0.25

    Light that is absorbed a fraction c of the distance away or more, or not at all, counts 1. So a wrong distance pulls
    no harder than a right one holds once it is reached.

    Args:
        weights, middles: (N,) weights and midpoints of the intervals.
        transmittance: (R,).
        rays: (N,) of the intervals; with them, a GPU's host need not know where the last K begin.
        distances: (K,) > 0, K <= R.

    Returns:
        (K,) in [0, 1]; 0 where all light is absorbed at that distance. Differentiable in weights and transmittance.
    """
    first = len(transmittance) - len(distances)
    distance = torch.nn.functional.pad(distances, (first, 0), value=1.0)[rays]
    deviation = ((middles - distance).abs() / (MOST_DEVIATION * distance)).clamp_max(1.0)
    return torch.zeros_like(transmittance).index_add(0, rays, weights * deviation)[first:] + transmittance[first:]


def scale_gradients(density: Tensor, rgb: Tensor, *, distance: Tensor, near: float) -> None:
    """Multiply the gradients that reach these tensors by min(1, (distance / near)^2).

    Space near a camera is crossed by many of its rays and by no other camera's: without this it learns faster than the
    space that all cameras see, and fog grows in front of the lenses.
    Source: Philip and Deschaintre 2023, Floaters no more, arXiv:2305.02756, eq. 6.
    """
    scale = (distance / near).square().clamp_max(1.0)
    density.register_hook(lambda gradient: gradient * scale)
    rgb.register_hook(lambda gradient: gradient * scale[:, None])
