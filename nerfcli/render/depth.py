"""Five meanings of "the depth of a ray". They differ wherever a ray meets more than one surface or none.

For a ray with density sigma(t), transmittance T(t) and end density p(t) = T(t) sigma(t), whose integral is the
opacity:

    moment       integral of t p(t): small where the ray is not opaque; a building block, not a distance
    conditional  moment / opacity: the mean place where light ends, given that it ends
    background   moment + T * background distance: the mean with what passes counted at the background
    max-weight   the mean place inside the interval with the largest weight
    median       where half of all light has ended: T(t) = 1/2

Density is constant inside an interval, and all five are exact for it: no midpoints. Packed samples as in
`kernels.reference`; distances are along the ray. What is undefined is NaN, never a plausible number.
"""

import math

import torch
from torch import Tensor

from nerfcli import kernels

CONVENTIONS = ("conditional", "moment", "background", "max-weight", "median")

# Below this optical depth the mean place is taken from its series, whose next term is then 5e-14.
SERIES_BELOW = 0.25


def mean_fraction(optical_depth: Tensor) -> Tensor:
    """Mean place, as a share of the interval, where light ends that ends inside an interval of constant density.

    g(x) = 1/x - 1/(exp(x) - 1), written as 1/x - exp(-x) / (1 - exp(-x)); 1/2 at 0, 1/x at infinity.

    Args:
        optical_depth: density * length, >= 0.

    Returns:
        The same shape, in (0, 1/2]. Relative error of some units of the dtype's precision everywhere.

    Differentiable, also at 0 (where the slope is -1/12) and for large arguments.
    """
    thin = optical_depth < SERIES_BELOW
    x = torch.where(thin, optical_depth, 0.0)
    x2 = x * x
    # Bernoulli numbers: g(x) = 1/2 - sum B_2n x^(2n - 1) / (2n)!
    tail = 1 / 30240 - x2 * (1 / 1209600 - x2 / 47900160)
    series = 0.5 - x * (1 / 12 - x2 * (1 / 720 - x2 * tail))
    y = torch.where(thin, 1.0, optical_depth)
    closed = 1.0 / y + torch.exp(-y) / torch.expm1(-y)
    return torch.where(thin, series, closed)


def interval_means(density: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
    """Mean distance (N,) where light ends that ends inside each interval: t0 + 1/s - d / (exp(s d) - 1).

    Differentiable in all arguments.
    """
    lengths = ends - starts
    return starts + lengths * mean_fraction(density * lengths)


def moment(weights: Tensor, means: Tensor, offsets: Tensor) -> Tensor:
    """sum_i weight_i * mean_i, (R,). Differentiable; 0 for a ray without samples."""
    return kernels.sum_along_rays(weights * means, offsets)


def conditional(weights: Tensor, means: Tensor, *, offsets: Tensor, opacity_floor: float) -> Tensor:
    """moment / opacity, (R,); NaN where the opacity is not above `opacity_floor` (>= 0).

    Differentiable where defined. The division is by the sum of the weights, so that weights that underflow
    together still give their mean.
    """
    opacity = kernels.sum_along_rays(weights, offsets)
    defined = opacity > opacity_floor
    mean = moment(weights, means, offsets) / torch.where(defined, opacity, 1.0)
    return torch.where(defined, mean, torch.nan)


def background_filled(
    weights: Tensor, means: Tensor, *, offsets: Tensor, transmittance: Tensor, background_distance: float
) -> Tensor:
    """moment + T * background_distance, (R,). Defined for every ray. Differentiable."""
    return moment(weights, means, offsets) + transmittance * background_distance


def max_weight(weights: Tensor, means: Tensor, *, offsets: Tensor, opacity_floor: float) -> Tensor:
    """`means` of the interval with the largest weight, the nearest of equals, (R,).

    NaN where the opacity is not above the floor. The choice depends on how the ray was cut into intervals.
    """
    rays = kernels.ray_indices(offsets)
    count = len(offsets) - 1
    largest = torch.zeros(count, dtype=weights.dtype, device=weights.device)
    largest = largest.scatter_reduce(0, rays, weights, "amax")
    candidates = torch.where(weights == largest[rays], means, torch.inf)
    nearest = torch.full((count,), torch.inf, dtype=means.dtype, device=means.device)
    nearest = nearest.scatter_reduce(0, rays, candidates, "amin")
    opacity = kernels.sum_along_rays(weights, offsets)
    return torch.where(opacity > opacity_floor, nearest, torch.nan)


def median(density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor) -> Tensor:
    """The distance at which the transmittance is 1/2, solved inside its interval, (R,).

    t = t0 + (log 2 - tau_before) / density in the interval where the optical depth passes log 2; NaN for a ray
    whose opacity stays below 1/2.
    """
    lengths = ends - starts
    before = kernels.optical_depth_before(density, lengths, offsets)
    reached = before + density * lengths >= math.log(2)
    inside = (math.log(2) - before) / torch.where(density > 0, density, 1.0)
    inside = torch.minimum(inside.clamp_min(0.0), lengths)
    distance = torch.where(reached, starts + inside, torch.inf)  # the nearest of these holds the crossing
    result = torch.full((len(offsets) - 1,), torch.inf, dtype=density.dtype, device=density.device)
    result = result.scatter_reduce(0, kernels.ray_indices(offsets), distance, "amin")
    return torch.where(result.isinf(), torch.nan, result)
