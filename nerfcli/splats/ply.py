"""Splats as the .ply of the authors of 3D Gaussian splatting, which nearly every program reads and writes.

A binary little-endian PLY with one vertex per Gaussian and these properties, all float: x y z, nx ny nz (unused, 0),
f_dc_0..2 (the harmonic of degree 0, red, green, blue), f_rest_0.. (those of degrees 1 to 3: all of red, then all of
green, then all of blue), opacity (logit), scale_0..2 (logarithms), rot_0..3 (quaternion w x y z).
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured

from nerfcli.errors import UserError, listed, several
from nerfcli.ply import read_ply_header, read_ply_vertices, write_ply
from nerfcli.splats.gaussians import Gaussians

# Logit that stands for an infinite one, in files in which an opacity of exactly 1 or 0 was converted: 1 - 2e-9.
_CERTAIN = 20.0
# Rows converted at a time: 16 MB of a file of degree 3.
_ROWS = 2**16
_ELSEWHERE = "open it in SuperSplat (superspl.at/editor) and export it as .ply"


def write_splat_ply(path: Path, gaussians: Gaussians, description: Mapping[str, Any] | None = None) -> None:
    """Write Gaussians, atomically, with their description as comments; quaternions are written with norm 1.

    Raises:
        UserError: the file cannot be written.
    """
    write_ply(path, splat_columns(gaussians), description=description)


def splat_columns(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the properties (N,) of a file by name, in the order of files."""
    count, harmonics = len(gaussians), gaussians.harmonics
    norms = np.linalg.norm(gaussians.quaternions.astype(np.float64), axis=1, keepdims=True)
    values = [
        *(gaussians.means, np.zeros((count, 3)), harmonics[:, 0]),
        *(harmonics[:, 1:].transpose(0, 2, 1).reshape(count, -1), gaussians.logits[:, None]),
        *(gaussians.log_scales, gaussians.quaternions / norms),
    ]
    names = [*("x", "y", "z", "nx", "ny", "nz"), *_names(gaussians.degree)[3:]]
    columns = np.concatenate(values, axis=1, dtype=np.float32, casting="same_kind").T
    return dict(zip(names, columns, strict=True))


def read_splat_ply(path: Path, notify: Callable[[str], None]) -> Gaussians:
    """Read Gaussians that any program wrote: properties in any order, further ones and further elements ignored.

    A binary file is mapped, not loaded. Infinite logits become +-20; Gaussians with other numbers that are not finite,
    or with a quaternion of norm 0, are left out, and `notify` is called with their number.

    Raises:
        UserError: it is no such file, or truncated, or none of its Gaussians is finite.
    """
    header = read_ply_header(path)
    properties = header.vertex_properties
    if "packed_position" in properties or header.count("chunk"):
        raise UserError(f"{path} is a compressed .ply of PlayCanvas, which nerfcli does not read", _ELSEWHERE)
    if missing := [name for name in _names(0) if name not in properties]:
        what = "a mesh" if header.count("face") else "points" if "x" in properties else "something else"
        hint = "expected the .ply of 3D Gaussian splatting, whose vertices have x, f_dc_0, opacity, scale_0, rot_0, ..."
        raise UserError(f"{path} holds {what}, not splats: {listed(missing)} missing", hint)
    rest = sum(name.startswith("f_rest_") for name in properties)
    degree = {0: 0, 9: 1, 24: 2, 45: 3}.get(rest)
    if degree is None or not properties.keys() >= set(_names(degree)):
        raise UserError(
            f"{path} has {rest} properties f_rest_, expected f_rest_0 to f_rest_8, f_rest_23 or f_rest_44, or none",
            f"nerfcli reads harmonics of degrees 0 to 3; {_ELSEWHERE}",
        )
    table = read_ply_vertices(path)
    if not len(table):
        raise UserError(f"{path} holds no splats", "export it once more")
    return _from_table(path, table, _names(degree), notify=notify)


def _from_table(path: Path, table: np.ndarray, names: list[str], *, notify: Callable[[str], None]) -> Gaussians:
    """Return the Gaussians of a table whose columns have the names of `_names`."""
    shapes = ((3,), (3,), (4,), (), ((len(names) - 11) // 3, 3))
    arrays = [np.empty((len(table), *shape), np.float32) for shape in shapes]
    kept = 0
    for at in range(0, len(table), _ROWS):
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite, and is left out below
            values = structured_to_unstructured(table[at : at + _ROWS][names], np.float32, copy=True)
        logits = values[:, -8]
        np.copyto(logits, np.sign(logits) * np.float32(_CERTAIN), where=np.isinf(logits))
        # The norm of smaller ones, squared, is 0 in float32.
        values = values[np.isfinite(values).all(axis=1) & (np.abs(values[:, -4:]).max(axis=1) > 1e-18)]
        rest = values[:, 6:-8].reshape(len(values), 3, (len(names) - 14) // 3)
        harmonics = np.concatenate([values[:, None, 3:6], rest.transpose(0, 2, 1)], axis=1)
        parts = (values[:, :3], values[:, -7:-4], values[:, -4:], values[:, -8], harmonics)
        for array, part in zip(arrays, parts, strict=True):
            array[kept : kept + len(values)] = part
        kept += len(values)
    if not kept:
        raise UserError(f"{path}: none of its {several(len(table), 'splat')} has finite numbers", "export it once more")
    if kept < len(table):
        notify(f"{path}: {len(table) - kept} of {len(table)} splats left out, whose numbers are not finite")
    return Gaussians(*(array[:kept] for array in arrays))


def _names(degree: int) -> list[str]:
    """Return the names of the properties, in the order of files, without the normals."""
    return [
        *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{index}" for index in range(3 * ((degree + 1) ** 2 - 1))),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
