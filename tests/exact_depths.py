"""Depths of a ray and their density gradients in 60 decimal digits, by the definitions.

Notation: interval k has density sigma_k, length L_k, weight w_k, and mean depth m_k with variance v_k;
x = sigma_k L_k; T_k is the transmittance of the first k intervals; W is the sum of all weights.
"""

import functools
from dataclasses import dataclass
from decimal import Decimal, localcontext
from itertools import pairwise
from typing import NamedTuple

from exact_answers import DIGITS

from nerfcli.kernels.selftest.cases import Ray
from nerfcli.kernels.selftest.textbook import QUANTILES

# Optical depths below which sixty digits are too few for the closed forms: of mean and variance, and of the
# variance's derivative.
_THIN, _THIN_SLOPE = Decimal("1e-15"), Decimal("1e-6")
# Optical depths from which kernels use the closed forms, with terms of size 1 / x^2 for a mean, 2 / x^3 for a variance.
_CLOSED_MEAN, _CLOSED_VARIANCE = Decimal("0.25"), Decimal(1)


@dataclass(frozen=True)
class Depth:
    """A depth of a ray, or its opacity, transmittance or spread.

    Args:
        value: NaN where undefined.
        gradient: by the density of each interval; zeros where the value is undefined.
        size: the gradient's sums with absolute values, and distances measured from the mean of the interval in which
            most light ends; the gradient's rounding error is proportional to them.
    """

    value: float
    gradient: list[float]
    size: list[float]


@dataclass(frozen=True)
class RayTermination:
    """The depths of a ray: opacity, transmittance, conditional, spread, max-weight, and `QUANTILES`; and the start of
    the interval in which most light ends, NaN without light."""

    depths: dict[str, Depth]
    anchor: float


class _Interval(NamedTuple):
    sigma: Decimal
    start: Decimal
    length: Decimal
    before: Decimal
    weight: Decimal
    passed: Decimal
    mean: Decimal
    variance: Decimal

    @property
    def depth(self) -> Decimal:
        return self.sigma * self.length


def ray_termination(ray: Ray) -> RayTermination:
    """Return every depth of a ray and its gradient; the ray's numbers are not rounded."""
    with localcontext() as context:
        context.prec = DIGITS
        return _ray_termination(_intervals(tuple(ray.density), tuple(ray.starts), tuple(ray.ends)))


@functools.cache
def _ray_termination(intervals: tuple[_Interval, ...]) -> RayTermination:
    tau = sum((one.depth for one in intervals), Decimal(0))
    left = (-tau).exp()
    slopes = [one.length * left for one in intervals]
    depths = {"opacity": _depth(1 - left, slopes, slopes)}
    depths["transmittance"] = _depth(left, [-x for x in slopes], slopes)
    mass = sum((one.weight for one in intervals), Decimal(0))
    peak = max((one.weight for one in intervals), default=Decimal(0))
    # Weights this close are equal but for rounding; the nearest of them counts as the heaviest.
    near = [k for k, one in enumerate(intervals) if one.weight > 0 and one.weight >= peak * (1 - _THIN)]
    if mass:
        depths |= _moments(intervals, mass, intervals[near[0]].mean)
        one = intervals[near[0]]
        slopes = [-one.variance if k == near[0] else Decimal(0) for k in range(len(intervals))]
        sizes = [_mean_slope_size(one) if k == near[0] else Decimal(0) for k in range(len(intervals))]
        depths["max-weight"] = _depth(one.mean, slopes, sizes)
    else:
        depths |= dict.fromkeys(("conditional", "spread", "max-weight"), _undefined(intervals))
    depths |= {name: _quantile(intervals, _target(fraction)) for name, fraction in QUANTILES.items()}
    return RayTermination(depths, float(intervals[near[0]].start) if near else float("nan"))


def is_settled(ray: Ray, fraction: float, *, within: float) -> bool:
    """Return whether a quantile changes smoothly under a relative error `within` of the optical depths.

    Beside a gap, an interval of another density or the end of the light, it would jump.
    """
    with localcontext() as context:
        context.prec = DIGITS
        intervals, target = _intervals(tuple(ray.density), tuple(ray.starts), tuple(ray.ends)), _target(fraction)
        least, most = (_crossed(intervals, target * (1 + Decimal(x))) for x in (-within, within))
        if least is None or most is None:
            return least is most
        gapless = all(a.start + a.length == b.start for a, b in pairwise(intervals[least : most + 1]))
        return gapless and len({one.sigma for one in intervals[least : most + 1]}) == 1


@functools.cache
def _intervals(*columns: tuple[float, ...]) -> tuple[_Interval, ...]:
    """Return the intervals of densities, starts and ends; cached, as several precisions and tests share rays."""
    tau, found = Decimal(0), []
    for sigma, start, end in zip(*(map(Decimal, values) for values in columns), strict=True):
        length = end - start
        own = sigma * length
        if own < _THIN:
            mean, variance = start + length / 2 - own * length / 12, length**2 / 12
        else:
            mean = start + 1 / sigma - length / (own.exp() - 1)
            variance = 1 / sigma**2 - length**2 * own.exp() / (own.exp() - 1) ** 2
        passing, through = (-tau).exp(), (-own).exp()
        found.append(_Interval(sigma, start, length, tau, passing * (1 - through), passing * through, mean, variance))
        tau += own
    return tuple(found)


def _moments(intervals: tuple[_Interval, ...], mass: Decimal, place: Decimal) -> dict[str, Depth]:
    """Return mean m and spread S, with d w_i / d sigma_k = L_k (T_(k+1) for i = k, -w_i for i > k) and d m_k = -v_k.

    d m / d sigma_k = sum_i d w_i (m_i - m) / W - w_k v_k / W
    d S^2 / d sigma_k = sum_i d w_i (v_i + (m_i - m)^2 - S^2) / W + w_k (d v_k - 2 (m_k - m) v_k) / W
    """
    mean = sum((one.weight * one.mean for one in intervals), Decimal(0)) / mass
    squares = [one.variance + (one.mean - mean) ** 2 for one in intervals]
    variance = sum((one.weight * q for one, q in zip(intervals, squares, strict=True)), Decimal(0)) / mass
    spread = variance.sqrt()
    away = sum((one.weight * abs(one.mean - place) for one in intervals), Decimal(0)) / mass
    reach = [abs(one.mean - place) + away for one in intervals]
    by_mean = _by_weights(intervals, [one.mean - mean for one in intervals])
    mean_size = _by_weights(intervals, reach, absolute=True)
    by_square = _by_weights(intervals, [q - variance for q in squares])
    wide = [one.variance + r * r + variance for one, r in zip(intervals, reach, strict=True)]
    square_size = _by_weights(intervals, wide, absolute=True)
    slopes, sizes, of_spread, spread_sizes = [], [], [], []
    for k, one in enumerate(intervals):
        slopes.append((by_mean[k] - one.weight * one.variance) / mass)
        sizes.append((mean_size[k] + one.weight * _mean_slope_size(one)) / mass)
        own = _variance_slope(one) - 2 * (one.mean - mean) * one.variance
        own_size = _variance_slope_size(one) + 2 * reach[k] * _mean_slope_size(one)
        of_spread.append((by_square[k] + one.weight * own) / mass / (2 * spread))
        spread_sizes.append(((square_size[k] + one.weight * own_size) / mass + 2 * away * sizes[k]) / (2 * spread))
    return {"conditional": _depth(mean, slopes, sizes), "spread": _depth(spread, of_spread, spread_sizes)}


def _by_weights(intervals: tuple[_Interval, ...], values: list[Decimal], *, absolute: bool = False) -> list[Decimal]:
    """Return sum_i values_i d w_i / d sigma_k for each k, or the sum of the terms' absolute values."""
    behind, found = Decimal(0), []
    for one, value in zip(reversed(intervals), reversed(values), strict=True):
        found.append(one.length * (one.passed * value + (behind if absolute else -behind)))
        behind += one.weight * value
    return found[::-1]


def _mean_slope_size(one: _Interval) -> Decimal:
    """Return the terms' size in d m_k / d sigma_k = -v_k, whose closed form subtracts terms of size 1 / x^2."""
    return one.variance if one.depth < _CLOSED_MEAN else (one.length / one.depth) ** 2


def _variance_slope(one: _Interval) -> Decimal:
    """d v_k / d sigma_k = L^3 h'(x), h' = -2 / x^3 + e^-x (1 + e^-x) / (1 - e^-x)^3 = -x / 120 + x^3 / 1512 - ..."""
    x = one.depth
    if x < _THIN_SLOPE:
        return one.length**3 * (x**3 / 1512 - x / 120)
    falling = (-x).exp()
    return one.length**3 * (falling * (1 + falling) / (1 - falling) ** 3 - 2 / x**3)


def _variance_slope_size(one: _Interval) -> Decimal:
    slope = abs(_variance_slope(one))
    return slope if one.depth < _CLOSED_VARIANCE else 2 * (one.length / one.depth) ** 3


def _quantile(intervals: tuple[_Interval, ...], target: Decimal) -> Depth:
    """Return t = start + (target - tau) / sigma in the interval k that crosses the target."""
    k = _crossed(intervals, target)
    if k is None:
        return _undefined(intervals)
    one = intervals[k]
    inside = (target - one.before) / one.sigma
    before = [earlier.length / one.sigma for earlier in intervals[:k]]
    none = [Decimal(0)] * (len(intervals) - k - 1)
    size = (target + one.before) / one.sigma**2
    slopes = [*(-x for x in before), -inside / one.sigma, *none]
    return _depth(one.start + inside, slopes, [*before, size, *none])


def _target(fraction: float) -> Decimal:
    """Return the optical depth at which a fraction of all light has ended."""
    return -(1 - Decimal(fraction)).ln()


def _crossed(intervals: tuple[_Interval, ...], target: Decimal) -> int | None:
    """Return the index of the interval in which an optical depth is reached, or None if none reaches it."""
    return next((k for k, one in enumerate(intervals) if one.before + one.depth >= target), None)


def _depth(value: Decimal, gradient: list[Decimal], size: list[Decimal]) -> Depth:
    return Depth(float(value), [float(x) for x in gradient], [float(x) for x in size])


def _undefined(intervals: tuple[_Interval, ...]) -> Depth:
    zeros = [0.0] * len(intervals)
    return Depth(float("nan"), zeros, zeros)
