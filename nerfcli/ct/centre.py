"""The centre of rotation of a scan: the shift of the detector with which half of the views predict the others best."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nerfcli.ct.quick import Row, misfit

# Largest number of columns of the binned row for the search of the centre, and for its refinement.
COARSE, FINE = 80, 200
# The search covers this fraction of the detector's width to either side.
RANGE = 0.12
# Standard errors by which one hypothesis has to predict better than another.
SIGNIFICANT = 3.0
# Smaller shifts are not worth a correction.
LEAST_PX = 0.1
FEWEST_VIEWS = 8
_PRECISE_PX = 0.02


@dataclass(frozen=True)
class Centre:
    """The centre of rotation under one hypothesis.

    Args:
        shift: columns that the detector has to be moved by.
        errors: (views // 2,) mean squared errors of the views that were not fitted, at the best shift.
        at_stated: the same without a shift.
        error: standard error of the shift, in columns.
    """

    shift: float
    errors: np.ndarray
    at_stated: np.ndarray
    error: float

    @property
    def is_off(self) -> bool:
        """True if the shift predicts other views significantly better and exceeds `LEAST_PX` and twice its error."""
        by, _ = margin(self.errors, self.at_stated)
        return by > SIGNIFICANT and abs(self.shift) > max(LEAST_PX, 2 * self.error)


def centre_of(row: Row, *, mirrored: bool = False) -> Centre:
    """Estimate the shift of the detector.

    Whole columns of a coarse row are searched over the whole range; then a finer row refines the best shift by halving
    steps, and by a parabola at the end.
    """
    coarse, fine = row.binned(COARSE), row.binned(FINE)
    columns = row.geometry.columns
    bound = max(2, int(np.ceil(RANGE * coarse.geometry.columns)))
    shifts = np.arange(-bound, bound + 1)
    means = [float(misfit(coarse, shift=float(shift), mirrored=mirrored).mean()) for shift in shifts]
    factor = columns // fine.geometry.columns
    between = (columns // coarse.geometry.columns) / factor
    best = float(shifts[int(np.argmin(means))]) * between
    step = between / 2
    misfits: dict[float, np.ndarray] = {}

    def errors(shift: float) -> np.ndarray:
        if shift not in misfits:
            misfits[shift] = misfit(fine, shift=shift, mirrored=mirrored)
        return misfits[shift]

    while step * factor > _PRECISE_PX * 4:
        around = [best - step, best, best + step]
        best = min(around, key=lambda shift: float(errors(shift).mean()))
        if best == around[1]:
            step /= 2
    shift, error = _parabola(best, max(step * 2, 0.25), errors)
    return Centre(factor * shift, errors(shift), errors(0.0), factor * error)


def _parabola(best: float, step: float, errors: Callable[[float], np.ndarray]) -> tuple[float, float]:
    """Return the minimum of a parabola through three shifts and its standard error over views."""
    low, middle, high = (errors(best + k * step) for k in (-1, 0, 1))

    def lowest(chosen: np.ndarray | slice) -> float:
        one, two, three = (float(part[chosen].mean()) for part in (low, middle, high))
        bend = one - 2 * two + three
        return 0.0 if bend <= 0 else float(np.clip((one - three) / (2 * bend), -1, 1))

    at = lowest(slice(None))
    views = np.arange(len(middle))
    if len(views) < 3:
        return best + at * step, step
    without = np.array([lowest(views != view) for view in views])
    error = float(np.sqrt((len(views) - 1) / len(views) * ((without - without.mean()) ** 2).sum()))
    return best + at * step, max(error * step, 1e-3)


def margin(better: np.ndarray, worse: np.ndarray) -> tuple[float, float]:
    """Compare two predictions: the difference in standard errors over views, and the ratio of rms.

    The difference is the larger of two test statistics: of the mean gain, and of signed ranks, which a few views with
    large gains do not weaken.

    Source of the second: Wilcoxon 1945, Individual comparisons by ranking methods, Biometrics Bulletin 1(6).
    """
    gain = worse - better
    ratio = float(np.sqrt(worse.mean() / max(better.mean(), 1e-300)))
    if len(gain) < 2 or not gain.any():
        return 0.0, ratio
    error = float(gain.std(ddof=1) / np.sqrt(len(gain)))
    ranks = 1 + np.argsort(np.argsort(np.abs(gain)))
    by_ranks = float((np.sign(gain) * ranks).sum() / np.sqrt((ranks.astype(float) ** 2).sum()))
    return max(float(gain.mean()) / max(error, 1e-300), by_ranks), ratio
