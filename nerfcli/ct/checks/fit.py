"""Checks that need a quick reconstruction: the centre of rotation and beam hardening."""

import numpy as np
from skimage.filters import threshold_otsu

from nerfcli.ct.centre import FEWEST_VIEWS, FINE, centre_of
from nerfcli.ct.checks.sample import Sample
from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.quick import highest_contrast_row, predicted, reconstructed
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding, verdict_above

CENTRE_LOOK, CENTRE_BAD = 0.3, 1.0
HARDENING_LOOK, HARDENING_BAD = 0.05, 0.25
# Below this fraction of explained variance, the object has several materials, whose effect looks like beam hardening.
ONE_MATERIAL = 0.97


def centre(sample: Sample) -> Finding | str:
    """Estimate the centre of rotation."""
    scan = sample.scan
    if scan.geometry.views < FEWEST_VIEWS:
        return "too few views"
    row = highest_contrast_row(scan)
    stated = axis_column(scan.geometry)
    found = centre_of(row.thinned())
    column = stated - found.shift
    number = abs(found.shift) if found.is_off else 0.0
    verdict = verdict_above(number, look=CENTRE_LOOK, bad=CENTRE_BAD)
    return Finding(
        "centre of rotation",
        verdict,
        f"axis at column {column:.2f} ± {found.error:.2f}; the scan states {stated:.2f}",
        abs(found.shift),
        f"look from {CENTRE_LOOK:g} columns, bad from {CENTRE_BAD:g}, if it predicts other views significantly better",
        "" if verdict == GOOD else f"convert with --centre-of-rotation {column:.2f}, or let ct train estimate it",
    )


def beam_hardening(sample: Sample) -> Finding | str:
    """Measure how far line integrals fall below proportionality to path lengths, in an object of one material."""
    if sample.scan.geometry.views < FEWEST_VIEWS:
        return "too few views"
    row = highest_contrast_row(sample.scan).thinned().binned(FINE)
    volume, grid = reconstructed(row)
    inside = volume > threshold_otsu(volume)
    lengths = predicted(inside.astype(np.float32), row, grid)
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
    verdict = BAD if number >= HARDENING_BAD else LOOK if number >= HARDENING_LOOK else GOOD
    return Finding(
        "beam hardening",
        verdict,
        f"the line integral of the longest path is {100 * number:.3g} % below the trend of short paths "
        f"(path length explains {100 * explained:.4g} % of the variance)",
        number,
        f"look from {100 * HARDENING_LOOK:g} %, bad from {100 * HARDENING_BAD:g} %",
        ""
        if verdict == GOOD
        else "values inside come out too low (cupping): filter the beam, or correct line integrals by a polynomial",
    )
