"""Which way the object turned, which side columns are numbered from, and where the axis is: judged by the data.

A wrong answer still gives a picture that looks right. So each hypothesis has to predict views that it was not fitted
to, and the margin between hypotheses is told. What no data can decide is said: mirroring the detector and reversing
the direction together only mirror the object, and parallel beams allow each of them alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nerfcli.errors import UserError
from nerfcli.tomography.formats.assemble import axis_column
from nerfcli.tomography.quick import Row, misfit, telling_row
from nerfcli.tomography.scan import Scan

Progress = Callable[[float, str], None]

# Columns of the row on which the centre is looked for, and on which it is made precise.
COARSE, FINE = 80, 200
# The axis is looked for within this part of the detector's width on either side.
RANGE = 0.12
# Standard errors by which one hypothesis has to predict better than another.
SIGNIFICANT = 3.0
# By how much the rms has to differ besides: below this, a class differs by what a fit does to noise.
LEAST_RATIO = 1.05
FEWEST_VIEWS = 8
_PRECISE_PX = 0.02


@dataclass(frozen=True)
class Hypothesis:
    """One reading of a scan.

    Args:
        reversed: whether the object turned the other way than the scan says.
        mirrored: whether columns are numbered from the other side.
        centre_column: that the axis is projected to, the best one for this reading.
        rms: of line integrals that were predicted, in views that were not fitted.
        as_stated: whether this is how the scan says.
    """

    reversed: bool
    mirrored: bool
    centre_column: float
    rms: float
    as_stated: bool


@dataclass(frozen=True)
class Judgement:
    """What the data say.

    Args:
        hypotheses: the best first.
        verdict: "holds" (as stated), "mirrored" (that, or reversed), or "undecided".
        ratio: how much worse the rms of the other reading is; 1 where they are the same.
        margin: by how many standard errors.
        stated_column, centre_column: of the axis, as the scan says and as the data do.
        centre_error: standard error of the centre in columns.
        centre_ratio: rms at the stated centre over that at the best one.
        centre_holds: whether the stated centre is as good as the best one.
        ambiguity: what the data cannot decide.
    """

    hypotheses: tuple[Hypothesis, ...]
    verdict: str
    ratio: float
    margin: float
    stated_column: float
    centre_column: float
    centre_error: float
    centre_ratio: float
    centre_holds: bool
    ambiguity: str

    @property
    def options(self) -> str:
        """Options of `nerfcli convert` that read the scan as the data say; empty if it is so already."""
        options = ["--mirrored"] if self.verdict == "mirrored" else []
        if not self.centre_holds:
            options.append(f"--centre-of-rotation {self.centre_column:.2f}")
        return " ".join(options)


@dataclass(frozen=True)
class Centre:
    """Where the axis is, for one reading.

    Args:
        shift: columns that the detector has to be moved by.
        errors: (views,) mean squares of the views that were not fitted, at the best shift.
        at_stated: likewise without a shift.
        error: standard error of the shift, in columns.
    """

    shift: float
    errors: np.ndarray
    at_stated: np.ndarray
    error: float


def judge(scan: Scan, *, progress: Progress = lambda share, detail: None) -> Judgement:
    """Rank readings of a scan by how well they predict views that they were not fitted to.

    Raises:
        UserError: there are too few views.
    """
    if scan.geometry.views < FEWEST_VIEWS:
        raise UserError(
            f"{scan.geometry.views} views are too few to judge a geometry by", f"at least {FEWEST_VIEWS} are needed"
        )
    row = telling_row(scan).thinned()
    stated = axis_column(scan.geometry)
    progress(0.0, "as stated")
    plain = centre_of(row, mirrored=False)
    parallel = scan.geometry.beam == "parallel"
    progress(0.5, "mirrored")
    other = plain if parallel else centre_of(row, mirrored=True)
    hypotheses = []
    last = scan.geometry.columns - 1
    for mirrored in (False, True):
        for reverse in (False, True):
            found = plain if mirrored == reverse else other
            # The shift of a mirrored reading is counted along its own columns.
            flipped = found is other and not parallel
            column = (last - stated if flipped else stated) - found.shift
            hypotheses.append(
                Hypothesis(
                    *(reverse, mirrored, column, float(np.sqrt(found.errors.mean()))),
                    as_stated=not (mirrored or reverse),
                )
            )
    hypotheses.sort(key=lambda each: (each.rms, not each.as_stated))
    better, worse = (plain, other) if plain.errors.mean() <= other.errors.mean() else (other, plain)
    by, ratio = margin(better.errors, worse.errors)
    decided = not parallel and by > SIGNIFICANT and ratio > LEAST_RATIO
    verdict = "undecided" if not decided else "holds" if better is plain else "mirrored"
    chosen = other if verdict == "mirrored" else plain
    centre_margin, centre_ratio = margin(chosen.errors, chosen.at_stated)
    base = last - stated if verdict == "mirrored" else stated
    return Judgement(
        *(tuple(hypotheses), verdict, ratio, by, base, base - chosen.shift, chosen.error),
        centre_ratio=centre_ratio,
        centre_holds=not (centre_margin > SIGNIFICANT and abs(chosen.shift) > max(0.1, 2 * chosen.error)),
        ambiguity=_PARALLEL if parallel else _CONE,
    )


def centre_of(row: Row, *, mirrored: bool = False) -> Centre:
    """The shift of the detector that predicts best.

    By whole columns of a coarse row over the whole range, then by a parabola through the best of a finer one.
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
    known: dict[float, np.ndarray] = {}

    def errors(shift: float) -> np.ndarray:
        if shift not in known:
            known[shift] = misfit(fine, shift=shift, mirrored=mirrored)
        return known[shift]

    while step * factor > _PRECISE_PX * 4:
        around = [best - step, best, best + step]
        best = min(around, key=lambda shift: float(errors(shift).mean()))
        if best == around[1]:
            step /= 2
    shift, error = _parabola(best, max(step * 2, 0.25), errors)
    return Centre(factor * shift, errors(shift), errors(0.0), factor * error)


def _parabola(best: float, step: float, errors: Callable[[float], np.ndarray]) -> tuple[float, float]:
    """The lowest point of a parabola through three shifts, and its standard error over views."""
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
    """By how many standard errors over views one is better, and the ratio of rms.

    The larger of two tests: of the mean gain, and of signed ranks, which a few views with large gains do not weaken.
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


_CONE = (
    "mirroring the detector and reversing the direction together give the mirror image of the object, with the same "
    "projections: only a feature whose handedness is known can tell"
)
_PARALLEL = (
    "parallel beams do not tell: a mirrored detector is the object turned by half a turn, a reversed direction is its "
    "mirror image, with the same projections"
)
