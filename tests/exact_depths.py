"""Depths of a ray in 60 decimal digits, by the definitions.

Notation: interval k has density sigma_k, length L_k, weight w_k, and mean depth m_k with variance v_k; x = sigma_k L_k.
"""

import functools
from dataclasses import dataclass
from decimal import Decimal, localcontext
from itertools import pairwise
from typing import NamedTuple

from exact_answers import DIGITS

from nerfcli.kernels.selftest.cases import Ray
from nerfcli.kernels.selftest.operations import QUANTILES

# Optical depth below which sixty digits are too few for the closed forms of mean and variance.
_THIN = Decimal("1e-15")


@dataclass(frozen=True)
class RayTermination:
    """The depths of a ray, NaN where undefined: opacity, transmittance, conditional, spread, max-weight, and
    `QUANTILES`; and the start of the interval in which most light ends."""

    depths: dict[str, float]
    anchor: float


class _Interval(NamedTuple):
    sigma: Decimal
    start: Decimal
    length: Decimal
    before: Decimal
    weight: Decimal
    mean: Decimal
    variance: Decimal

    @property
    def depth(self) -> Decimal:
        return self.sigma * self.length


def ray_termination(ray: Ray) -> RayTermination:
    """Return every depth of a ray; the ray's numbers are not rounded."""
    with localcontext() as context:
        context.prec = DIGITS
        intervals = _intervals(tuple(ray.density), tuple(ray.starts), tuple(ray.ends))
        left = (-sum((one.depth for one in intervals), Decimal(0))).exp()
        depths = dict.fromkeys(("conditional", "spread", "max-weight"), Decimal("NaN"))
        depths |= {"opacity": 1 - left, "transmittance": left}
        mass = sum((one.weight for one in intervals), Decimal(0))
        anchor = Decimal("NaN")
        if mass:
            peak = max(one.weight for one in intervals)
            # Weights this close are equal but for rounding; the nearest of them counts as the heaviest.
            heaviest = next(one for one in intervals if one.weight >= peak * (1 - _THIN))
            mean = sum((one.weight * one.mean for one in intervals), Decimal(0)) / mass
            squares = (one.weight * (one.variance + (one.mean - mean) ** 2) for one in intervals)
            spread = (sum(squares, Decimal(0)) / mass).sqrt()
            depths |= {"conditional": mean, "spread": spread, "max-weight": heaviest.mean}
            anchor = heaviest.start
        for name, fraction in QUANTILES.items():
            target = _target(fraction)
            k = _crossed(intervals, target)
            one = None if k is None else intervals[k]
            depths[name] = Decimal("NaN") if one is None else one.start + (target - one.before) / one.sigma
        return RayTermination({name: float(depth) for name, depth in depths.items()}, float(anchor))


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
        weight = (-tau).exp() * (1 - (-own).exp())
        found.append(_Interval(sigma, start, length, tau, weight, mean, variance))
        tau += own
    return tuple(found)


def _target(fraction: float) -> Decimal:
    """Return the optical depth at which a fraction of all light has ended."""
    return -(1 - Decimal(fraction)).ln()


def _crossed(intervals: tuple[_Interval, ...], target: Decimal) -> int | None:
    """Return the index of the interval in which an optical depth is reached, or None if none reaches it."""
    return next((k for k, one in enumerate(intervals) if one.before + one.depth >= target), None)
