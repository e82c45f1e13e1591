"""Statistics and verdicts of `uncertainty.py`, fixed before any result was seen.

Notation: M members, P pixels, s standard deviation between members (ddof 1), m their mean, z the true distance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

RATIOS = np.linspace(0.0, 1.0, 100, endpoint=False)
LEVELS = (0.5, 0.9)
# Fewer pixels than this have no statistics, in a stratum or in all of a replicate.
LEAST_PIXELS = 50
NLL_FLOOR = 0.001
WRONG = 0.05
YES, LABEL_ONLY, NO, UNDECIDED = "YES", "LABEL ONLY", "NO", "undecided"


def sparsification(error: np.ndarray, uncertainty: np.ndarray, *, seed: int = 0) -> np.ndarray:
    """Return the mean error (100,) of the remaining pixels when the most uncertain 0, 1, ..., 99 % are removed.

    Pixels of the same uncertainty are removed in random order.
    """
    ties = np.random.default_rng(seed).random(len(error))
    ordered = error[np.lexsort((ties, uncertainty))]
    means = np.cumsum(ordered) / np.arange(1, len(error) + 1)
    left = np.floor((1.0 - RATIOS) * len(error) + 1e-9).astype(int)
    return means[np.maximum(1, left) - 1]


def ause(error: np.ndarray, uncertainty: np.ndarray) -> float:
    """Return the area between the sparsification curves by the uncertainty and by the error itself, in units of error.

    Source: Ilg et al. 2018, arXiv:1802.07095, section 4; with the 100 steps of the code of Bayes' Rays (Goli et al.
    2024, arXiv:2309.03185), which divides both curves by their common maximum. This does not.
    """
    gap = sparsification(error, uncertainty) - sparsification(error, error)
    return float(np.trapezoid(gap, RATIOS))


def aurg(error: np.ndarray, uncertainty: np.ndarray) -> float:
    """Return the area between the mean error, as under random removal, and the curve by the uncertainty."""
    return float(np.trapezoid(error.mean() - sparsification(error, uncertainty), RATIOS))


def ause_of_views(error: np.ndarray, uncertainty: np.ndarray, views: np.ndarray) -> float:
    """Return AUSE as in the code of Bayes' Rays: the mean over views, with both curves divided by their maximum.

    Args:
        error, uncertainty: (P,).
        views: (P,) number of the view of each pixel; those with fewer than `LEAST_PIXELS` pixels do not count.
    """
    found = []
    for view in np.unique(views):
        rows = views == view
        if rows.sum() < LEAST_PIXELS:
            continue
        ours, best = sparsification(error[rows], uncertainty[rows]), sparsification(error[rows], error[rows])
        found.append(np.trapezoid(ours - best, RATIOS) / max(ours.max(), best.max()))
    return float(np.mean(found)) if found else float("nan")


def variance_fraction(members: np.ndarray, true: np.ndarray) -> float:
    """Return v = mean(s^2) / (mean(s^2) + mean((m - z)^2)), the fraction of the squared error that is variance.

    If the truth is distributed like another member, v is M / (2 M + 1), nearly a half.

    Args:
        members: (M, P).
        true: (P,).
    """
    variance, bias = members.var(axis=0, ddof=1).mean(), ((members.mean(axis=0) - true) ** 2).mean()
    return float(variance / (variance + bias))


def in_reaches(members: np.ndarray, true: np.ndarray, *, level: float) -> np.ndarray:
    """Return |m - z| / (t s sqrt(1 + 1/M)), at most 1 inside the interval; t: Student's quantile, M - 1 degrees."""
    count = len(members)
    reach = stats.t.ppf(0.5 * (1.0 + level), count - 1) * members.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / count)
    return np.abs(members.mean(axis=0) - true) / np.maximum(reach, np.finfo(float).tiny)


def held_by_interval(members: np.ndarray, true: np.ndarray, *, level: float, widened: float = 1.0) -> float:
    """Return the fraction of true values in m +- t s sqrt(1 + 1/M), or in an interval `widened` times as wide."""
    return float((in_reaches(members, true, level=level) <= widened).mean())


def log_likelihood_loss(members: np.ndarray, true: np.ndarray) -> float:
    """Return the mean negative log likelihood of the truth under a normal of m and s, with s at least a millimetre."""
    spread = np.maximum(members.std(axis=0, ddof=1), NLL_FLOOR)
    return float(-stats.norm.logpdf(true, members.mean(axis=0), spread).mean())


def area_under_roc(values: np.ndarray, positive: np.ndarray) -> float:
    """Return the probability that a positive has a larger value than a negative, ties counting half."""
    ones, zeros = int(positive.sum()), int((~positive).sum())
    if min(ones, zeros) < LEAST_PIXELS:
        return float("nan")
    return float((stats.rankdata(values)[positive].mean() - 0.5 * (ones + 1)) / zeros)


def ranks(values: np.ndarray) -> np.ndarray:
    """Return the ranks of values, scaled to 0 to 1, with mean ranks for ties."""
    return (stats.rankdata(values) - 0.5) / len(values)


def rank_correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Return Spearman's correlation; NaN for few pixels or constant values."""
    if len(one) < LEAST_PIXELS or np.ptp(one) == 0 or np.ptp(other) == 0:
        return float("nan")
    return float(np.corrcoef(stats.rankdata(one), stats.rankdata(other))[0, 1])


def sign_flip(differences: np.ndarray) -> float:
    """Return the exact p-value, over all sign flips of replicates, of a mean difference this far below 0."""
    differences = differences[np.isfinite(differences)]
    if len(differences) < 2:
        return float("nan")
    result = stats.permutation_test(
        (differences,), np.mean, permutation_type="samples", n_resamples=2**20, alternative="less"
    )
    return float(result.pvalue)


def mean_with_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Return the mean over replicates and its 95 % interval, percentiles of 9,999 bootstrap draws."""
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return (float(values.mean()) if len(values) else float("nan"), float("nan"), float("nan"))
    found = stats.bootstrap((values,), np.mean, method="percentile", rng=np.random.default_rng(0)).confidence_interval
    return float(values.mean()), float(found.low), float(found.high)


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """Return p-values adjusted for multiple tests. Source: Holm 1979, Scandinavian Journal of Statistics 6, 65-70."""
    adjusted, largest = {}, 0.0
    for place, name in enumerate(sorted(p_values, key=lambda name: p_values[name])):
        largest = max(largest, min(1.0, (len(p_values) - place) * p_values[name]))
        adjusted[name] = largest
    return adjusted


@dataclass(frozen=True)
class Summary:
    """The numbers that decide the verdict on a kind of ensemble, over all replicates.

    Args:
        held: fraction of true values in 90 % intervals in U0.
        v_unseen, v_seen: `variance_fraction` in U0 and in D.
        correlation: Spearman's, of spread and error inside U0: mean and its interval.
        marks: area under the ROC of the spread, U0 against D.
        p_of_ause: p-value of AUSE below that of coverage, adjusted by `holm`.
        ause_difference: mean of AUSE of the spread minus that of coverage.
    """

    held: float
    v_unseen: float
    v_seen: float
    correlation: tuple[float, float, float]
    marks: float
    p_of_ause: float
    ause_difference: float


def verdict(found: Summary) -> str:
    """Return the verdict on a kind of ensemble where no photo looked.

    YES, it measures the error: in U0 90 % intervals hold at least 80 %, v(U0) is within a factor 2 of v(D), the rank
    correlation in U0 is at least 0.3 with an interval above 0, and AUSE is below that of coverage (p < 0.05).
    LABEL ONLY, it marks what is unseen and does not measure: area under the ROC at least 0.8, but the interval of the
    correlation is not above 0, or v(U0) < 0.3.
    NO, it shows what repeated optimisation disagrees on: v(U0) < 0.1, or 90 % intervals hold less than 50 %, or AUSE is
    not below that of coverage.
    The rules apply in this order: a kind that marks the unseen and also meets a rule of NO is LABEL ONLY.
    """
    mean, low, _ = found.correlation
    if (
        found.held >= 0.8
        and 0.5 <= found.v_unseen / found.v_seen <= 2.0
        and mean >= 0.3
        and low > 0.0
        and found.p_of_ause < 0.05
        and found.ause_difference < 0.0
    ):
        return YES
    if found.marks >= 0.8 and (not low > 0.0 or found.v_unseen < 0.3):
        return LABEL_ONLY
    if found.v_unseen < 0.1 or found.held < 0.5 or not found.ause_difference < 0.0:
        return NO
    return UNDECIDED


def permuted(maps: Sequence[np.ndarray], index: int, *, seed: int = 0) -> np.ndarray:
    """Return draws from the next replicate's uncertainty, as many as this one has pixels: an uninformed control."""
    other = maps[(index + 1) % len(maps)]
    return np.random.default_rng(seed).choice(other, len(maps[index]))
