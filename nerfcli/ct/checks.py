"""Checks of a scan: of its measured values (open beam, drift, rings, counts), of its views and of their geometry."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from skimage.filters import threshold_otsu

from nerfcli.ct.centre import (
    FEWEST_VIEWS,
    FINE,
    SIGNIFICANT,
    Centre,
    Row,
    centre_of,
    grid_of_row,
    highest_contrast_row,
    margin,
    predicted,
    reconstructed,
)
from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.grid import WEDGE_DEG, gaps_deg
from nerfcli.ct.likelihood import MEDIAN_DEVIATION
from nerfcli.ct.scan import Scan
from nerfcli.errors import several
from nerfcli.pages.findings import BAD, GOOD, Finding, finding, verdict_above, verdict_below, worst

# Largest numbers of rows and views that are examined, as a sample of all.
MOST_ROWS, MOST_VIEWS = 32, 400
# Columns at each side that should see past the object, as a fraction of the width.
BORDER = 0.02
# Variance of a second difference of noise.
_SECOND = 6.0


@dataclass(frozen=True)
class Sample:
    """Line integrals of some rows.

    Args:
        integrals: (V, rows, columns) float32, unusable pixels interpolated.
        noise: standard deviation of a line integral where there is little object.
        object_level: line integral that only 0.5 % of the pixels exceed.
    """

    scan: Scan
    rows: np.ndarray
    integrals: np.ndarray
    noise: float
    object_level: float

    @property
    def border(self) -> np.ndarray:
        """(V, rows, 2) means over the outermost columns, left and right."""
        width = max(1, round(BORDER * self.integrals.shape[2]))
        return np.stack([self.integrals[..., :width].mean(-1), self.integrals[..., -width:].mean(-1)], axis=-1)

    @property
    def air_level(self) -> float:
        """The line integral above which a pixel shows the object."""
        return max(0.05 * self.object_level, 4 * self.noise)

    @cached_property
    def row(self) -> Row:
        """The row with the most contrast."""
        return highest_contrast_row(self.scan).thinned()

    @cached_property
    def centre(self) -> Centre:
        """The centre of rotation, with columns and direction as stated."""
        return centre_of(self.row)


def sample_of(scan: Scan) -> Sample:
    """Prepare a scan for its checks."""
    rows = np.unique(np.linspace(0, scan.geometry.rows - 1, min(MOST_ROWS, scan.geometry.rows)).round().astype(int))
    live = scan.live_views
    views = live[np.unique(np.linspace(0, len(live) - 1, min(MOST_VIEWS, len(live))).round().astype(int))]
    integrals = np.stack([scan.only_rows(row, row + 1).line_integrals(views)[:, 0] for row in rows.tolist()], axis=1)
    second = np.abs(np.diff(integrals, 2, axis=2)) if integrals.shape[2] > 4 else np.zeros_like(integrals)
    inner = integrals[..., 1:-1] if integrals.shape[2] > 4 else integrals
    thin = inner <= np.quantile(inner, 0.25)
    noise = float(np.median(second[thin])) / MEDIAN_DEVIATION / np.sqrt(_SECOND) if thin.any() else 0.0
    return Sample(scan, rows, integrals, noise, float(np.quantile(integrals, 0.995)))


# Standard deviations of noise beyond which a pixel counts as brighter than the open beam.
BEYOND_NOISE = 3.0
# Normal noise puts 0.13 % of the air pixels there.
BRIGHT_LOOK, BRIGHT_BAD = 0.002, 0.05
# Fraction of all pixels with line integrals below 0, by any amount; as noise makes half of the air pixels negative, the
# median of the air has to be clearly below 0 as well.
NEGATIVE_LOOK = 0.10
DRIFT_LOOK, DRIFT_BAD = 0.005, 0.03
# A pixel causes a ring if its deviation from its neighbours, in the median over views, exceeds the floor and this many
# deviations of noise, with the same sign in this fraction of views: at edges of the object, the sign varies.
RING_FLOOR, RING_NOISE, RING_VIEWS = 0.005, 0.5, 0.95
# Change over four columns, as a fraction of the object's line integral, that counts as a border.
STEEP = 0.15
RINGS_LOOK, RINGS_BAD = 0.002, 0.05
PHOTONS_LOOK, PHOTONS_BAD = 100.0, 10.0
UNUSABLE_LOOK, UNUSABLE_BAD = 0.01, 0.2


def above_open_beam(sample: Sample) -> Finding:
    """Count pixels brighter than the open beam."""
    p = sample.integrals
    negative = float((p < 0).mean())
    beyond = float((p < -BEYOND_NOISE * sample.noise).mean())
    verdict = verdict_above(beyond, look=BRIGHT_LOOK, bad=BRIGHT_BAD)
    air = p[np.abs(p) < sample.air_level]
    middle = float(np.median(air)) if len(air) else 0.0
    if negative > NEGATIVE_LOOK and middle < -sample.noise / 2:
        verdict = worst((verdict, verdict_above(negative, look=NEGATIVE_LOOK, bad=2)))
    return finding(
        "open beam",
        verdict,
        f"{100 * negative:.1f} % of the pixels have I > I0, {100 * beyond:.2g} % by more than noise; "
        f"air has a median line integral of {middle:.2g}",
        beyond,
        f"look from {100 * BRIGHT_LOOK:g} % beyond {BEYOND_NOISE:g} deviations of noise (or {100 * NEGATIVE_LOOK:g} % "
        f"at all with air clearly below 0), bad from {100 * BRIGHT_BAD:g} %",
        advice="let the fit scale I0 per view; never clip or take logarithms of such values",
    )


def drift(sample: Sample) -> Finding | str:
    """Measure how much the air differs between views; return the reason if that is impossible."""
    border = sample.border
    if float(np.median(border)) > sample.air_level:
        return "no column sees past the object"
    means = np.median(np.minimum(border[..., 0], border[..., 1]), axis=1)
    if len(means) < 4:
        return "too few views"
    low, high = np.quantile(means, [0.02, 0.98])
    # The spread that noise alone causes in a mean over these pixels.
    pixels = border.shape[1] * max(1, round(BORDER * sample.integrals.shape[2]))
    by_noise = 4 * sample.noise / np.sqrt(pixels)
    number = float(np.sqrt(max((high - low) ** 2 - by_noise**2, 0)))
    return finding(
        "drift",
        verdict_above(number, look=DRIFT_LOOK, bad=DRIFT_BAD),
        f"air changes by {100 * number:.2g} % between views, in addition to {100 * by_noise:.2g} % of noise",
        number,
        f"look from {100 * DRIFT_LOOK:g} %, bad from {100 * DRIFT_BAD:g} %",
        advice="the source or the camera drifts: let the fit scale I0 per view",
    )


def rings(sample: Sample) -> Finding | str:
    """Count columns that differ from their neighbours in all views."""
    views, _, columns = sample.integrals.shape
    if views < 16 or columns < 32:
        return "too few views or columns"
    p = sample.integrals[:: max(1, views // 100), :: max(1, sample.integrals.shape[1] // 8)]
    # Deviation from the cubic through two neighbours on either side, which smooth objects follow.
    outer, near = p[..., :-4] + p[..., 4:], p[..., 1:-3] + p[..., 3:-1]
    offsets = p[..., 2:-2] - (4 * near - outer) / 6
    inner = np.median(offsets, axis=0)  # (rows, columns - 4)
    agree = np.maximum((offsets > 0).mean(0), (offsets < 0).mean(0))
    # The border of a round object is in the same columns in all views.
    steep = np.median(np.abs(p[..., 4:] - p[..., :-4]), axis=0) > STEEP * sample.object_level
    limit = max(RING_FLOOR, RING_NOISE * sample.noise)
    bad = (np.abs(inner) > limit) & (agree >= RING_VIEWS) & ~steep
    fraction = float(bad.mean())
    worst_column = int(np.argmax((np.abs(inner) * bad).max(0))) + 2
    return finding(
        "rings",
        verdict_above(fraction, look=RINGS_LOOK, bad=RINGS_BAD),
        f"{100 * fraction:.2g} % of the detector's pixels are off their neighbours in all views by more than "
        f"{limit:.2g}" + (f"; the worst is column {worst_column}" if fraction > 0 else ""),
        fraction,
        f"look from {100 * RINGS_LOOK:g} %, bad from {100 * RINGS_BAD:g} %",
        advice="they cause rings around the axis: take new flats, or mark these pixels unusable",
    )


def counts(sample: Sample) -> Finding | str:
    """Estimate the number of photons behind the thickest part of the object."""
    scan = sample.scan
    if scan.kind == "line_integral":
        return "line integrals do not contain the number of photons"
    if scan.photons_per_value is None:
        return "how many photons a value stands for is not known: give --photons when converting"
    open_beam = 1.0 if scan.open_beam is None else float(np.median(scan.open_beam))
    photons = scan.photons_per_value * open_beam
    # Means over neighbours: the minimum over single pixels would only reflect noise.
    wide = max(1, min(5, sample.integrals.shape[2] // 8))
    through = np.exp(-sample.integrals[..., : sample.integrals.shape[2] // wide * wide])
    least = photons * float(np.quantile(through.reshape(*through.shape[:2], -1, wide).mean(-1), 0.005))
    return finding(
        "counts",
        verdict_below(least, look=PHOTONS_LOOK, bad=PHOTONS_BAD),
        f"{photons:.3g} photons per pixel in the open beam, {least:.3g} behind the thickest part",
        least,
        f"look below {PHOTONS_LOOK:g} photons, bad below {PHOTONS_BAD:g}",
        advice="logarithms of such counts are biased: fit the counts by their Poisson likelihood; expose longer",
    )


def unusable(sample: Sample) -> Finding:
    """Count the values that are left out."""
    usable = sample.scan.usable
    fraction = 0.0 if usable is None else 1 - float(usable.mean())
    views = 0 if usable is None or len(usable) == 1 else int((~usable.any(axis=(1, 2))).sum())
    return finding(
        "dead pixels",
        verdict_above(fraction, look=UNUSABLE_LOOK, bad=UNUSABLE_BAD),
        f"{100 * fraction:.2g} % of the values are left out" + (f", {several(views, 'whole view')}" if views else ""),
        fraction,
        f"look from {100 * UNUSABLE_LOOK:g} %, bad from {100 * UNUSABLE_BAD:g} %",
        advice="check the flats, and export damaged frames again",
    )


TRUNCATED_LOOK, TRUNCATED_BAD = 0.02, 0.2
WEDGE_BAD_DEG = 30.0


def truncation(sample: Sample) -> Finding:
    """Measure the fraction of views in which the object reaches the border of the detector."""
    reached = np.asarray(sample.border > sample.air_level)
    fraction = float(reached.any(axis=(1, 2)).mean())
    left, right = reached[..., 0].any(), reached[..., 1].any()
    which = " on both sides" if left and right else " on the left" if left else " on the right" if right else ""
    return finding(
        "truncation",
        verdict_above(fraction, look=TRUNCATED_LOOK, bad=TRUNCATED_BAD),
        f"the object reaches the border{which} in {100 * fraction:.3g} % of the views",
        fraction,
        f"look from {100 * TRUNCATED_LOOK:g} %, bad from {100 * TRUNCATED_BAD:g} %; line integrals above "
        f"{sample.air_level:.2g} count as object",
        advice="values inside hold up to a smooth offset only: use a wider detector, or rely on edges, not on values",
    )


def missing_wedge(sample: Sample) -> Finding:
    """Find the directions that no ray covers."""
    largest, usual = gaps_deg(sample.scan.geometry.select(sample.scan.live_views))
    missing = largest - usual
    return finding(
        "missing wedge",
        verdict_above(missing, look=WEDGE_DEG, bad=WEDGE_BAD_DEG),
        f"a wedge of {missing:.4g} degrees is missing"
        if missing > WEDGE_DEG
        else "the directions of rays go all around",
        missing,
        f"look from {WEDGE_DEG:g} degrees beyond the usual step, bad from {WEDGE_BAD_DEG:g}",
        advice="edges along the missing directions cannot be reconstructed; the volume is marked there",
    )


# Least ratio of the rms for a verdict, besides significance: smaller differences come from how a fit treats noise.
LEAST_RATIO = 1.05
CENTRE_LOOK, CENTRE_BAD = 0.3, 1.0
HARDENING_LOOK, HARDENING_BAD = 0.05, 0.25
# Below this fraction of explained variance, the object has several materials, whose effect looks like beam hardening.
ONE_MATERIAL = 0.97


def side(sample: Sample) -> Finding | str:
    """Find a mirrored detector, or a reversed rotation, by what predicts other views; both at once mirror the object.

    A scan that is read wrongly still gives a picture. Parallel beams cannot tell: with a mirrored detector, they see
    the object turned by half a turn, and with a reversed rotation, its mirror image.
    """
    if sample.scan.geometry.beam == "parallel":
        return (
            "parallel beams cannot tell a mirrored detector or a reversed rotation from the object turned or mirrored"
        )
    if len(sample.scan.live_views) < FEWEST_VIEWS:
        return "too few views"
    mirrored = centre_of(sample.row, mirrored=True)
    better, worse = sorted((sample.centre, mirrored), key=lambda found: float(found.errors.mean()))
    errors, ratio = margin(better.errors, worse.errors)
    if errors <= SIGNIFICANT or ratio <= LEAST_RATIO:
        return "columns and direction as stated predict other views as well as mirrored ones"
    return finding(
        "side and direction",
        BAD if better is mirrored else GOOD,
        f"{'mirrored columns predict' if better is mirrored else 'as stated, the views predict'} others {ratio:.3g} "
        f"times better ({errors:.1f} standard errors)",
        ratio,
        f"bad if a mirrored detector predicts better, from {LEAST_RATIO:g} times and {SIGNIFICANT:g} standard errors",
        advice="convert with --mirrored, or state the other direction of rotation, and check the result; both at once "
        "mirror the object, which only a feature of known handedness shows",
    )


def centre(sample: Sample) -> Finding | str:
    """Estimate the centre of rotation."""
    if len(sample.scan.live_views) < FEWEST_VIEWS:
        return "too few views"
    found, stated = sample.centre, axis_column(sample.scan.geometry)
    column = stated - found.shift
    return finding(
        "centre of rotation",
        verdict_above(abs(found.shift) if found.is_off else 0.0, look=CENTRE_LOOK, bad=CENTRE_BAD),
        f"axis at column {column:.2f} ± {found.error:.2f}; the scan states {stated:.2f}",
        abs(found.shift),
        f"look from {CENTRE_LOOK:g} columns, bad from {CENTRE_BAD:g}, if it predicts other views significantly better",
        advice=f"convert with --centre-of-rotation {column:.2f}, or let ct train estimate it",
    )


def beam_hardening(sample: Sample) -> Finding | str:
    """Measure how far line integrals fall below proportionality to path lengths, in an object of one material."""
    if len(sample.scan.live_views) < FEWEST_VIEWS:
        return "too few views"
    row = sample.row.binned(FINE)
    grid = grid_of_row(row)
    volume = reconstructed(row, grid)
    lengths = predicted((volume > threshold_otsu(volume.numpy())).float(), grid, row)
    longest = float(np.quantile(lengths, 0.999))
    used = lengths > 0.1 * longest
    if longest <= 0 or used.sum() < 100:
        return "no object found"
    length, p = lengths[used].astype(np.float64) / longest, row.integrals[used].astype(np.float64)
    (straight, bent), *_ = np.linalg.lstsq(np.stack([length, length**2], axis=1), p, rcond=None)
    left = p - straight * length - bent * length**2
    explained = 1 - float(left.var() / p.var())
    if explained < ONE_MATERIAL:
        return f"path lengths explain {100 * explained:.0f} % of the line integrals: the object is not of one material"
    number = float(-bent / straight) if straight > 0 else 0.0
    return finding(
        "beam hardening",
        verdict_above(number, look=HARDENING_LOOK, bad=HARDENING_BAD),
        f"the line integral of the longest path is {100 * number:.3g} % below the trend of short paths "
        f"(path length explains {100 * explained:.4g} % of the variance)",
        number,
        f"look from {100 * HARDENING_LOOK:g} %, bad from {100 * HARDENING_BAD:g} %",
        advice="values inside come out too low (cupping): filter the beam, or correct line integrals by a polynomial",
    )
