"""Describe scans and reconstructions as plain values."""

from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.formats.read import read_scan
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.recognise import is_reconstruction
from nerfcli.ct.result import load_reconstruction
from nerfcli.ct.scan import MEASUREMENT, Scan


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
