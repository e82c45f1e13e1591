"""Scans in any format: read, described as plain values, and converted to scan folders; reconstructions described."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.formats import hdf5, heltomo, nikon, r2_gaussian, skyscan, stated_stack, transmission_transforms
from nerfcli.ct.formats.assemble import ReaderOutput, axis_column, scan_of
from nerfcli.ct.formats.statement import ScanOptions
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.recognise import MEASUREMENT, OWN, files_of, is_reconstruction, is_scan, recognise
from nerfcli.ct.result import load_reconstruction
from nerfcli.ct.scan import Scan, load_scan, save_scan
from nerfcli.errors import UserError
from nerfcli.notices import Reporter
from nerfcli.output import Output

# Reader of each format; its UserError says what cannot be read, is missing, or does not fit the rest.
READERS: dict[str, Callable[[Path], ReaderOutput]] = {
    "data-exchange": hdf5.read_data_exchange,
    "nxtomo": hdf5.read_nxtomo,
    "r2-gaussian": r2_gaussian.read_r2_gaussian,
    "nikon": nikon.read_nikon,
    "skyscan": skyscan.read_skyscan,
    "heltomo": heltomo.read_heltomo,
    "stack": stated_stack.read_stated_stack,
    "transmission-transforms": transmission_transforms.read_transmission_transforms,
}


def read_scan(path: Path, given: ScanOptions = ScanOptions()) -> Scan:
    """Read a scan in any supported format.

    Raises:
        UserError: it is no scan, or cannot be read.
    """
    form = recognise(path)
    if form is None:
        if not os.path.exists(path):
            raise UserError(f"{path} does not exist", "give the file or folder of a scan")
        formats = ", ".join((OWN, *READERS))
        raise UserError(f"{path} is not a scan in a supported format", f"supported formats: {formats}")
    if form == OWN:
        if given != ScanOptions():
            raise UserError(f"{path} is a scan that was converted already", "set options when converting it")
        return load_scan(path if path.is_dir() else path.parent)
    files = files_of(path, form) if path.is_dir() else []
    return scan_of(READERS[form](files[0] if files else path), given)


# Suffixes of scan files, which the name of a scan folder may not have.
_FILE_SUFFIXES = (".h5", ".hdf5", ".nxs", ".mat", ".npy", ".txt", ".json", ".tif", ".tiff", ".xtekct", ".log")


def convert_scan(
    source: Path,
    output: Output,
    *,
    given: ScanOptions = ScanOptions(),
    reporter: Reporter = Reporter(),
) -> dict[str, Any]:
    """Write a scan as a scan folder, and return its record as plain values.

    Args:
        source: a file or folder in a known format.
        output: the folder, whose path is given.

    Raises:
        UserError: the scan cannot be read or written, or the output exists.
    """
    target = output.at(source)
    if target.suffix.lower() in _FILE_SUFFIXES:
        raise UserError(f"{target}: a scan is written as a folder", f"give a folder, such as {target.stem}")
    if os.path.exists(target) and not (output.overwrite and is_scan(target)):
        what = "add --overwrite to replace it" if is_scan(target) else "choose another output path"
        raise UserError(f"{target} exists", what)
    if os.path.exists(target) and target.resolve() == source.resolve():
        raise UserError(f"{target} is the input itself", "choose another output path")
    scan = read_scan(source, given)
    reporter.note(f"{source}: {scan.history.get('format')}, {in_words(scan)}")
    for note in scan.history.get("notes", ()):
        reporter.note(note)
    save_scan(target, scan)
    return {"from": scan.history.get("format"), **facts_of(scan)}


def describe(path: Path) -> dict[str, Any]:
    """Describe a reconstruction, or a scan in a supported format.

    Raises:
        UserError: the path is neither, or damaged.
    """
    if is_reconstruction(path):
        return _describe_reconstruction(path)
    scan = read_scan(path)
    return {"kind": "scan", **facts_of(scan), "notes": list(scan.history.get("notes", ()))}


def _describe_reconstruction(run: Path) -> dict[str, Any]:
    result = load_reconstruction(run)
    return {
        "kind": "reconstruction",
        "scan": str(result.scan),
        "voxels": "x".join(str(count) for count in reversed(result.grid.shape)),
        "voxel_size": result.grid.size,
        "unit": result.unit,
        "passes": result.passes,
        "seconds": round(result.seconds, 1),
        "settled": result.settled,
        "decisions": list(result.decisions),
    }


def facts_of(scan: Scan) -> dict[str, Any]:
    """Return the facts of a scan that `nerfcli ct info` shows, as plain values."""
    geometry = scan.geometry
    height, width = geometry.pixel_at_origin
    return {
        "measurement": MEASUREMENT,
        "format": scan.history.get("format"),
        "views": geometry.views,
        "held_out": len(scan.held_out),
        "detector": f"{geometry.columns} x {geometry.rows} pixels",
        "beam": _beam(scan),
        "values": scan.kind,
        "unit": scan.unit,
        "pixel_at_object": {"width": _rounded(width), "height": _rounded(height)},
        "magnification": _rounded(np.median(geometry.magnification)),
        **_orbit(geometry),
        "axis_column": float(f"{axis_column(geometry):.6g}"),
        "photons_per_value": scan.photons_per_value,
        "unusable": None if scan.usable is None else float(f"{1 - float(scan.usable.mean()):.4g}"),
        "truth": (scan.history.get("truth") or {}).get("path"),
    }


def _orbit(geometry: ScanGeometry) -> dict[str, Any]:
    """Return the angles, and the distances of a cone beam, along the normals of the detector."""
    if not geometry.is_circular:
        return {"orbit": "views that are not on one circle"}
    parallel = geometry.beam == "parallel"
    to_source = -geometry.emitter if parallel else geometry.emitter - geometry.centre
    outward = np.cross(geometry.column_step, geometry.row_step)
    outward *= np.sign((outward * to_source).sum(1, keepdims=True)) / np.linalg.norm(outward, axis=1, keepdims=True)
    angles = np.degrees(np.unwrap(np.arctan2(outward[:, 1], outward[:, 0])))
    distances = {"source_origin": geometry.emitter, "source_detector": to_source}
    return {
        "angles_deg": {"from": _rounded(angles.min()), "to": _rounded(angles.max())},
        "orbit": "a circle",
        **{name: None if parallel else _rounded(np.median((v * outward).sum(1))) for name, v in distances.items()},
    }


def _rounded(value: float) -> float:
    return float(f"{value:.6g}") + 0.0  # no minus before 0


def _beam(scan: Scan) -> str:
    return "fan" if scan.geometry.beam == "cone" and scan.geometry.rows == 1 else scan.geometry.beam


def in_words(scan: Scan) -> str:
    """Describe a scan in a few words."""
    geometry = scan.geometry
    size = f"{geometry.columns} x {geometry.rows} pixels"
    kind = scan.kind.removesuffix("s").replace("_", " ")
    return f"{geometry.views} views of {size}, {_beam(scan)} beam, {kind}s, {len(scan.held_out)} held out"
