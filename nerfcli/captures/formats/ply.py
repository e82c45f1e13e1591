"""PLY files: the points of a capture with their colours.

Read in all three encodings, with the properties of a vertex in any order; written in binary, little endian, positions
as float64. Source: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.cameras.frame import Capture
from nerfcli.captures.formats.limits import plausible
from nerfcli.captures.formats.unsupported import lost_parts
from nerfcli.errors import UserError

_TYPES = {
    word: code
    for code, words in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for word in words
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


@dataclass(frozen=True)
class _Element:
    """An element of the header: its name, its count, and the names and types of its properties (None: a list)."""

    name: str
    count: int
    properties: list[tuple[str, str | None]]


def read_ply_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the vertices of a PLY file and their colours.

    Returns:
        points (N, 3) float64; colours (N, 3) uint8, or None where vertices have none. Colours that are stored as floats
        are taken to be in [0, 1].

    Raises:
        UserError: the file is missing, damaged, or has no vertices with x, y and z.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}", "the PLY file must exist and be readable") from error
    try:
        return _points(data)
    except ValueError as error:
        raise UserError(
            f"{path}: {error}", "expected a PLY file of vertices with x, y, z; the file is truncated or of another kind"
        ) from error


def losses_ply(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that a PLY file of points cannot hold."""
    cameras = f"{len(capture.frames)} cameras and their poses"
    return (cameras, *lost_parts(capture, holds=("points", "colours")))


def write_ply(capture: Capture, path: Path) -> None:
    """Write the points of a capture, with their colours if it has any, atomically.

    Raises:
        UserError: the file cannot be written.
    """
    fields = [(name, "<f8") for name in "xyz"]
    columns = [*capture.points.T]
    if capture.colours is not None:
        fields += [(name, "u1") for name in _COLOURS[0]]
        columns += [*capture.colours.T]
    vertices = np.zeros(len(capture.points), np.dtype(fields))
    for (name, _), column in zip(fields, columns, strict=True):
        vertices[name] = column
    lines = ["ply", "format binary_little_endian 1.0", "comment written by nerfcli", f"element vertex {len(vertices)}"]
    lines += [f"property {'double' if kind == '<f8' else 'uchar'} {name}" for name, kind in fields]
    header = "\n".join([*lines, "end_header", ""])
    with atomic_path(path) as partial:
        partial.write_bytes(header.encode("ascii") + vertices.tobytes())


def _points(data: bytes) -> tuple[np.ndarray, np.ndarray | None]:
    encoding, elements, start = _header(data)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ValueError("it has no element vertex")
    before, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    fields = [name for name, _ in vertex.properties]
    if len(set(fields)) < len(fields) or not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"its vertices have the properties {', '.join(fields) or 'none'}")
    if any(kind is None for _, kind in vertex.properties):
        raise ValueError("its vertices contain lists")
    if encoding == "ascii":
        table = _ascii_columns(data[start:], sum(element.count for element in before), vertex)
    else:
        table = _binary_columns(data, start, before=before, vertex=vertex, order=_ORDERS[encoding])
    points = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=-1)
    if not plausible(points).all():
        raise ValueError(f"vertex {int(np.argmin(plausible(points)))} has an invalid position")
    kinds = dict(vertex.properties)
    channels = next((names for names in _COLOURS if set(names) <= set(fields)), None)
    if channels is None:
        return points, None
    return points, np.stack([_as_bytes(table[name], str(kinds[name])) for name in channels], axis=-1)


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Return the encoding, the elements, and the offset of the body."""
    if data[:3] != b"ply":
        raise ValueError("it does not begin with the word ply")
    end = data.find(b"end_header")
    line_end = data.find(b"\n", end)
    if end < 0 or line_end < 0:
        raise ValueError("its header has no end")
    encoding, elements = "", []
    for line in data[:end].decode("ascii", errors="replace").splitlines():
        match line.split():
            case ["format", word, _]:
                encoding = word
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties.append((name, None))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name, _TYPES[kind]))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header has the line {line[:80]!r}")
    if encoding not in _ORDERS:
        raise ValueError(f"its format is {encoding[:40]!r}, expected {', '.join(_ORDERS)}")
    if any(element.count < 0 for element in elements):
        raise ValueError("its header has a negative count")
    return encoding, elements, line_end + 1


def _ascii_columns(body: bytes, num_before: int, vertex: _Element) -> dict[str, np.ndarray]:
    lines = [line for line in body.decode("ascii", errors="replace").splitlines() if line.strip()]
    if num_before + vertex.count > len(lines):
        raise ValueError(f"its header announces {vertex.count} vertices, but {len(lines) - num_before} lines are there")
    width = len(vertex.properties)
    rows = [line.split()[:width] for line in lines[num_before : num_before + vertex.count]]
    if any(len(row) < width for row in rows):
        raise ValueError(f"a vertex has fewer than {width} numbers")
    table = np.array(rows, dtype=np.float64).reshape(-1, width)
    return {name: table[:, column] for column, (name, _) in enumerate(vertex.properties)}


def _binary_columns(
    data: bytes, start: int, *, before: list[_Element], vertex: _Element, order: str
) -> dict[str, np.ndarray]:
    for element in before:
        if any(kind is None for _, kind in element.properties):
            raise ValueError(f"its element {element.name} contains lists and precedes the vertices")
        start += element.count * sum(np.dtype(kind).itemsize for _, kind in element.properties)
    dtype = np.dtype([(name, f"{order}{kind}") for name, kind in vertex.properties])
    if vertex.count * dtype.itemsize > len(data) - start:
        raise ValueError(f"its header announces {vertex.count} vertices, but {max(0, len(data) - start)} bytes follow")
    table = np.frombuffer(data, dtype, count=vertex.count, offset=start)
    return {name: table[name] for name, _ in vertex.properties}


def _as_bytes(channel: np.ndarray, kind: str) -> np.ndarray:
    """Return a colour channel as uint8."""
    most = 1.0 if kind.startswith("f") else 255.0
    if kind not in ("u1", "f4", "f8") or not ((channel >= 0) & (channel <= most)).all():
        raise ValueError(f"its colours are not numbers from 0 to {most:g}")
    return np.round(channel.astype(np.float64) * (255.0 / most)).astype(np.uint8)
