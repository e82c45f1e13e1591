"""Describe files of meshes and points as plain values."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.errors import UserError
from nerfcli.media.mesh_files import KEY, read_glb_json, read_ply_header

# Note for files without a description.
NOT_STATED = "nothing in the file says its unit or its frame"
SUFFIXES = (".ply", ".glb", ".obj")


def model_facts(path: Path) -> dict[str, Any]:
    """Return the facts about a file by name.

    Keys: kind, format, counts, low and high corner if known, and the description: unit, frame, run, ...

    Raises:
        UserError: the file is missing or damaged.
    """
    if not path.is_file():
        raise UserError(f"there is no {path}", "give a file that exists")
    match path.suffix.lower():
        case ".ply":
            return _ply_facts(path)
        case ".glb":
            return _glb_facts(path)
        case _:
            return _obj_facts(path)


def _ply_facts(path: Path) -> dict[str, Any]:
    elements, properties, comments, start = read_ply_header(path)
    count = elements.get("vertex", 0)
    facts: dict[str, Any] = {
        "kind": "mesh" if elements.get("face") else "points",
        "format": "PLY",
        "vertices": count,
        "faces": elements.get("face"),
        "properties": " ".join(properties),
    }
    dtype = np.dtype(list(properties.items()))
    if start and count and next(iter(elements)) == "vertex" and {"x", "y", "z"} <= set(properties):
        if path.stat().st_size < start + count * dtype.itemsize:
            raise UserError(f"{path} is cut short: its header says {count} vertices", "copy or export it once more")
        with path.open("rb") as file:
            file.seek(start)
            table = np.frombuffer(file.read(count * dtype.itemsize), dtype)
        facts |= _corners(np.stack([table[axis] for axis in "xyz"], axis=-1))
    return _described(comments) | facts


def _glb_facts(path: Path) -> dict[str, Any]:
    content = read_glb_json(path)
    facts: dict[str, Any] = {"kind": "mesh", "format": "GLB"}
    try:
        primitive = content["meshes"][0]["primitives"][0]
        positions = content["accessors"][primitive["attributes"]["POSITION"]]
        facts |= {"vertices": positions["count"], "faces": content["accessors"][primitive["indices"]]["count"] // 3}
        facts |= {"low": positions["min"], "high": positions["max"]}
        root = content["nodes"][content["scenes"][0]["nodes"][0]]
        facts["root_node"] = f"{root.get('name', 'unnamed')}, matrix {root.get('matrix')}"
    except (KeyError, IndexError, TypeError):  # written by another program: it may contain anything
        facts["note"] = "its first mesh has no list of triangles"
    extras = content.get("asset", {}).get("extras") or {}
    return (extras if extras else {"note": NOT_STATED}) | facts


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
        raise UserError(f"{path} has no vertices", "copy or export it once more")
    facts = {"kind": "mesh", "format": "OBJ", "vertices": counts["v"], "faces": counts["f"]}
    return _described(comments) | facts


def _corners(points: np.ndarray) -> dict[str, Any]:
    return {"low": points.min(axis=0).tolist(), "high": points.max(axis=0).tolist()}


def _described(comments: list[str]) -> dict[str, Any]:
    for comment in comments:
        if comment.startswith(f"{KEY} {{"):
            try:
                return json.loads(comment.partition(" ")[2])
            except ValueError:
                break
    return {"note": NOT_STATED}
