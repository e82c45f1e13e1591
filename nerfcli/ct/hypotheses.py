"""Rank hypotheses about a scan by its data: direction of rotation, mirrored detector, centre of rotation.

A wrong hypothesis still gives a picture that looks right. So each hypothesis has to predict views that it was not
fitted to, and the margin between hypotheses is reported. So is the ambiguity that no data can resolve: mirroring the
detector and reversing the direction together only mirror the object; parallel beams cannot reveal even one of them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nerfcli.ct.centre import FEWEST_VIEWS, SIGNIFICANT, centre_of, margin
from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.quick import highest_contrast_row
from nerfcli.ct.scan import Scan
from nerfcli.errors import UserError

Progress = Callable[[float, str], None]

# Least ratio of the rms for a verdict, besides significance: smaller differences come from how a fit treats noise.
LEAST_RATIO = 1.05


@dataclass(frozen=True)
class Hypothesis:
    """One hypothesis about a scan.

    Args:
        reversed: whether the object turned in the direction opposite to the one that the scan states.
        mirrored: whether columns are numbered from the other side.
        centre_column: column that the axis is projected to, as estimated under this hypothesis.
        rms: rms error of predicted line integrals, in views that were not fitted.
        as_stated: whether this is the hypothesis that the scan states.
    """

    reversed: bool
    mirrored: bool
    centre_column: float
    rms: float
    as_stated: bool


@dataclass(frozen=True)
class Judgement:
    """The ranking and its verdict.

    Args:
        hypotheses: the best first.
        verdict: "holds" (as stated), "mirrored" (either mirrored or reversed), or "undecided".
        ratio: rms of the worse reading over that of the better one; 1 where they are the same.
        margin: difference between the two readings in standard errors.
        stated_column, centre_column: column of the axis, as the scan states it and as estimated from the data.
        centre_error: standard error of the centre in columns.
        centre_ratio: rms at the stated centre over that at the best one.
        centre_holds: whether the stated centre is as good as the best one.
        ambiguity: an explanation of what the data cannot decide, for the user.
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
        """Options of `nerfcli convert` that correct the scan according to the data; empty if none are needed."""
        options = ["--mirrored"] if self.verdict == "mirrored" else []
        if not self.centre_holds:
            options.append(f"--centre-of-rotation {self.centre_column:.2f}")
        return " ".join(options)


def judge(scan: Scan, *, progress: Progress = lambda fraction, detail: None) -> Judgement:
    """Rank hypotheses by how well they predict views that they were not fitted to.

    Raises:
        UserError: there are too few views.
    """
    if scan.geometry.views < FEWEST_VIEWS:
        raise UserError(
            f"{scan.geometry.views} views are too few to judge the geometry", f"at least {FEWEST_VIEWS} are needed"
        )
    row = highest_contrast_row(scan).thinned()
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
    base = last - stated if verdict == "mirrored" else stated
    return Judgement(
        *(tuple(hypotheses), verdict, ratio, by, base, base - chosen.shift, chosen.error),
        centre_ratio=margin(chosen.errors, chosen.at_stated)[1],
        centre_holds=not chosen.is_off,
        ambiguity=_PARALLEL if parallel else _CONE,
    )


_CONE = (
    "mirroring the detector and reversing the direction together give the mirror image of the object, with the same "
    "projections: only a feature whose handedness is known can tell"
)
_PARALLEL = (
    "parallel beams cannot distinguish them: a mirrored detector is the object turned by half a turn, a reversed "
    "direction is its mirror image, with the same projections"
)
