"""Pickles of NAF (Neural Attenuation Fields) and of its successors SAX-NeRF and X-Gaussian; they are not executed.

Lengths are in mm. The projections were computed with lengths in metres, from volumes whose values are in 1/m. As line
integrals have no unit, they are kept as they are; a value of 1 in the volume is 0.001/mm.
"""

import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.errors import UserError
from nerfcli.tomography.circle import Circle
from nerfcli.tomography.formats.assemble import ReaderOutput, scan_of
from nerfcli.tomography.formats.scan_options import ScanOptions, angles_in_radians
from nerfcli.tomography.scan import Scan
from nerfcli.tomography.truth import described_truth

SUFFIXES = (".pickle", ".pkl")
ATTENUATION_PER_VALUE = 1e-3
# Callables that rebuild NumPy's arrays and scalars, by their names in NumPy 1 and 2. None executes its arguments.
_ARRAYS = {
    (module, name)
    for package in ("numpy.core", "numpy._core")
    for module, name in (
        (f"{package}.multiarray", "_reconstruct"),
        (f"{package}.multiarray", "scalar"),
        (f"{package}.numeric", "_frombuffer"),
    )
} | {("numpy", "ndarray"), ("numpy", "dtype"), ("collections", "OrderedDict")}
_HINT = "expected a pickle of NAF: a dict with DSD, DSO, nDetector, dDetector, mode, train and val"


class _RefusedError(Exception):
    """A pickle refers to something other than arrays and plain containers."""


class _PlainUnpickler(pickle.Unpickler):
    """Unpickler of arrays, numbers, texts and plain containers; refuses all else before it is imported or called."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        if (module_name, global_name) in _ARRAYS:
            return super().find_class(module_name, global_name)
        if (module_name, global_name) == ("_codecs", "encode"):  # bytes of arrays in old protocols
            return _latin
        raise _RefusedError(f"{module_name}.{global_name}")


def _latin(text: str, encoding: str = "latin1") -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise _RefusedError(f"_codecs.encode with {encoding!r}")
    return text.encode("latin1")


def load_plain(path: Path) -> Any:
    """Load the content of a pickle of arrays and plain containers; nothing in it is executed.

    Raises:
        UserError: it tries to call something else, is damaged, or cannot be read.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}", "give the path of a pickle") from error
    try:
        return _PlainUnpickler(io.BytesIO(content)).load()
    except _RefusedError as error:
        raise UserError(
            f"{path} tries to call {error} and was not opened",
            "pickles can run any program; only arrays, numbers, texts and plain containers are read",
        ) from error
    except Exception as error:  # a damaged pickle ends in any exception: EOFError, KeyError, ValueError, ...
        raise UserError(f"{path} cannot be read as a pickle: {error or 'it ends early'}", _HINT) from error


def read_naf(path: Path, given: ScanOptions = ScanOptions()) -> Scan:
    """Read a pickle with train and val projections; val is held out.

    Raises:
        UserError: see `load_plain`; or something is missing or does not fit together.
    """
    data = load_plain(path)
    if not isinstance(data, Mapping):
        raise UserError(f"{path} holds a {type(data).__name__}", _HINT)
    projections, angles, counts = [], [], []
    for part in ("train", "val"):
        if part == "val" and part not in data:
            continue
        views = _entry(data, part, path)
        stack = np.asarray(_entry(views, "projections", path), dtype=np.float32)
        if stack.ndim != 3:
            raise UserError(f"{path}: {part} projections of shape {stack.shape}", "expected views x rows x columns")
        projections.append(stack)
        where = f"{path}: {part} angles"
        angles.append(
            angles_in_radians(_numbers(_entry(views, "angles", path)), views=len(stack), unit="rad", where=where)
        )
        counts.append(len(stack))
    if any(stack.shape[1:] != projections[0].shape[1:] for stack in projections):
        raise UserError(f"{path}: train and val projections have different sizes", _HINT)
    rows, columns = projections[0].shape[1:]
    sides, offsets = _detector(data, path, rows=rows, columns=columns)
    mode = str(_entry(data, "mode", path))
    if mode not in ("cone", "parallel"):
        raise UserError(f"{path}: mode {mode!r}", "cone and parallel beams are read")
    cone = mode == "cone"
    circle = Circle(
        "cone" if cone else "parallel",
        tuple(np.concatenate(angles).tolist()),
        *sides,
        rows,
        columns,
        _number(data, "DSO", path) if cone else 0.0,
        _number(data, "DSD", path) if cone else 0.0,
        column_shift=offsets[0] / sides[0],
        row_shift=offsets[1] / sides[1],
    )
    held_out = range(counts[0], sum(counts)) if len(counts) == 2 else None
    found = ReaderOutput(
        *(path, "naf", np.concatenate(projections), "line_integral", circle, "mm"),
        held_out=held_out,
        history=_truth(data, path),
    )
    return scan_of(found, given)


def _detector(
    data: Mapping[str, Any], path: Path, *, rows: int, columns: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return width and height of a pixel, and offsets to the right and down, in the order that fits the projections.

    NAF writes (columns, rows), and some of its successors (rows, columns).
    """
    count = [round(float(n)) for n in _numbers(_entry(data, "nDetector", path))]
    side = _numbers(_entry(data, "dDetector", path)).tolist()
    offset = _numbers(data.get("offDetector", (0.0, 0.0))).tolist()
    if len(count) != 2 or len(side) != 2 or len(offset) < 2 or not min(side) > 0:
        raise UserError(f"{path}: a detector of {count} pixels of {side} mm", "expected two numbers above 0 each")
    if count == [columns, rows]:
        return (side[0], side[1]), (offset[0], offset[1])
    if count == [rows, columns]:
        return (side[1], side[0]), (offset[1], offset[0])
    raise UserError(
        f"{path}: projections of {columns} x {rows} pixels, but nDetector is {count[0]} x {count[1]}",
        "its parts do not fit together: export it again",
    )


def _truth(data: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Describe the volume that the projections were computed from, if its voxels are cubic; else return nothing."""
    image = data.get("image")
    side = np.asarray(data.get("dVoxel", ()), dtype=np.float64).reshape(-1)
    if not isinstance(image, np.ndarray) or image.ndim != 3 or len(side) != 3 or np.ptp(side) > 1e-9 * side[0]:
        return {}
    shape = [int(n) for n in reversed(image.shape)]
    return described_truth(path, "xyz", shape, size=float(side[0]), attenuation_per_value=ATTENUATION_PER_VALUE)


def _entry(data: Any, name: str, path: Path) -> Any:
    if not isinstance(data, Mapping) or name not in data:
        raise UserError(f"{path} has no {name}", _HINT)
    return data[name]


def _numbers(value: Any) -> np.ndarray:
    try:
        return np.asarray(value, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        return np.array([np.nan])


def _number(data: Mapping[str, Any], name: str, path: Path) -> float:
    value = _numbers(_entry(data, name, path))
    if len(value) != 1 or not (np.isfinite(value[0]) and value[0] > 0):
        raise UserError(f"{path}: {name} is {data[name]!r}", "expected a distance in mm above 0")
    return float(value[0])
