"""All checks of a scan, and the HTML page of their findings: with a projection, and the sinogram of a row."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct import checks
from nerfcli.ct.checks import Sample, sample_of
from nerfcli.ct.convert import in_words, read_scan
from nerfcli.ct.formats.statement import ScanOptions
from nerfcli.ct.scan import Scan
from nerfcli.notices import Progress, Reporter, no_progress
from nerfcli.output import Output
from nerfcli.pages import page as pages
from nerfcli.pages.findings import VERDICTS, Finding, as_json, worst
from nerfcli.pages.page import data_uri, jpeg_bytes
from nerfcli.photos.images import reduced

_LONGEST_PX = 640
Check = Callable[[Sample], Finding | str]
CHECKS: dict[str, Check] = {
    "open beam": checks.above_open_beam,
    "drift": checks.drift,
    "rings": checks.rings,
    "counts": checks.counts,
    "dead pixels": checks.unusable,
    "truncation": checks.truncation,
    "missing wedge": checks.missing_wedge,
    "side and direction": checks.side,
    "centre of rotation": checks.centre,
    "beam hardening": checks.beam_hardening,
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
    def record(self) -> dict[str, Any]:
        """The findings as plain values."""
        return {
            "kind": "scan",
            "verdict": worst(finding.verdict for finding in self.findings),
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


def examine(
    source: Path, output: Output = Output(), *, given: ScanOptions = ScanOptions(), reporter: Reporter = Reporter()
) -> ScanDiagnosis:
    """Run all checks of a scan in any format, and write a page of the findings, atomically.

    Raises:
        UserError: the scan cannot be read, or the page's path holds something else.
    """
    scan = read_scan(source, given)
    page = output.beside(source, "-doctor.html")
    pages.claim_page(output, page, pages.Mark("doctor", source), about="scan")
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
        first = sample.scan.line_integrals(sample.scan.live_views[:1])[0]
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
    uri = data_uri(jpeg_bytes(reduced(levels, _LONGEST_PX)), "jpeg")
    return title, f"{text}, {low:.3g} (black) to {high:.3g}", uri
