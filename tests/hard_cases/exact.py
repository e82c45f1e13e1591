"""Answers for rays in 60 decimal digits, by the definitions, from exactly the numbers that the kernels get."""

from dataclasses import dataclass
from decimal import Decimal, localcontext
from itertools import accumulate

from nerfcli.kernels.selftest.cases import Segments

DIGITS = 60


@dataclass(frozen=True)
class Composited:
    """Answers of one ray; see `composited`."""

    weights: list[float]
    transmittance: float
    colour: list[float]
    density_gradient: list[float]
    density_gradient_size: list[float]
    optical_depth: float


def composited(
    ray: Segments,
    rgb: list[list[float]],
    background: list[float],
    *,
    colour_gradient: list[float],
    transmittance_gradient: float,
    weights_gradient: list[float],
) -> Composited:
    """Return weights, transmittance and colour of a ray, and the gradient of a weighted sum of them.

    loss = sum_c gc_c colour_c + gt T + sum_i gw_i w_i, with the gradient
    d loss / d density_k = length_k (T_(k+1) v_k - sum_(i>k) w_i v_i - T (gc . background + gt)),
    v_i = gc . rgb_i + gw_i.

    `density_gradient_size` is the same sum with absolute values; the gradient's rounding error is proportional to it.
    """
    with localcontext() as context:
        context.prec = DIGITS
        passing, weights, after, tau = Decimal(1), [], [], Decimal(0)
        for sigma, length in zip(ray.density, ray.lengths, strict=True):
            own = Decimal(sigma) * Decimal(length)
            through = (-own).exp()
            weights.append(passing * (1 - through))
            passing *= through
            after.append(passing)
            tau += own
        columns = list(zip(*rgb, strict=True)) or [()] * len(background)
        colour = [
            sum((w * Decimal(c) for w, c in zip(weights, column, strict=True)), passing * Decimal(b))
            for column, b in zip(columns, background, strict=True)
        ]
        gains = [Decimal(g) for g in colour_gradient]
        values = [
            sum((g * Decimal(c) for g, c in zip(gains, pixel, strict=True)), Decimal(own))
            for pixel, own in zip(rgb, weights_gradient, strict=True)
        ]
        behind = passing * sum(
            (g * Decimal(b) for g, b in zip(gains, background, strict=True)), Decimal(transmittance_gradient)
        )
        size = abs(behind)
        gradient, sizes = [], []
        for k in range(len(weights) - 1, -1, -1):
            length = Decimal(ray.lengths[k])
            gradient.append(float(length * (after[k] * values[k] - behind)))
            sizes.append(float(length * (abs(after[k] * values[k]) + size)))
            behind += weights[k] * values[k]
            size += abs(weights[k] * values[k])
        return Composited(
            weights=[float(w) for w in weights],
            transmittance=float(passing),
            colour=[float(c) for c in colour],
            density_gradient=gradient[::-1],
            density_gradient_size=sizes[::-1],
            optical_depth=float(tau),
        )


def optical_depths(ray: Segments) -> list[float]:
    """Return the optical depth in front of each interval of a ray, and that of the whole ray."""
    with localcontext() as context:
        context.prec = DIGITS
        parts = (Decimal(sigma) * Decimal(length) for sigma, length in zip(ray.density, ray.lengths, strict=True))
        return [float(depth) for depth in accumulate(parts, initial=Decimal(0))]


def distortion(weights: list[float], starts: list[float], ends: list[float]) -> tuple[float, list[float]]:
    """Return sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 length_i / 3 of one ray, and its gradient by the weights."""
    with localcontext() as context:
        context.prec = DIGITS
        w = [Decimal(x) for x in weights]
        middles = [(Decimal(a) + Decimal(b)) / 2 for a, b in zip(starts, ends, strict=True)]
        lengths = [Decimal(b) - Decimal(a) for a, b in zip(starts, ends, strict=True)]
        apart = [sum((wj * abs(m - mj) for wj, mj in zip(w, middles, strict=True)), Decimal(0)) for m in middles]
        value = sum((wi * (a + wi * n / 3) for wi, a, n in zip(w, apart, lengths, strict=True)), Decimal(0))
        gradient = [float(2 * (a + wi * n / 3)) for wi, a, n in zip(w, apart, lengths, strict=True)]
        return float(value), gradient
