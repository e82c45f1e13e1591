"""PLY files: the points of a capture with their colours, and its cameras as frusta to look at.

Read in all three encodings, with the properties of a vertex in any order; written in binary, little endian, positions
as float64. Source: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from nerfcli.atomic import atomic_path
from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.limits import plausible
from nerfcli.cameras.formats.losses import lost_parts
from nerfcli.cameras.frame import Capture
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

# A frustum is as deep as this part of the distance between typical neighbours, so that they do not hide each other.
_FRUSTUM_PART = 0.5


@dataclass(frozen=True)
class _Element:
    """An element of the header: its name, how many there are, and its properties' names and types (None: a list)."""

    name: str
    count: int
    properties: list[tuple[str, str | None]]


def read_ply_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """The vertices of a PLY file and their colours.

    Returns:
        points (N, 3) float64; colours (N, 3) uint8, or None where vertices have none. Colours that are stored as floats
        are taken to be in [0, 1].

    Raises:
        UserError: the file is missing, damaged, or has no vertices with x, y and z.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}", "the PLY file must be there and readable") from error
    try:
        return _points(data)
    except ValueError as error:
        raise UserError(
            f"{path}: {error}", "expected a PLY file of vertices with x, y, z; it is cut off or something else"
        ) from error


def losses_ply(capture: Capture) -> tuple[str, ...]:
    """What of a capture a PLY file of its points cannot hold."""
    cameras = f"{len(capture.frames)} cameras and their poses"
    return (cameras, *lost_parts(capture, holds=("points", "colours")))


def write_ply(capture: Capture, path: Path) -> None:
    """Write the points of a capture, with their colours if it has any, atomically.

    Raises:
        UserError: the file cannot be written.
    """
    fields = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    if capture.colours is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.zeros(len(capture.points), np.dtype(fields))
    for axis, name in enumerate("xyz"):
        vertices[name] = capture.points[:, axis]
    if capture.colours is not None:
        for channel, name in enumerate(_COLOURS[0]):
            vertices[name] = capture.colours[:, channel]
    _write(path, {"vertex": vertices})


def write_camera_ply(capture: Capture, path: Path, *, depth: float | None = None) -> None:
    """Write the cameras of a capture as frusta: five vertices and eight edges each, atomically.

    The first vertex of five is the camera's centre; the next ones are seen in the picture's corners, from the top left
    one clockwise, through the true lens model. A corner that the lens does not see is moved towards the middle. Of a
    spherical picture the frustum covers 90 degrees around the forward axis.

    Args:
        capture: whose cameras are drawn.
        path: of the file.
        depth: distance from the centre to the corners in scene units; None makes it half the distance between typical
            neighbouring cameras.

    Raises:
        UserError: the file cannot be written.
    """
    centres = np.array([frame.centre for frame in capture.frames]).reshape(-1, 3)
    length = _typical_gap(centres) * _FRUSTUM_PART if depth is None else depth
    corners = {camera: _corner_directions(camera) for camera in {frame.camera for frame in capture.frames}}
    positions = np.empty((len(centres), 5, 3))
    for index, frame in enumerate(capture.frames):
        positions[index, 0] = centres[index]
        positions[index, 1:] = rigid.apply(frame.world_from_cam, length * corners[frame.camera])
    vertices = np.zeros(5 * len(centres), np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8")]))
    for axis, name in enumerate("xyz"):
        vertices[name] = positions[..., axis].ravel()
    pairs = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])
    pairs = (5 * np.arange(len(centres))[:, None, None] + pairs).reshape(-1, 2)
    edges = np.zeros(len(pairs), np.dtype([("vertex1", "<i4"), ("vertex2", "<i4")]))
    edges["vertex1"], edges["vertex2"] = pairs.T
    _write(path, {"vertex": vertices, "edge": edges})


def _write(path: Path, elements: dict[str, np.ndarray]) -> None:
    words = {"<f8": "double", "|u1": "uchar", "<i4": "int"}
    lines = ["ply", "format binary_little_endian 1.0", "comment written by nerfcli"]
    for name, table in elements.items():
        lines.append(f"element {name} {len(table)}")
        lines += [f"property {words[table.dtype[field].str]} {field}" for field in table.dtype.names or ()]
    header = "\n".join([*lines, "end_header", ""])
    with atomic_path(path) as partial:
        partial.write_bytes(header.encode("ascii") + b"".join(table.tobytes() for table in elements.values()))


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
        raise ValueError("its vertices hold lists")
    if encoding == "ascii":
        table = _ascii_columns(data[start:], sum(element.count for element in before), vertex)
    else:
        table = _binary_columns(data, start, before=before, vertex=vertex, order=_ORDERS[encoding])
    points = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=-1)
    if not plausible(points).all():
        raise ValueError(f"vertex {int(np.argmin(plausible(points)))} has a position that is nowhere")
    kinds = dict(vertex.properties)
    channels = next((names for names in _COLOURS if set(names) <= set(fields)), None)
    if channels is None:
        return points, None
    return points, np.stack([_as_bytes(table[name], str(kinds[name])) for name in channels], axis=-1)


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Encoding, elements, and where the body begins."""
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
            raise ValueError(f"its element {element.name} holds lists and stands before the vertices")
        start += element.count * sum(np.dtype(kind).itemsize for _, kind in element.properties)
    dtype = np.dtype([(name, f"{order}{kind}") for name, kind in vertex.properties])
    if vertex.count * dtype.itemsize > len(data) - start:
        raise ValueError(f"its header announces {vertex.count} vertices, but {max(0, len(data) - start)} bytes follow")
    table = np.frombuffer(data, dtype, count=vertex.count, offset=start)
    return {name: table[name] for name, _ in vertex.properties}


def _as_bytes(channel: np.ndarray, kind: str) -> np.ndarray:
    """A colour channel as uint8."""
    most = 1.0 if kind.startswith("f") else 255.0
    if kind not in ("u1", "f4", "f8") or not ((channel >= 0) & (channel <= most)).all():
        raise ValueError(f"its colours are no numbers from 0 to {most:g}")
    return np.round(channel.astype(np.float64) * (255.0 / most)).astype(np.uint8)


def _corner_directions(camera: Camera) -> np.ndarray:
    """Unit directions (4, 3) of the picture's corners in camera axes."""
    if camera.is_spherical:
        corners = np.array([(-1.0, -1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, 1.0), (-1.0, 1.0, 1.0)])
        return corners / np.sqrt(3.0)
    middle = np.array(camera.principal_point)
    size = np.array([camera.width, camera.height])
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) * size
    directions = np.tile((0.0, 0.0, 1.0), (4, 1))
    for part in np.linspace(0.05, 1.0, 20):  # the last valid one stays
        seen, valid = camera.bearings(middle + part * (corners - middle))
        directions[valid] = seen[valid]
    return directions


def _typical_gap(centres: np.ndarray) -> float:
    """Median distance from a camera to its nearest neighbour; 1 where all stand in one place."""
    if len(centres) < 2:
        return 1.0
    gap = float(np.median(KDTree(centres).query(centres, k=2)[0][:, 1]))
    return gap if gap > 0 else 1.0
