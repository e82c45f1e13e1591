"""PLY files: a table of vertices, and triangles; points, meshes and splats are written and read with it.

Vertices are read in all three encodings, with their properties in any order. Files are written in binary, little
endian, with comments that describe them. Source: Greg Turk, "The PLY Polygon File Format", 1994.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError

# Begins the comment that is for programs.
KEY = "nerfcli"
_WORDS = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
_TYPES = {word: code for code, words in _WORDS.items() for word in words}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
# Longest header, in bytes.
_MOST_HEADER = 2**20
_HINT = "copy or export it again"


@dataclass(frozen=True)
class PlyElement:
    """An element: its name, its count, and the NumPy types of its properties by name; None for a list."""

    name: str
    count: int
    properties: dict[str, str | None]


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file: its encoding, elements in order, comments, and the offset of its body."""

    encoding: str
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    start: int

    def count(self, name: str) -> int:
        """Return the number of an element, 0 without it."""
        return next((element.count for element in self.elements if element.name == name), 0)

    @property
    def vertex_properties(self) -> dict[str, str | None]:
        """Properties of the vertices, see `PlyElement`; empty without vertices."""
        return next((element.properties for element in self.elements if element.name == "vertex"), {})


def read_ply_header(path: Path) -> PlyHeader:
    """Read the header of a PLY file.

    Raises:
        UserError: the file cannot be read or is no PLY file, or its header contains something else than it may.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_MOST_HEADER)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}", "the PLY file must exist and be readable") from error
    end = head.find(b"end_header")
    line_end = head.find(b"\n", end)
    if head[:3] != b"ply" or end < 0 or line_end < 0:
        fault = "it does not begin with the word ply" if head[:3] != b"ply" else "its header has no end"
        raise UserError(f"{path} is not a PLY file: {fault}", _HINT)
    encoding, elements, comments = "", [], []
    for line in head[:end].decode("utf-8", errors="replace").splitlines():
        match line.split():
            case ["format", word, _]:
                encoding = word
            case ["element", name, count] if count.isdecimal() and len(count) < 20:
                elements.append(PlyElement(name, int(count), {}))
            case ["property", "list", _, _, name] if elements and name not in elements[-1].properties:
                elements[-1].properties[name] = None
            case ["property", word, name] if elements and word in _TYPES and name not in elements[-1].properties:
                elements[-1].properties[name] = _ORDERS.get(encoding, "<") + _TYPES[word]
            case ["comment", *_]:
                comments.append(line.partition(" ")[2])
            case [] | ["ply"] | ["obj_info", *_]:
                pass
            case _:
                raise UserError(f"{path}: its header has the line {line.strip()[:80]!r}", _HINT)
    if encoding not in _ORDERS:
        raise UserError(f"{path}: its format is {encoding[:40]!r}, expected {', '.join(_ORDERS)}", _HINT)
    return PlyHeader(encoding, tuple(elements), tuple(comments), line_end + 1)


def read_ply_vertices(path: Path) -> np.ndarray:
    """Read the vertices as a structured array (N,) with a field for each property; a binary file is mapped, not loaded.

    Raises:
        UserError: see `read_ply_header`; or there are no vertices, they contain lists, or the file is cut short.
    """
    header = read_ply_header(path)
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise UserError(f"{path}: it has no element vertex", _HINT)
    before, vertex = header.elements[: names.index("vertex")], header.elements[names.index("vertex")]
    dtype = np.dtype([(name, kind) for name, kind in vertex.properties.items() if kind is not None])
    if None in vertex.properties.values():
        raise UserError(f"{path}: its vertices contain lists", _HINT)
    if header.encoding == "ascii":
        return _ascii_rows(path, header.start, sum(element.count for element in before), vertex.count, dtype)
    start = header.start
    for element in before:
        kinds = [kind for kind in element.properties.values() if kind is not None]
        if len(kinds) < len(element.properties):
            raise UserError(f"{path}: its element {element.name} contains lists and precedes the vertices", _HINT)
        start += element.count * sum(np.dtype(kind).itemsize for kind in kinds)
    there = max(0, path.stat().st_size - start)
    if vertex.count * dtype.itemsize > there:
        raise UserError(
            f"{path} is truncated: its header announces {vertex.count} vertices, but {there} bytes follow", _HINT
        )
    if not vertex.count:
        return np.zeros(0, dtype)
    return np.memmap(path, dtype, mode="r", offset=start, shape=(vertex.count,))


def _ascii_rows(path: Path, start: int, num_before: int, count: int, dtype: np.dtype) -> np.ndarray:
    text = path.read_bytes()[start:].decode("ascii", errors="replace")
    lines = [line for line in text.splitlines() if line.strip()][num_before:]
    if count > len(lines):
        raise UserError(
            f"{path} is truncated: its header announces {count} vertices, but {len(lines)} lines are there", _HINT
        )
    names = dtype.names or ()
    rows = [line.split()[: len(names)] for line in lines[:count]]
    if any(len(row) < len(names) for row in rows):
        raise UserError(f"{path}: a vertex has fewer than {len(names)} numbers", _HINT)
    table = np.zeros(count, dtype)
    try:
        values = np.array(rows, dtype=np.float64).reshape(count, len(names))
        with np.errstate(invalid="raise"):
            for column, name in enumerate(names):
                table[name] = values[:, column]
    except (ValueError, FloatingPointError) as error:
        raise UserError(f"{path}: {error}", _HINT) from error
    return table


def read_ply_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the vertices (N, 3) and triangles (F, 3), int64, of a binary PLY whose faces hold only three indices.

    Raises:
        UserError: the file is of another kind, or cut short.
    """
    header, vertices = read_ply_header(path), read_ply_vertices(path)
    faces, triangles = _face_type(_ORDERS[header.encoding]), header.count("face")
    data = path.read_bytes()
    start = header.start + vertices.nbytes
    if header.encoding == "ascii" or len(data) < start + triangles * faces.itemsize:
        raise UserError(f"{path} is not a binary PLY file of triangles, or is truncated", _HINT)
    listed = np.frombuffer(data, faces, triangles, start)
    return np.stack([vertices[axis] for axis in "xyz"], axis=-1), listed["vertices"].astype(np.int64)


def write_ply(
    path: Path,
    columns: Mapping[str, np.ndarray],
    *,
    faces: np.ndarray | None = None,
    description: Mapping[str, Any] | None = None,
) -> None:
    """Write vertices, and triangles if there are any, atomically.

    Args:
        columns: vertex properties by name, (N,) of a NumPy type that PLY has.
        faces: (F, 3).
        description: written as comments, see `comments_of`.

    Raises:
        UserError: the file cannot be written.
    """
    with atomic_path(path) as partial:
        partial.write_bytes(ply_bytes(columns, faces=faces, description=description))


def ply_bytes(
    columns: Mapping[str, np.ndarray],
    *,
    faces: np.ndarray | None = None,
    description: Mapping[str, Any] | None = None,
) -> bytes:
    """Return what `write_ply` writes."""
    table = np.zeros(len(next(iter(columns.values()))), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {line}" for line in (comments_of(description) if description else ())]
    lines += [f"element vertex {len(table)}"]
    lines += [f"property {_WORDS[values.dtype.str[1:]][0]} {name}" for name, values in columns.items()]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    head = "\n".join([*lines, "end_header", ""]).encode("ascii")
    triangles = np.zeros(0 if faces is None else len(faces), _face_type("<"))
    if faces is not None:
        triangles["count"], triangles["vertices"] = 3, faces
    return b"".join([head, table.tobytes(), triangles.tobytes()])


def _face_type(order: str) -> np.dtype:
    return np.dtype([("count", "u1"), ("vertices", f"{order}i4", 3)])


def comments_of(description: Mapping[str, Any]) -> list[str]:
    """Return the comment lines that describe a file, first for people, then for programs; in ASCII, as PLY wants it."""
    unit, source = description.get("unit"), description.get("unit_source")
    stated = {"metre": "metre", "arbitrary": "arbitrary, the scale of the scene is not known"}.get(str(unit), str(unit))
    lines = [
        "written by nerfcli",
        f"unit {stated}{f' ({source})' if source else ''}",
        f"frame {description.get('frame')}",
        f"{KEY} {json.dumps(dict(description), ensure_ascii=True, allow_nan=False)}",
    ]
    return [line.replace("±", "+-").encode("ascii", "backslashreplace").decode() for line in lines]


def description_in(comments: Iterable[str]) -> dict[str, Any]:
    """Return the description that `comments_of` wrote; empty if there is none."""
    for comment in comments:
        if comment.startswith(f"{KEY} {{"):
            try:
                return json.loads(comment.partition(" ")[2])
            except ValueError:
                break
    return {}
