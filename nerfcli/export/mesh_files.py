"""Meshes and points as PLY, GLB and OBJ files, each with a description of its values.

The description consists of plain values, the same for all formats: a comment `nerfcli` with JSON in PLY and OBJ,
`asset.extras` in GLB. Further comments name the unit and the coordinate frame.
"""

import json
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.photos.colours import linear_light

KEY = "nerfcli"
_WORDS = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int", "u2": "ushort"}
_CODES = {
    word: code
    for code, words in {
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
        "u1": ("uchar", "uint8"),
        "i1": ("char", "int8"),
        "u2": ("ushort", "uint16"),
        "i2": ("short", "int16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
    }.items()
    for word in words
}
# Component types and chunk types of glTF 2.0.
_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
# Float positions are stored relative to their mean if it is at least this many times their extent from the origin.
_FAR = 1000.0


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


def write_ply(
    path: Path,
    columns: Mapping[str, np.ndarray],
    *,
    faces: np.ndarray | None = None,
    description: Mapping[str, Any] | None = None,
) -> None:
    """Write vertices, and triangles if there are any, as a binary PLY, atomically.

    Args:
        columns: vertex properties by name, (N,) float32, float64, int32, uint16 or uint8.
        faces: (F, 3).

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
    lines += [f"property {_WORDS[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    head = "\n".join([*lines, "end_header", ""]).encode("ascii")
    return b"".join([head, table.view(np.uint8).data, b"" if faces is None else _triangles(faces).tobytes()])


def read_ply_header(path: Path) -> tuple[dict[str, int], dict[str, str], list[str], int]:
    """Read the header of a PLY file.

    Returns:
        The elements and their counts; the properties of a vertex and their NumPy types; the comments; the offset of the
        body, 0 if it is not binary little-endian.

    Raises:
        UserError: it is not a PLY file, or its vertices hold lists, unknown types or a property twice.
    """
    with path.open("rb") as file:
        head = file.read(2**20)
    end = head.find(b"end_header")
    stop = head.find(b"\n", end)
    if head[:3] != b"ply" or end < 0 or stop < 0:
        raise UserError(f"{path} is no PLY file: its header has no beginning or no end", "copy or export it once more")
    elements: dict[str, int] = {}
    properties: dict[str, str] = {}
    comments, binary = [], False
    for line in head[:end].decode("utf-8", errors="replace").splitlines():
        match line.split():
            case ["comment", *_]:
                comments.append(line.partition(" ")[2])
            case ["format", form, _]:
                binary = form == "binary_little_endian"
            case ["element", name, count] if count.isdecimal() and len(count) < 20:
                elements[name] = int(count)
            case ["property", kind, name] if list(elements) == ["vertex"] and kind in _CODES and name not in properties:
                properties[name] = f"<{_CODES[kind]}"
            case ["property", *_] if list(elements) == ["vertex"]:
                raise UserError(f"{path} has vertices that cannot be read: {line.strip()[:80]}", "export it once more")
    return elements, properties, comments, stop + 1 if binary else 0


def read_ply_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the vertices (N, 3) and triangles (F, 3), int64, of a binary PLY whose faces hold only three indices.

    Raises:
        UserError: the file is of another kind, or truncated.
    """
    elements, properties, _, start = read_ply_header(path)
    dtype = np.dtype(list(properties.items()))
    faces = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])
    count, triangles = elements.get("vertex", 0), elements.get("face", 0)
    data = path.read_bytes()
    if not start or len(data) < start + count * dtype.itemsize + triangles * faces.itemsize:
        raise UserError(f"{path} is no binary PLY file of triangles, or cut short", "export it once more")
    table = np.frombuffer(data, dtype, count, start)
    listed = np.frombuffer(data, faces, triangles, start + count * dtype.itemsize)
    return np.stack([table[axis] for axis in "xyz"], axis=-1), listed["vertices"].astype(np.int64)


def write_obj(
    path: Path, vertices: np.ndarray, faces: np.ndarray, *, colours: np.ndarray, description: Mapping[str, Any]
) -> None:
    """Write a mesh as OBJ, atomically, with a colour after each position, which most programs can read.

    Args:
        vertices: (N, 3).
        faces: (F, 3).
        colours: (N, 3) uint8 sRGB.

    Raises:
        UserError: the file cannot be written.
    """
    rows = np.concatenate([vertices, colours / 255.0], axis=1)
    with atomic_path(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.writelines(f"# {line}\n" for line in comments_of(description))
        file.writelines("v %.9g %.9g %.9g %.4f %.4f %.4f\n" % tuple(row) for row in rows.tolist())  # noqa: UP031 - faster
        file.writelines("f %d %d %d\n" % tuple(row) for row in (faces + 1).tolist())  # noqa: UP031 - faster


def write_glb(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    normals: np.ndarray,
    colours: np.ndarray,
    y_up_from_frame: np.ndarray,
    description: Mapping[str, Any],
) -> None:
    """Write a mesh as binary glTF 2.0, atomically.

    Positions keep their frame; the root node rotates them to glTF's +Y up. Colours are converted to linear light, as
    glTF requires, and the material is unlit because the colours already contain the scene's lighting.

    Args:
        vertices: (N, 3).
        faces: (F, 3).
        normals: (N, 3) unit.
        colours: (N, 3) uint8 sRGB.
        y_up_from_frame: (3, 3) rotation.

    Raises:
        UserError: the file cannot be written.
    """
    middle = vertices.mean(axis=0) if len(vertices) else np.zeros(3)
    size = np.abs(vertices - middle).max(initial=0.0)
    if np.abs(middle).max() < _FAR * size:
        middle = np.zeros(3)
    positions = (vertices - middle).astype("<f4")
    light = np.full((len(vertices), 4), 65535, "<u2")
    light[:, :3] = np.rint(65535 * linear_light(colours / 255.0))
    parts = [positions.tobytes(), normals.astype("<f4").tobytes(), light.tobytes(), faces.astype("<u4").tobytes()]
    starts = np.cumsum([0, *(len(part) for part in parts)])
    turn = np.eye(4)
    turn[:3, :3] = y_up_from_frame
    content = {
        "asset": {"version": "2.0", "generator": "nerfcli", "extras": dict(description)},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "turn to +Y up", "matrix": turn.T.reshape(-1).tolist(), "children": [1]},
            {"name": "mesh, in the frame of the scene", "mesh": 0, "translation": middle.tolist()},
        ],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}]}
        ],
        "materials": [{"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}],
        "buffers": [{"byteLength": int(starts[-1])}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": len(part), "target": 34963 if index == 3 else 34962}
            for index, (start, part) in enumerate(zip(starts[:-1], parts, strict=True))
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "type": "VEC3",
                "count": len(vertices),
                "min": positions.min(axis=0, initial=np.inf).tolist() if len(vertices) else [0, 0, 0],
                "max": positions.max(axis=0, initial=-np.inf).tolist() if len(vertices) else [0, 0, 0],
            },
            {"bufferView": 1, "componentType": _FLOAT, "type": "VEC3", "count": len(vertices)},
            {"bufferView": 2, "componentType": _USHORT, "normalized": True, "type": "VEC4", "count": len(vertices)},
            {"bufferView": 3, "componentType": _UINT, "type": "SCALAR", "count": 3 * len(faces)},
        ],
    }
    text = json.dumps(content, ensure_ascii=True, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(parts)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(binary), _BINARY) + binary
    with atomic_path(path) as partial:
        partial.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def read_glb_json(path: Path) -> dict[str, Any]:
    """Read the JSON of a binary glTF.

    Raises:
        UserError: it is not a binary glTF, or truncated.
    """
    data = path.read_bytes()
    try:
        magic, version, length = struct.unpack_from("<4sII", data)
        size, kind = struct.unpack_from("<II", data, 12)
        if magic != b"glTF" or version != 2 or length > len(data) or kind != _JSON:
            raise ValueError("its header is not that of glTF 2.0")
        content = json.loads(data[20 : 20 + size])
    except (struct.error, ValueError) as error:
        raise UserError(f"{path} is no GLB file, or cut short: {error}", "export it once more") from error
    return content


def _triangles(faces: np.ndarray) -> np.ndarray:
    table = np.zeros(len(faces), [("count", "u1"), ("vertices", "<i4", 3)])
    table["count"], table["vertices"] = 3, faces
    return table
