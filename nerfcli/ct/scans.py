"""Conversion, checks and description of X-ray scans."""

from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.checks.examine import ScanDiagnosis, examine_scan
from nerfcli.ct.checks.page import refuse_foreign, write_scan_page
from nerfcli.ct.circle import circle_from_json, circle_of, differences
from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.formats.read import read_scan
from nerfcli.ct.formats.scan_options import ScanOptions
from nerfcli.ct.hypotheses import Judgement, judge
from nerfcli.ct.scan import Scan, is_scan, load_scan, save_scan
from nerfcli.errors import GATE_NOT_MET, UserError
from nerfcli.notices import Notify, Progress, no_progress, silent
from nerfcli.pages.findings import as_json

OWN = "nerfcli"
# Suffixes of scan files, which the name of a scan folder may not have.
_FILE_SUFFIXES = (
    ".h5",
    ".hdf5",
    ".nxs",
    ".mat",
    ".npy",
    ".txt",
    ".json",
    ".tif",
    ".tiff",
    ".xtekct",
    ".log",
)
# Maximum differences between the geometry that a source states and the one recovered from stored vectors: rounding.
TOLERANCES = {"angle_deg": 1e-9, "length": 1e-9, "shift_px": 1e-6, "tilt_deg": 1e-9}


def convert_scan(
    source: Path,
    target: Path,
    *,
    to: str = OWN,
    given: ScanOptions = ScanOptions(),
    overwrite: bool = False,
    notify: Notify = silent,
) -> dict[str, Any]:
    """Write a scan as a scan folder, and return its record as plain values.

    The folder is read back, and the angles, distances and pixel sizes stated by the source are recovered from it.

    Args:
        source: a file or folder in a known format.
        target: the folder.
        to: nerfcli; no other format holds a scan.

    Raises:
        UserError: the scan cannot be read or written, `target` exists, or the written scan differs from its source.
    """
    if to != OWN:
        raise UserError(f"a scan cannot be written as {to}", f"scans are written as {OWN}")
    if target.suffix.lower() in _FILE_SUFFIXES:
        raise UserError(f"{target}: a scan is written as a folder", f"give a folder, such as {target.stem}")
    if target.exists() and not (overwrite and is_scan(target)):
        what = "add --overwrite to replace it" if is_scan(target) else "choose another output path"
        raise UserError(f"{target} exists", what)
    if target.exists() and target.resolve() == source.resolve():
        raise UserError(f"{target} is the input itself", "choose another output path")
    scan = read_scan(source, given)
    notify(f"{source}: {scan.history.get('format')}, {in_words(scan)}")
    for note in scan.history.get("notes", ()):
        notify(note)
    save_scan(target, scan)
    stored = load_scan(target)
    checks = _read_back(scan, stored)
    notify(f"{target}: {_proof(checks)}")
    return {"from": scan.history.get("format"), "to": to, **facts_of(stored), "read_back": checks}


def detect_scan(
    source: Path, *, given: ScanOptions = ScanOptions(), notify: Notify = silent, progress: Progress = no_progress
) -> Judgement:
    """Judge direction of rotation, mirroring and centre of rotation by how well they predict the data.

    Raises:
        UserError: the scan cannot be read, or has too few views.
    """
    scan = read_scan(source, given)
    notify(f"{source}: {scan.history.get('format')}, {in_words(scan)}")
    return judge(scan, progress=progress)


def examine_scan_input(
    source: Path, page: Path, *, overwrite: bool = False, notify: Notify = silent, progress: Progress = no_progress
) -> ScanDiagnosis:
    """Run all checks of a scan, and write a page of the findings.

    Raises:
        UserError: the scan cannot be read, or the page's path holds something else.
    """
    if page.is_dir():
        raise UserError(f"{page} is a folder", "give the page's file name with -o")
    if not overwrite:
        refuse_foreign(page, source)
    scan = read_scan(source)
    notify(f"{source}: {in_words(scan)}")
    diagnosis = examine_scan(scan, progress=progress)
    write_scan_page(diagnosis, page, source=source)
    return diagnosis


def scan_diagnosis_record(diagnosis: ScanDiagnosis) -> dict[str, Any]:
    """Return a diagnosis as plain values."""
    return {
        "kind": "scan",
        "verdict": diagnosis.verdict,
        "findings": [as_json(finding) for finding in diagnosis.findings],
        "not_checked": dict(diagnosis.not_checked),
    }


def describe_scan(path: Path) -> dict[str, Any]:
    """Describe a scan folder, or a scan in a supported format.

    Raises:
        UserError: the scan cannot be read.
    """
    scan = load_scan(path) if is_scan(path) else read_scan(path)
    return {"kind": "scan", **facts_of(scan), "notes": list(scan.history.get("notes", ()))}


def facts_of(scan: Scan) -> dict[str, Any]:
    """Return the facts of a scan that `nerfcli info` shows, as plain values."""
    geometry = scan.geometry
    height, width = geometry.pixel_at_origin
    circle, apart = circle_of(geometry)
    angles = np.degrees(np.array(circle.angles))
    around = apart < 1e-3
    return {
        "measurement": "transmission",
        "format": scan.history.get("format"),
        "views": geometry.views,
        "held_out": len(scan.held_out),
        "detector": f"{geometry.columns} x {geometry.rows} pixels",
        "beam": _beam(scan),
        "values": scan.kind,
        "unit": scan.unit,
        "pixel_at_object": {"width": _rounded(width), "height": _rounded(height)},
        "magnification": _rounded(np.median(geometry.magnification)),
        "angles_deg": {"from": _rounded(angles.min()), "to": _rounded(angles.max())} if around else None,
        "orbit": "a circle" if around else "views that are not on one circle",
        "source_origin": _rounded(circle.source_origin) if around and geometry.beam == "cone" else None,
        "source_detector": _rounded(circle.source_detector) if around and geometry.beam == "cone" else None,
        "axis_column": float(f"{axis_column(geometry):.6g}"),
        "photons_per_value": scan.photons_per_value,
        "unusable": None if scan.usable is None else float(f"{1 - float(scan.usable.mean()):.4g}"),
        "truth": (scan.history.get("truth") or {}).get("path"),
    }


def _rounded(value: float) -> float:
    return float(f"{value:.6g}") + 0.0  # no minus before 0


def _beam(scan: Scan) -> str:
    return "fan" if scan.geometry.beam == "cone" and scan.geometry.rows == 1 else scan.geometry.beam


def in_words(scan: Scan) -> str:
    """Describe a scan in a few words."""
    geometry = scan.geometry
    size = f"{geometry.columns} x {geometry.rows} pixels"
    words = f"{geometry.views} views of {size}, {_beam(scan)} beam, {scan.kind.replace('_', ' ')}s"
    return words.replace("countss", "counts") + f", {len(scan.held_out)} held out"


def _read_back(scan: Scan, stored: Scan) -> dict[str, float]:
    """Return how much a scan as its source states it differs from the stored one; raise if it is more than rounding."""
    checks = {"vector": float(np.abs(stored.geometry.vectors() - scan.geometry.vectors()).max())}
    checks["value"] = float(np.abs(np.asarray(stored.values) - scan.values).max())
    largest = float(np.abs(scan.geometry.vectors()).max())
    wrong = [name for name, least in (("vector", 1e-12 * largest), ("value", 0.0)) if not checks[name] <= least]
    if "circle" in scan.history:
        found, apart = circle_of(stored.geometry)
        of_circle = differences(circle_from_json(scan.history["circle"]), found)
        wrong += [name for name, value in of_circle.items() if not value <= TOLERANCES[name]]
        checks |= {**of_circle, "orbit_px": apart}
    if wrong:
        raise UserError(
            f"the written scan differs from its source: {', '.join(f'{n} {checks[n]:.3g}' for n in wrong)}",
            "this is a bug in nerfcli; please report it with the file",
            GATE_NOT_MET,
        )
    return checks


def _proof(checks: dict[str, float]) -> str:
    if "angle_deg" not in checks:
        return "verified by reading it back: the same vectors and values"
    return (
        f"verified by reading it back: angles agree to {checks['angle_deg']:.1g} degrees, lengths to a fraction of "
        f"{checks['length']:.1g}, the axis of rotation to {checks['shift_px']:.1g} px"
    )


def judgement_record(found: Judgement) -> dict[str, Any]:
    """Return a judgement as plain values."""
    return {
        "verdict": found.verdict,
        "ratio": found.ratio,
        "standard_errors": found.margin if np.isfinite(found.margin) else None,
        "stated_column": found.stated_column,
        "centre_column": found.centre_column,
        "centre_error": found.centre_error,
        "centre_holds": found.centre_holds,
        "centre_ratio": found.centre_ratio,
        "ambiguity": found.ambiguity,
        "options": found.options,
        "hypotheses": [vars(each) for each in found.hypotheses],
    }
