"""Facts that files of meshes, points and splats state: counts, and what nerfcli wrote into them. Needs no torch."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerfcli.errors import UserError
from nerfcli.ply import description_in, read_ply_header

# Type of the first chunk of a binary glTF 2.0.
GLB_JSON = 0x4E4F534A
# Note for files without a description.
NOT_STATED = "unit and frame"
# Meshes that are written, the default first, and read.
SUFFIXES = (".ply", ".glb", ".obj")


def is_splat_file(path: Path) -> bool:
    """Return whether a file is a .spz, or a .ply whose points have colours by direction."""
    suffix = path.suffix.lower()
    if not path.is_file() or suffix not in (".spz", ".ply"):
        return False
    return suffix == ".spz" or "f_dc_0" in read_ply_header(path).vertex_properties


def model_facts(path: Path) -> dict[str, Any]:
    """Return the facts about a file: kind, format, counts, and what nerfcli wrote into it: unit, frame, run, ..."""
    if not path.is_file():
        raise UserError(f"{path} does not exist", "give a file that exists")
    match path.suffix.lower():
        case ".ply":
            header = read_ply_header(path)
            counts = _counts("PLY", header.count("vertex"), header.count("face") or None)
            return {**_described(header.comments), **counts, "properties": " ".join(header.vertex_properties)}
        case ".glb":
            return _glb_facts(path)
        case _:
            return _obj_facts(path)


def _glb_facts(path: Path) -> dict[str, Any]:
    content = read_glb_json(path)
    described = content.get("asset", {}).get("extras") or {"not_stated": NOT_STATED}
    try:
        primitive = content["meshes"][0]["primitives"][0]
        positions = content["accessors"][primitive["attributes"]["POSITION"]]
        faces = content["accessors"][primitive["indices"]]["count"] // 3
        return {
            **described,
            **_counts("GLB", positions["count"], faces),
            "low": positions["min"],
            "high": positions["max"],
        }
    except (KeyError, IndexError, TypeError):  # written by another program: it may contain anything
        return {**described, "kind": "mesh", "format": "GLB", "note": "its first mesh has no list of triangles"}


def _obj_facts(path: Path) -> dict[str, Any]:
    counts, comments = {"v": 0, "f": 0}, []
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            word = line.partition(" ")[0]
            if word in counts:
                counts[word] += 1
            elif word == "#":
                comments.append(line[1:].strip())
    if not counts["v"]:
        raise UserError(f"{path} has no vertices", "copy or export it again")
    return {**_described(comments), **_counts("OBJ", counts["v"], counts["f"])}


def _counts(form: str, vertices: int, faces: int | None) -> dict[str, Any]:
    return {"kind": "mesh" if faces else "points", "format": form, "vertices": vertices, "faces": faces}


def _described(comments: Sequence[str]) -> dict[str, Any]:
    return description_in(comments) or {"not_stated": NOT_STATED}


def read_glb_json(path: Path) -> dict[str, Any]:
    """Read the JSON of a binary glTF."""
    data = path.read_bytes()
    try:
        magic, version, length = struct.unpack_from("<4sII", data)
        size, kind = struct.unpack_from("<II", data, 12)
        if magic != b"glTF" or version != 2 or length > len(data) or kind != GLB_JSON:
            raise ValueError("its header is not that of glTF 2.0")
        content = json.loads(data[20 : 20 + size])
    except (struct.error, ValueError) as error:
        raise UserError(f"{path} is not a GLB file, or is truncated: {error}", "export it again") from error
    return content
