"""Fit the similarity that maps one set of points to another: by least squares, or by least squares without outliers.

Notation: x are the points of frame a and y those of frame b, with means mx and my; y = s R x + t + noise, and sigma is
the noise's standard deviation per coordinate.
"""

from dataclasses import dataclass
from functools import cache
from itertools import combinations
from math import comb

import numpy as np

from nerfcli.cameras.rigid import Similarity

# Number of hypotheses, from three points each; even with half of the points outliers, one in eight has none.
_TRIPLES = 200

# Squared length of noise in three dimensions, in sigma^2 (chi^2 with 3 degrees of freedom): median, 99.9 % quantile.
_MEDIAN, _QUANTILE_999 = 2.366, 16.266

_PARAMETERS = 7


@dataclass(frozen=True)
class Alignment:
    """A robust alignment: b_from_a, the mask (N,) bool of inliers, and sigma in units of b (NaN below 4 points)."""

    b_from_a: Similarity
    follows: np.ndarray
    sigma: float


def align(x: np.ndarray, y: np.ndarray) -> Similarity:
    """Return the similarity b_from_a that minimises sum |y - (s R x + t)|^2.

    If the points are on a line, R is not unique; for two points, s is the ratio of their distances.

    Args:
        x, y: (N, 3), N >= 2.

    Raises:
        ValueError: fewer than two points, or all x are equal.

    Source: Umeyama 1991, Least-squares estimation of transformation parameters between two point patterns.
    """
    variance = np.sum((x - x.mean(axis=0)) ** 2)
    if len(x) < 2 or not variance > 0:
        raise ValueError(f"align needs two points apart, got {len(x)} with a variance of {variance}")
    (scale,), (rotation,), (translation,) = _aligned(x[None], y[None])
    return Similarity(float(scale), rotation, translation)


def _aligned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return scales, rotations and translations as `align` of many sets of points, (sets, N, 3), none in one place."""
    mx, my = x.mean(axis=1), y.mean(axis=1)
    from_mx, from_my = x - mx[:, None], y - my[:, None]
    u, d, vt = np.linalg.svd(np.swapaxes(from_my, 1, 2) @ from_mx)
    sign = np.ones_like(d)
    sign[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotations = (u * sign[:, None]) @ vt
    scales = np.sum(d * sign, axis=1) / np.sum(from_mx**2, axis=(1, 2))
    translations = my - scales[:, None] * (rotations @ mx[..., None])[..., 0]
    return scales, rotations, translations


def align_robustly(x: np.ndarray, y: np.ndarray) -> Alignment:
    """Return `align` of the inliers: the points within the 99.9 % quantile of the noise, which is estimated too.

    It starts from the best of 200 alignments of three points each, by median residual (Rousseeuw 1984), so up to half
    of the points may be wrong. Below 5 points, outliers cannot be found, and all points count. Deterministic.
    """
    count = len(x)
    everywhere = np.ones(count, dtype=bool)
    best = align(x, y)
    if count < 5:
        return Alignment(best, everywhere, _sigma(best, x, y))
    half = (count + 4) // 2 - 1  # half of the points beyond the three that define an alignment must agree
    least = np.partition(_squared(best, x, y), half)[half]
    triples = _triples(count)
    apart = np.ptp(x[triples], axis=1).max(axis=1) > 0
    scales, rotations, translations = _aligned(x[triples[apart]], y[triples[apart]])
    medians = [np.array([least])]
    at_once = max(1, 100_000 // count)  # limits memory
    for some in (slice(first, first + at_once) for first in range(0, len(scales), at_once)):
        off = scales[some, None, None] * (rotations[some] @ x.T) + translations[some, :, None] - y.T  # (some, 3, N)
        medians.append(np.partition(np.sum(off**2, axis=1), half, axis=1)[:, half])
    joined = np.concatenate(medians)
    chosen = int(np.nanargmin(joined)) - 1
    if chosen >= 0:
        best, least = Similarity(float(scales[chosen]), rotations[chosen], translations[chosen]), joined[chosen + 1]
    # Rousseeuw's correction for few points.
    sigma = np.sqrt(least / _MEDIAN) * (1 + 5 / (count - _PARAMETERS / 3))
    follows = everywhere
    for _ in range(30):
        now = _squared(best, x, y) <= _QUANTILE_999 * sigma**2 + 1e-18 * np.var(y)
        if now.sum() < half + 1 or np.array_equal(now, follows) or np.ptp(x[now], axis=0).max() == 0:
            break
        follows = now
        best = align(x[follows], y[follows])
        sigma = max(_sigma(best, x[follows], y[follows]), sigma / 2)
    best = align(x[follows], y[follows])
    return Alignment(best, follows, _sigma(best, x[follows], y[follows]))


def _squared(b_from_a: Similarity, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.sum((b_from_a.apply(x) - y) ** 2, axis=1)


def _sigma(b_from_a: Similarity, x: np.ndarray, y: np.ndarray) -> float:
    """Estimate sigma from the residuals and the remaining degrees of freedom; NaN below 4 points."""
    free = 3 * len(x) - _PARAMETERS
    return float(np.sqrt(_squared(b_from_a, x, y).sum() / free)) if len(x) >= 4 else float("nan")


@cache
def _triples(count: int) -> np.ndarray:
    """Return the indices (triples, 3) of the points that define the hypotheses."""
    if comb(count, 3) <= _TRIPLES:
        return np.array(list(combinations(range(count), 3)))
    rng = np.random.default_rng(0)
    return np.array([rng.choice(count, 3, replace=False) for _ in range(_TRIPLES)])
