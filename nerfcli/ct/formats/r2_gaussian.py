"""Folders of R2-Gaussian: meta_data.json, one .npy of line integrals per projection, and the volume.

Angles are in radians, detector sizes are [v, u], the offset of the detector is [u, v] with v upwards as in TIGRE.
Lengths have no unit: the volume is about 2 wide.
"""

from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.formats.assemble import UNKNOWN_UNIT, ReaderOutput
from nerfcli.ct.formats.pictures import read_npy
from nerfcli.ct.formats.statement import Statement, angles_in_radians, read_object
from nerfcli.ct.geometry import BEAMS, Circle
from nerfcli.ct.recognise import R2_GAUSSIAN
from nerfcli.ct.scan import described_truth
from nerfcli.errors import UserError

_HINT = "expected R2-Gaussian's meta_data.json: scanner, proj_train and proj_test"


def read_r2_gaussian(path: Path) -> ReaderOutput:
    """Read a folder with a meta_data.json, or the meta_data.json itself; proj_test is held out."""
    file = path / R2_GAUSSIAN if path.is_dir() else path
    meta = read_object(file, hint=_HINT)
    scanner = meta.nested("scanner")
    frames = [
        (part, frame) for part in ("proj_train", "proj_test") for frame in _list(meta.value(part, []), part, file)
    ]
    if not frames:
        raise UserError(f"{file} names no projections", _HINT)
    values = [_projection(file, frame) for _, frame in frames]
    if any(value.shape != values[0].shape for value in values):
        raise UserError(
            f"{file}: projections have different sizes",
            "all projections of a scan must have one size: remove the others",
        )
    rows, columns = values[0].shape
    angles = angles_in_radians(
        np.array([_angle(frame) for _, frame in frames]), views=len(frames), unit="rad", where=f"{file}: angle"
    )
    beam = scanner.one_of("mode", BEAMS)
    count = _pair(scanner, "nDetector")
    if "dDetector" in scanner:
        height, width = _pair(scanner, "dDetector")
    else:
        size = _pair(scanner, "sDetector")
        height, width = size[0] / count[0], size[1] / count[1]
    if (round(count[0]), round(count[1])) != (rows, columns):
        raise UserError(
            f"{file}: projections of {columns} x {rows} pixels, but nDetector is {count[1]:g} x {count[0]:g}",
            "nDetector is [rows, columns]: correct it, or the projections",
        )
    if not (width > 0 and height > 0):
        raise UserError(f"{file}: pixels of {width:g} x {height:g}", "give sizes above 0 in sDetector or dDetector")
    right, up = _pair(scanner, "offDetector", (0.0, 0.0))
    cone = beam == "cone"
    circle = Circle(
        beam,
        tuple(angles.tolist()),
        *(width, height, rows, columns),
        scanner.positive("DSO") if cone else 0.0,
        scanner.positive("DSD") if cone else 0.0,
        column_shift=right / width,
        row_shift=-up / height,
    )
    held_out = [view for view, (part, _) in enumerate(frames) if part == "proj_test"]
    return ReaderOutput(
        *(path, "r2-gaussian", np.stack(values), "line_integral", circle, UNKNOWN_UNIT),
        held_out=held_out or None,
        notes=["lengths have no unit in this format: attenuation is in 1 / its unit of length"],
        truth=_truth(meta, scanner, file),
    )


def _projection(file: Path, frame: dict[str, Any]) -> np.ndarray:
    name = frame.get("file_path")
    if not isinstance(name, str):
        raise UserError(f"{file}: a projection has no file_path", _HINT)
    place = file.parent / name.replace("\\", "/")
    array = read_npy(place, hint=f"{R2_GAUSSIAN} lists it: restore the projection, or export it again")
    if array.ndim != 2:
        raise UserError(f"{place} has shape {array.shape}", "a projection is rows x columns")
    return array.astype(np.float32)


def _truth(meta: Statement, scanner: Statement, file: Path) -> dict[str, Any] | None:
    """Describe the true volume, if its file exists and its voxels are cubic."""
    name = meta.value("vol", meta.value("ct"))
    if not isinstance(name, str) or not (file.parent / name).is_file():
        return None
    count = np.array(_numbers(scanner.value("nVoxel")))
    size = np.array(_numbers(scanner.value("sVoxel")))
    middle = np.array(_numbers(scanner.value("offOrigin", (0.0, 0.0, 0.0))))
    if not (len(count) == len(size) == len(middle) == 3):
        return None
    side = size / count
    if np.ptp(side) > 1e-9 * side[0]:
        return None
    shape, first = [round(n) for n in count[::-1].tolist()], (middle - (count - 1) / 2 * side).tolist()
    return described_truth(
        file.parent / name, "xyz", shape, first=first, size=float(side[0]), attenuation_per_value=1.0
    )


def _angle(frame: dict[str, Any]) -> float:
    value = frame.get("angle")
    return float(value) if isinstance(value, int | float) else float("nan")


def _list(value: Any, name: str, file: Path) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise UserError(f"{file}: {name} is not a list of projections", _HINT)
    return value


def _numbers(value: Any) -> list[float]:
    try:
        return [float(number) for number in value]
    except (TypeError, ValueError):
        return []


def _pair(fields: Statement, name: str, default: tuple[float, float] | None = None) -> tuple[float, float]:
    value = _numbers(fields.value(name, default))
    if len(value) < 2 or not np.isfinite(value).all():
        raise UserError(f"{fields.path}: {name} is {fields.value(name)!r}", "expected two numbers")
    return value[0], value[1]
