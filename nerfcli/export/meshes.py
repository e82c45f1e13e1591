"""Meshes: marching cubes over signed distances, simplification; GLB and OBJ files."""

import json
import struct
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import block_reduce, marching_cubes

from nerfcli.atomic import atomic_path
from nerfcli.export.fusion import SIDE, FusedVolume
from nerfcli.export.mesh_facts import GLB_JSON
from nerfcli.photos.colours import linear_light
from nerfcli.ply import comments_of, read_ply_mesh, write_ply

# Voxels along a side of a brick, the unit of marching.
_BRICK = 8 * SIDE
# A voxel counts as seen from this weight on; cubes with an unseen corner have no surface.
SEEN = 0.5
# Connected pieces with a smaller fraction of the faces are noise.
_SMALLEST_PIECE = 0.002


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Args:
        vertices: (V, 3) float64, the scene's frame and unit.
        faces: (F, 3) int64 vertex indices, anticlockwise as seen from outside.
        normals: (V, 3) unit, outwards; 0 if all faces of a vertex have zero area.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray


def surface_of(fused: FusedVolume, *, on_progress: Callable[[float], None] = lambda fraction: None) -> Mesh:
    """Return the mesh on which the signed distance is 0, between seen voxels."""
    keys, vertices, faces, count = [], [], [], 0
    bricks = np.argwhere(block_reduce(fused.index >= 0, _BRICK // SIDE, np.any)) * _BRICK  # those with a block
    for done, first in enumerate(bricks):
        found = _march(fused, first)
        on_progress((done + 1) / len(bricks))
        if found is None:
            continue
        places, triangles = found
        # A vertex is on a grid edge: two of its coordinates are exact integers. Edges are unique keys of vertices.
        whole = places == np.round(places)
        keys.append(np.where(whole, 2 * np.round(places), 2 * np.floor(places) + 1).astype(np.int64) + 2 * first)
        vertices.append(places + first)
        faces.append(triangles.astype(np.int64) + count)
        count += len(places)
    if not faces:
        return mesh_of(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    _, chosen, inverse = np.unique(np.concatenate(keys), axis=0, return_index=True, return_inverse=True)
    places = np.concatenate(vertices)[chosen]
    triangles = inverse.reshape(-1)[np.concatenate(faces)]
    return mesh_of(fused.grid.centres(places), triangles)


def mesh_of(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return a mesh with normals, without degenerate triangles (two equal corners) and unused vertices."""
    proper = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    used, packed = np.unique(faces[proper], return_inverse=True)
    vertices, faces = vertices[used], packed.reshape(-1, 3)
    corners = vertices[faces]
    # The length is twice the area, so large triangles count more.
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return Mesh(vertices, faces, normals)


def without_small_pieces(mesh: Mesh) -> Mesh:
    """Return the mesh without connected pieces of too small a fraction of all faces."""
    if not len(mesh.faces):
        return mesh
    first, second = mesh.faces[:, 0], mesh.faces[:, 1:]
    links = coo_matrix(
        (np.ones(2 * len(first), bool), (np.repeat(first, 2), second.reshape(-1))), shape=(len(mesh.vertices),) * 2
    )
    _, piece = connected_components(links, directed=False)
    of_faces = piece[first]
    large = np.bincount(of_faces, minlength=piece.max() + 1) >= _SMALLEST_PIECE * len(first)
    return mesh_of(mesh.vertices, mesh.faces[large[of_faces]])


def _march(fused: FusedVolume, first: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the vertices of a brick, in voxels from `first`, and its triangles; None if it has no surface."""
    shape = tuple(int(min(_BRICK + 1, total - at)) for at, total in zip(first, fused.grid.shape, strict=True))
    if min(shape) < 2:
        return None
    distance, weight = fused.dense((int(first[0]), int(first[1]), int(first[2])), (shape[0], shape[1], shape[2]))
    seen = weight >= SEEN
    cubes = seen[:-1, :-1, :-1].copy()
    negative = np.zeros(cubes.shape, np.int8)
    for corner in np.ndindex(2, 2, 2):
        part = tuple(slice(at, at + length) for at, length in zip(corner, cubes.shape, strict=True))
        cubes &= seen[part]
        negative += distance[part] < 0
    if not (cubes & (negative > 0) & (negative < 8)).any():
        return None
    mask = np.zeros(shape, dtype=bool)
    mask[1:, 1:, 1:] = cubes  # the library reads the mask at a cube's last corner
    vertices, faces, _, _ = marching_cubes(distance, 0.0, mask=mask, allow_degenerate=False)
    return vertices.astype(np.float64), faces


def simplified(mesh: Mesh, faces: int, *, threads: int) -> Mesh:
    """Simplify a mesh to about `faces` faces; one with no more than that is returned unchanged.

    Source: Garland and Heckbert 1997, Surface simplification using quadric error metrics; COLMAP's implementation.
    """
    if len(mesh.faces) <= faces:
        return mesh
    # COLMAP's files have float32 positions, which would lose millimetres in a scene far from its origin.
    middle = mesh.vertices.mean(axis=0)
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "given.ply", Path(folder) / "made.ply"
        columns: dict[str, np.ndarray] = dict(zip("xyz", (mesh.vertices - middle).astype("<f4").T, strict=True))
        write_ply(given, columns, faces=mesh.faces)
        options = pycolmap.MeshSimplificationOptions()
        options.target_face_ratio = faces / len(mesh.faces)
        options.num_threads = threads
        pycolmap.simplify_mesh(given, made, options)
        vertices, triangles = read_ply_mesh(made)
    return mesh_of(vertices.astype(np.float64) + middle, triangles)


# Component types of glTF 2.0, and the type of its binary chunk.
_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_BINARY = 0x004E4942
# Float positions are stored relative to their mean if it is at least this many times their extent from the origin.
_FAR = 1000.0


def write_obj(path: Path, mesh: Mesh, *, colours: np.ndarray, description: Mapping[str, Any]) -> None:
    """Write a mesh as OBJ, atomically, with an sRGB colour after each position, which most programs can read."""
    rows = np.concatenate([mesh.vertices, colours / 255.0], axis=1)
    with atomic_path(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.writelines(f"# {line}\n" for line in comments_of(description))
        file.writelines("v %.9g %.9g %.9g %.4f %.4f %.4f\n" % tuple(row) for row in rows.tolist())  # noqa: UP031 - faster
        file.writelines("f %d %d %d\n" % tuple(row) for row in (mesh.faces + 1).tolist())  # noqa: UP031 - faster


def write_glb(
    path: Path, mesh: Mesh, *, colours: np.ndarray, y_up_from_frame: np.ndarray, description: Mapping[str, Any]
) -> None:
    """Write a mesh as binary glTF 2.0, atomically.

    Positions keep their frame; the root node rotates them to glTF's +Y up. Colours are converted to linear light, as
    glTF requires, and the material is unlit because the colours already contain the scene's lighting.
    """
    vertices = mesh.vertices
    middle = vertices.mean(axis=0) if len(vertices) else np.zeros(3)
    size = np.abs(vertices - middle).max(initial=0.0)
    if np.abs(middle).max() < _FAR * size:
        middle = np.zeros(3)
    positions = (vertices - middle).astype("<f4")
    light = np.full((len(vertices), 4), 65535, "<u2")
    light[:, :3] = np.rint(65535 * linear_light(colours / 255.0))
    parts = [each.tobytes() for each in (positions, mesh.normals.astype("<f4"), light, mesh.faces.astype("<u4"))]
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
            {"bufferView": 3, "componentType": _UINT, "type": "SCALAR", "count": 3 * len(mesh.faces)},
        ],
    }
    text = json.dumps(content, ensure_ascii=True, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(parts)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), GLB_JSON) + text + struct.pack("<II", len(binary), _BINARY) + binary
    with atomic_path(path) as partial:
        partial.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
