"""All checks of a scan, and the HTML page of their findings: with a projection, and the sinogram of a row."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from skimage.filters import threshold_otsu

from nerfcli.ct.centre import FEWEST_VIEWS, FINE, centre_of
from nerfcli.ct.checks import values, views
from nerfcli.ct.checks.sample import Sample, sample_of
from nerfcli.ct.describe import in_words
from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.formats.read import read_scan
from nerfcli.ct.quick import highest_contrast_row, predicted, reconstructed
from nerfcli.ct.scan import Scan
from nerfcli.notices import Progress, Reporter, no_progress
from nerfcli.output import Output
from nerfcli.pages import page as pages
from nerfcli.pages.findings import BAD, GOOD, LOOK, VERDICTS, Finding, as_json, verdict_above, worst
from nerfcli.pages.page import data_uri, jpeg_bytes

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


_LONGEST_PX = 640
Check = Callable[[Sample], Finding | str]
CHECKS: dict[str, Check] = {
    "open beam": values.above_open_beam,
    "drift": values.drift,
    "rings": values.rings,
    "counts": values.counts,
    "dead pixels": values.unusable,
    "truncation": views.truncation,
    "repeated angles": views.repeated_angles,
    "missing wedge": views.missing_wedge,
    "number of views": views.few_views,
    "centre of rotation": centre,
    "beam hardening": beam_hardening,
}


@dataclass(frozen=True)
class ScanDiagnosis:
    """Findings of the checks of a scan.

    Args:
        findings: findings of all checks that could be made, in order.
        not_checked: names of the checks that could not be made, with the reason.
    """

    sample: Sample
    findings: tuple[Finding, ...]
    not_checked: tuple[tuple[str, str], ...]

    @property
    def verdict(self) -> str:
        """The worst of the findings' verdicts."""
        return worst(finding.verdict for finding in self.findings)

    @property
    def record(self) -> dict[str, Any]:
        """The findings as plain values."""
        return {
            "kind": "scan",
            "verdict": self.verdict,
            "findings": [as_json(finding) for finding in self.findings],
            "not_checked": dict(self.not_checked),
        }


def examine_scan(scan: Scan, *, progress: Progress = no_progress) -> ScanDiagnosis:
    """Run all checks of a scan. Deterministic."""
    progress(0.0, "reading")
    sample = sample_of(scan)
    findings: list[Finding] = []
    not_checked: list[tuple[str, str]] = []
    for number, (name, check) in enumerate(CHECKS.items()):
        progress((1 + number) / (1 + len(CHECKS)), name)
        found = check(sample)
        if isinstance(found, Finding):
            findings.append(found)
        else:
            not_checked.append((name, found))
    return ScanDiagnosis(sample, tuple(findings), tuple(not_checked))


def examine(source: Path, output: Output = Output(), *, reporter: Reporter = Reporter()) -> ScanDiagnosis:
    """Run all checks of a scan in any format, and write a page of the findings, atomically.

    Raises:
        UserError: the scan cannot be read, or the page's path holds something else.
    """
    page = output.beside(source, "-doctor.html")
    pages.claim_page(output, page, pages.Mark("doctor", source), about="scan")
    scan = read_scan(source)
    reporter.note(f"{source}: {in_words(scan)}")
    diagnosis = examine_scan(scan, progress=reporter.progress)
    pages.write_page(page_html(diagnosis, source), page)
    return diagnosis


def page_html(diagnosis: ScanDiagnosis, source: Path) -> str:
    """Return the page's text."""
    order = sorted(diagnosis.findings, key=lambda finding: -VERDICTS.index(finding.verdict))
    sample = diagnosis.sample
    middle = sample.integrals.shape[1] // 2
    sinogram = sample.integrals[:, middle]
    pictures = [("Sinogram", f"line integrals of row {int(sample.rows[middle])}, a line per view", sinogram)]
    if sample.scan.geometry.rows > 1:
        first = sample.scan.line_integrals(np.array([0]))[0]
        pictures.insert(0, ("First projection", "line integrals", first))
    body = pages.rendered(
        "scan.html",
        title=source.resolve().name,
        findings=order,
        not_checked=diagnosis.not_checked,
        pictures=[_picture(*each) for each in pictures],
    )
    mark = pages.Mark("doctor", source)
    return pages.page_html(title=source.resolve().name, mark=mark, style=pages.asset("doctor.css"), body=body)


def _picture(title: str, text: str, values: np.ndarray) -> tuple[str, str, str]:
    """Return the title, the explanation, and the picture as a data URI."""
    low, high = np.quantile(values, [0.005, 0.995])
    grey = np.clip((values - low) / max(float(high - low), 1e-12), 0, 1)
    levels = np.repeat((255 * grey).astype(np.uint8)[..., None], 3, axis=2)
    uri = data_uri(jpeg_bytes(levels, longest_px=_LONGEST_PX), "jpeg")
    return title, f"{text}, {low:.3g} (black) to {high:.3g}", uri
