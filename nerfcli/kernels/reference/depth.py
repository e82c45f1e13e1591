"""Depth of rays: means, quantiles and spread of the distance of absorption, in plain torch, as definitions.

A ray has density sigma(t), transmittance T(t) and the density of absorption p(t) = T(t) sigma(t), whose integral is the
opacity. Density is constant inside an interval, and everything here is exact for that: no midpoints. Packed samples as
in `interface`; any dtype, without gradients. Only `ray_termination` has fast versions.
"""

import math

import torch
from torch import Tensor

from nerfcli.kernels.activations import opacity
from nerfcli.kernels.interface import RayTermination
from nerfcli.kernels.reference.compositing import interval_weights, optical_depth_before, ray_indices, sum_along_rays

# Below this optical depth the mean position is taken from its series, whose next term is then at most 5e-14.
SERIES_BELOW = 0.25
# The same for the variance, whose closed form loses 12 / x^2 units of precision; next term 9e-20.
VARIANCE_SERIES_BELOW = 1.0
# (2n - 1) B_2n / (2n)! with the Bernoulli numbers B, for n = 1, 2, ...
VARIANCE_SERIES = (
    *(1 / 12, -1 / 240, 1 / 6048, -1 / 172800, 1 / 5322240, -691 / 118879488000, 1 / 5748019200),
    *(-3617 / 711374856192000, 43867 / 300534953951232000, -174611 / 42255666457804800000),
    *(77683 / 671480954256752640000, -236364091 / 73644527683988855193600000),
)


def mean_fraction(optical_depth: Tensor) -> Tensor:
    """Compute the mean position of absorption within an interval of constant density, as a fraction of the interval.

    g(x) = 1/x - 1/(exp(x) - 1), written as 1/x - exp(-x) / (1 - exp(-x)); 1/2 at 0, 1/x at infinity.

    Returns:
        The same shape, in (0, 1/2]. Relative error of a few units of the dtype's precision everywhere.
    """
    x, x2 = optical_depth, optical_depth.square()
    # Bernoulli numbers: g(x) = 1/2 - sum B_2n x^(2n - 1) / (2n)!
    tail = 1 / 30240 - x2 * (1 / 1209600 - x2 / 47900160)
    series = 0.5 - x * (1 / 12 - x2 * (1 / 720 - x2 * tail))
    return torch.where(x < SERIES_BELOW, series, 1.0 / x + torch.exp(-x) / torch.expm1(-x))


def variance_fraction(optical_depth: Tensor) -> Tensor:
    """Return the variance of the position of absorption within an interval, in squared lengths of the interval.

    h(x) = -g'(x) = 1/x^2 - exp(-x) / (1 - exp(-x))^2; 1/12 at 0, 1/x^2 at infinity; see `mean_fraction`.

    Returns:
        The same shape, in (0, 1/12]. Relative error of about ten units of the dtype's precision everywhere.
    """
    x, x2, series = optical_depth, optical_depth.square(), torch.zeros_like(optical_depth)
    for coefficient in reversed(VARIANCE_SERIES):
        series = series * x2 + coefficient
    closed = (1.0 / x).square() - torch.exp(-x) / torch.expm1(-x).square()
    return torch.where(x < VARIANCE_SERIES_BELOW, series, closed)


def mean_and_spread(
    weights: Tensor, density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor
) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation (R,) of the distance of the absorbed light; NaN where none is absorbed.

    mean = sum_i w_i mean_i / sum_i w_i,  variance = sum_i w_i (variance_i + (mean_i - mean)^2) / sum_i w_i

    The variance is around the mean, so that nothing cancels, and for it positions are relative to the mean position of
    the heaviest interval: a distant, thin surface may be narrower than its distance's last digit. Both are divided by
    the sum of the weights, not by the opacity, so that weights close to underflow still give their mean.
    """
    total, lengths, rays = sum_along_rays(weights, offsets), ends - starts, ray_indices(offsets)
    total = torch.where(total > 0, total, torch.nan)
    inside = lengths * mean_fraction(density * lengths)
    first, further = (max_weight(weights, x, offsets)[rays] for x in (starts, inside))
    places = (starts - first) + (inside - further)
    middle = sum_along_rays(weights * places, offsets) / total
    apart = lengths.square() * variance_fraction(density * lengths) + (places - middle[rays]).square()
    spread = (sum_along_rays(weights * apart, offsets) / total).sqrt()
    return sum_along_rays(weights * (starts + inside), offsets) / total, spread


def max_weight(weights: Tensor, means: Tensor, offsets: Tensor) -> Tensor:
    """Return the mean of the interval with the largest weight, (R,), the nearest in a tie; NaN where none is absorbed.

    The only result that depends on how the ray was cut into intervals.
    """
    rays, nothing = ray_indices(offsets), means.new_full((len(offsets) - 1,), torch.inf)
    largest = weights.new_zeros(len(nothing)).scatter_reduce(0, rays, weights, "amax")
    heaviest = (weights == largest[rays]) & (weights > 0)
    nearest = nothing.scatter_reduce(0, rays, torch.where(heaviest, means, torch.inf), "amin")
    return torch.where(nearest.isinf(), torch.nan, nearest)


def quantile(density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, fraction: float) -> Tensor:
    """Compute the distance (R,) by which a fraction of a ray's light is absorbed, solved inside its interval.

    T(t) = 1 - fraction, so t = t0 + (-log(1 - fraction) - tau_before) / density in the interval where the optical depth
    passes -log(1 - fraction). The fraction, between 0 and 1, is one of all light, not of the absorbed light: NaN for a
    ray of less opacity.
    """
    target = -math.log1p(-fraction)
    lengths, rays = ends - starts, ray_indices(offsets)
    before = optical_depth_before(density, lengths, offsets)
    # The depth behind an interval is the one before the next, to the last bit: else rounding might find no crossing.
    behind = before + density * lengths
    behind = torch.cat([torch.where(rays[1:] == rays[:-1], before[1:], behind[:-1]), behind[-1:]])
    numbers = torch.arange(len(density), device=density.device)
    first = torch.full((len(offsets) - 1,), len(density), device=density.device)
    first = first.scatter_reduce(0, rays, torch.where(behind >= target, numbers, len(density)), "amin")
    found = first < len(density)
    crossed = first[found]
    inside = (target - before[crossed]) / torch.where(density > 0, density, 1.0)[crossed]
    result = torch.full((len(offsets) - 1,), torch.nan, dtype=density.dtype, device=density.device)
    # Rounding may put the crossing outside a thin interval.
    result[found] = starts[crossed] + torch.minimum(inside, lengths[crossed])
    return result


@torch.no_grad()
def ray_termination(
    density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, fractions: tuple[float, ...]
) -> RayTermination:
    """Compute all statistics of where the light of rays is absorbed, without gradients.

    Args:
        density: (N,) >= 0, finite; density * length from 0 to 1e6 and beyond.
        starts, ends: (N,) increasing along each ray.
        offsets: (R + 1,).
        fractions: of light for the quantiles, each between 0 and 1.

    Returns:
        opacity (R,), transmittance (R,); mean (R,) distance of the absorbed light, and its standard deviation `spread`
        (R,); peak (R,): `max_weight`; quantiles (R, len(fractions)). Undefined values are NaN, and no others.

    Opacity and transmittance keep full precision where they are small.
    """
    lengths = ends - starts
    weights, transmittance = interval_weights(density, lengths, offsets)
    mean, width = mean_and_spread(weights, density, starts, ends, offsets=offsets)
    total = opacity(sum_along_rays(density * lengths, offsets))
    columns = [quantile(density, starts, ends, offsets=offsets, fraction=fraction) for fraction in fractions]
    quantiles = torch.stack(columns, dim=-1) if columns else density.new_empty(len(offsets) - 1, 0)
    peak = max_weight(weights, starts + lengths * mean_fraction(density * lengths), offsets)
    return RayTermination(total, transmittance, mean, width, peak, quantiles)
