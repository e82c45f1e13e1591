"""The formulas as textbooks and most programs write them, to show what each improvement of the kernels gains.

Nothing here is used for rendering. Every function takes the arguments of its counterpart in `nerfcli.kernels`.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

# From published codes: added to 1 - alpha, and the lower bound of the sum of weights.
EPS = 1e-10
# The quantiles of `depth`, by name.
QUANTILES = {"median": 0.5, "0.05": 0.05, "0.95": 0.95}


def composite(
    density: Tensor, rgb: Tensor, lengths: Tensor, *, offsets: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Composite: alpha = 1 - exp(-density length), T = prod(1 - alpha + 1e-10), background by 1 - sum of weights.

    Source: Mildenhall et al. 2020, its published code, raw2outputs.
    """
    weights = _weights_of_all(density, lengths, offsets)
    opacity = torch.stack([part.sum() for (part,) in _split(offsets, weights)])
    colour = torch.stack([(w[:, None] * c).sum(0) for w, c in _split(offsets, weights, rgb)])
    return colour + (1.0 - opacity)[:, None] * background, 1.0 - opacity, weights


def weights_of_ray(density: Tensor, lengths: Tensor) -> Tensor:
    """Compute the weights of one ray."""
    alpha = 1.0 - torch.exp(-density * lengths)
    passing = torch.cumprod(torch.cat([torch.ones_like(alpha[:1]), 1.0 - alpha + EPS]), dim=0)
    return alpha * passing[:-1]


def depth(density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor) -> dict[str, Tensor]:
    """Compute depths at midpoints, with a clamped sum of weights: sum w m / max(sum w, 1e-10) for the mean.

    "max-weight" is the midpoint of the interval of the largest weight, and a quantile that of the interval in which the
    sum of the weights reaches its fraction of 1, or of the last one.
    """
    weights = _weights_of_all(density, ends - starts, offsets)
    answers: dict[str, list[Tensor]] = {
        name: [] for name in ("opacity", "transmittance", "conditional", "spread", "max-weight", *QUANTILES)
    }
    for w, m in _split(offsets, weights, (starts + ends) / 2):
        total = w.sum()
        mean = (w * m).sum() / total.clamp_min(EPS)
        answers["opacity"].append(total)
        answers["transmittance"].append(1.0 - total)
        answers["conditional"].append(mean)
        answers["spread"].append(((w * m * m).sum() / total.clamp_min(EPS) - mean * mean).sqrt())
        answers["max-weight"].append(m[w.argmax()] if len(w) else torch.zeros_like(mean))
        for name, fraction in QUANTILES.items():
            crossing = (w.cumsum(0) < fraction).sum().clamp_max(max(0, len(w) - 1))
            answers[name].append(m[crossing] if len(w) else torch.zeros_like(mean))
    return {name: torch.stack(values) for name, values in answers.items()}


def optical_depth_before(density: Tensor, lengths: Tensor, *, offsets: Tensor) -> Tensor:
    """Return the cumulative sum of density * length, minus the interval's own term."""
    return torch.cat([(d * n).cumsum(0) - d * n for d, n in _split(offsets, density, lengths)])


def distortion(weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
    """Compute the distortion of one ray by running sums: 2 sum w_i (m_i W_i - M_i) + sum w_i^2 length_i / 3."""
    middles = (starts + ends) / 2
    before, moment = (x.cumsum(0) - x for x in (weights, weights * middles))
    return (2 * weights * (middles * before - moment) + weights.square() * (ends - starts) / 3).sum()


def contract(points: Tensor) -> Tensor:
    """Contract points: x inside the unit ball, (2 - 1 / |x|) x / |x| outside, chosen by `torch.where`."""
    norm = points.square().sum(-1, keepdim=True).sqrt()
    return torch.where(norm <= 1.0, points, (2.0 - 1.0 / norm) * points / norm)


def _split(offsets: Tensor, *packed: Tensor) -> Iterator[tuple[Tensor, ...]]:
    counts = offsets.diff().tolist()
    return zip(*(values.split(counts) for values in packed), strict=True)


def _weights_of_all(density: Tensor, lengths: Tensor, offsets: Tensor) -> Tensor:
    return torch.cat([weights_of_ray(*of_ray) for of_ray in _split(offsets, density, lengths)])
