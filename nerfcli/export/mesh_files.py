"""Meshes as GLB and OBJ files, each with a description of its values; as PLY: `nerfcli.ply`.

The description consists of plain values, the same for all formats: a comment `nerfcli` with JSON in PLY and OBJ,
`asset.extras` in GLB. Further comments name the unit and the coordinate frame.
"""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.photos.colours import linear_light
from nerfcli.ply import comments_of

# Component types and chunk types of glTF 2.0.
_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
# Float positions are stored relative to their mean if it is at least this many times their extent from the origin.
_FAR = 1000.0


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
