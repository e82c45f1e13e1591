"""Judge a scan by its data: direction of rotation, mirrored detector, centre of rotation.

A wrong hypothesis still gives a picture that looks right. So each hypothesis has to predict views that it was not
fitted to, and the margin between hypotheses is reported. So is the ambiguity that no data can resolve: mirroring the
detector and reversing the direction together only mirror the object; parallel beams cannot reveal even one of them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerfcli.ct.centre import FEWEST_VIEWS, SIGNIFICANT, centre_of, margin
from nerfcli.ct.describe import in_words
from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.formats.read import read_scan
from nerfcli.ct.formats.statement import ScanOptions
from nerfcli.ct.quick import highest_contrast_row
from nerfcli.ct.scan import Scan
from nerfcli.errors import UserError
from nerfcli.notices import Progress, Reporter, no_progress

# Least ratio of the rms for a verdict, besides significance: smaller differences come from how a fit treats noise.
LEAST_RATIO = 1.05


@dataclass(frozen=True)
class Reading:
    """One of the two readings that data can tell apart: as stated, or mirrored (which is the same as reversed).

    Args:
        centre_column: column that the axis is projected to, as estimated under this reading.
        rms: rms error of predicted line integrals, in views that were not fitted.
    """

    centre_column: float
    rms: float


@dataclass(frozen=True)
class Judgement:
    """The readings and the verdict.

    Args:
        as_stated, mirrored: the two readings.
        verdict: "holds" (as stated), "mirrored" (either mirrored or reversed), or "undecided".
        ratio: rms of the worse reading over that of the better one; 1 where they are the same.
        standard_errors: difference between the two readings in standard errors.
        stated_column, centre_column: column of the axis, as the scan states it and as estimated from the data.
        centre_error: standard error of the centre in columns.
        centre_ratio: rms at the stated centre over that at the best one.
        centre_holds: whether the stated centre is as good as the best one.
        ambiguity: an explanation of what the data cannot decide, for the user.
    """

    as_stated: Reading
    mirrored: Reading
    verdict: str
    ratio: float
    standard_errors: float
    stated_column: float
    centre_column: float
    centre_error: float
    centre_ratio: float
    centre_holds: bool
    ambiguity: str

    @property
    def options(self) -> str:
        """Options of `nerfcli ct convert` that correct the scan according to the data; empty if none are needed."""
        options = ["--mirrored"] if self.verdict == "mirrored" else []
        if not self.centre_holds:
            options.append(f"--centre-of-rotation {self.centre_column:.2f}")
        return " ".join(options)


def judge(scan: Scan, *, progress: Progress = no_progress) -> Judgement:
    """Rank hypotheses by how well they predict views that they were not fitted to.

    Raises:
        UserError: there are too few views.
    """
    if len(scan.live_views) < FEWEST_VIEWS:
        raise UserError(
            f"{len(scan.live_views)} views are too few to judge the geometry",
            f"use a scan with at least {FEWEST_VIEWS} views",
        )
    row = highest_contrast_row(scan).thinned()
    stated = axis_column(scan.geometry)
    progress(0.0, "as stated")
    plain = centre_of(row, mirrored=False)
    parallel = scan.geometry.beam == "parallel"
    progress(0.5, "mirrored")
    other = plain if parallel else centre_of(row, mirrored=True)
    last = scan.geometry.columns - 1
    # The shift of a mirrored reading is counted along its own columns.
    bases = stated, stated if parallel else last - stated
    readings = [
        Reading(base - found.shift, float(np.sqrt(found.errors.mean())))
        for base, found in zip(bases, (plain, other), strict=True)
    ]
    better, worse = (plain, other) if plain.errors.mean() <= other.errors.mean() else (other, plain)
    by, ratio = margin(better.errors, worse.errors)
    decided = not parallel and by > SIGNIFICANT and ratio > LEAST_RATIO
    verdict = "undecided" if not decided else "holds" if better is plain else "mirrored"
    chosen = other if verdict == "mirrored" else plain
    base = bases[verdict == "mirrored"]
    return Judgement(
        readings[0],
        readings[1],
        verdict,
        ratio,
        by,
        base,
        base - chosen.shift,
        chosen.error,
        centre_ratio=margin(chosen.errors, chosen.at_stated)[1],
        centre_holds=not chosen.is_off,
        ambiguity=_PARALLEL if parallel else _CONE,
    )


def detect_scan(source: Path, *, given: ScanOptions = ScanOptions(), reporter: Reporter = Reporter()) -> Judgement:
    """Judge direction of rotation, mirroring and centre of rotation by how well they predict the data.

    Raises:
        UserError: the scan cannot be read, or has too few views.
    """
    scan = read_scan(source, given)
    reporter.note(f"{source}: {scan.history.get('format')}, {in_words(scan)}")
    return judge(scan, progress=reporter.progress)


_CONE = (
    "mirroring the detector and reversing the direction together give the mirror image of the object, with the same "
    "projections: only a feature whose handedness is known can tell"
)
_PARALLEL = (
    "parallel beams cannot distinguish them: a mirrored detector is the object turned by half a turn, a reversed "
    "direction is its mirror image, with the same projections"
)
