"""All checks of a scan."""

from collections.abc import Callable
from dataclasses import dataclass

from nerfcli.ct.checks import fit, values, views
from nerfcli.ct.checks.sample import Sample, sample_of
from nerfcli.ct.scan import Scan
from nerfcli.pages.findings import Finding, worst

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
    "centre of rotation": fit.centre,
    "beam hardening": fit.beam_hardening,
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


def examine_scan(
    scan: Scan, *, progress: Callable[[float, str], None] = lambda fraction, detail: None
) -> ScanDiagnosis:
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
