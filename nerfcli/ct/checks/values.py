"""Checks of the measured values: open beam, drift, rings, counts."""

import numpy as np

from nerfcli.ct.checks.sample import Sample
from nerfcli.errors import several
from nerfcli.pages.findings import Finding, verdict_above, verdict_below, worst

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
    return Finding(
        "open beam",
        verdict,
        f"{100 * negative:.1f} % of the pixels have I > I0, {100 * beyond:.2g} % by more than noise; "
        f"air has a median line integral of {middle:.2g}",
        beyond,
        f"look from {100 * BRIGHT_LOOK:g} % beyond {BEYOND_NOISE:g} deviations of noise (or {100 * NEGATIVE_LOOK:g} % "
        f"at all with air clearly below 0), bad from {100 * BRIGHT_BAD:g} %",
        "" if verdict == "good" else "let the fit scale I0 per view; never clip or take logarithms of such values",
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
    pixels = border.shape[1] * max(1, round(0.02 * sample.integrals.shape[2]))
    by_noise = 4 * sample.noise / np.sqrt(pixels)
    number = float(np.sqrt(max((high - low) ** 2 - by_noise**2, 0)))
    verdict = verdict_above(number, look=DRIFT_LOOK, bad=DRIFT_BAD)
    return Finding(
        "drift",
        verdict,
        f"air changes by {100 * number:.2g} % between views, in addition to {100 * by_noise:.2g} % of noise",
        number,
        f"look from {100 * DRIFT_LOOK:g} %, bad from {100 * DRIFT_BAD:g} %",
        "" if verdict == "good" else "the source or the camera drifts: let the fit scale I0 per view",
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
    verdict = verdict_above(fraction, look=RINGS_LOOK, bad=RINGS_BAD)
    worst_column = int(np.argmax((np.abs(inner) * bad).max(0))) + 2
    return Finding(
        "rings",
        verdict,
        f"{100 * fraction:.2g} % of the detector's pixels are off their neighbours in all views by more than "
        + f"{limit:.2g}"
        + (f"; the worst is column {worst_column}" if fraction > 0 else ""),
        fraction,
        f"look from {100 * RINGS_LOOK:g} %, bad from {100 * RINGS_BAD:g} %",
        "" if verdict == "good" else "they cause rings around the axis: take new flats, or mark these pixels unusable",
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
    verdict = verdict_below(least, look=PHOTONS_LOOK, bad=PHOTONS_BAD)
    return Finding(
        "counts",
        verdict,
        f"{photons:.3g} photons per pixel in the open beam, {least:.3g} behind the thickest part",
        least,
        f"look below {PHOTONS_LOOK:g} photons, bad below {PHOTONS_BAD:g}",
        ""
        if verdict == "good"
        else "logarithms of such counts are biased: fit the counts by their Poisson likelihood; expose longer",
    )


def unusable(sample: Sample) -> Finding:
    """Count the values that are left out."""
    usable = sample.scan.usable
    fraction = 0.0 if usable is None else 1 - float(usable.mean())
    views = 0 if usable is None or len(usable) == 1 else int((~usable.any(axis=(1, 2))).sum())
    verdict = verdict_above(fraction, look=UNUSABLE_LOOK, bad=UNUSABLE_BAD)
    return Finding(
        "dead pixels",
        verdict,
        f"{100 * fraction:.2g} % of the values are left out" + (f", {several(views, 'whole view')}" if views else ""),
        fraction,
        f"look from {100 * UNUSABLE_LOOK:g} %, bad from {100 * UNUSABLE_BAD:g} %",
        "" if verdict == "good" else "check the flats, and export damaged frames again",
    )
