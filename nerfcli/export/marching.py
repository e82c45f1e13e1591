"""Turn signed distances into triangles by marching cubes, where all corners were seen; drop small pieces, simplify."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from nerfcli.export.fusion import SIDE, FusedVolume
from nerfcli.ply import read_ply_mesh, write_ply

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
        colours: (V, 3) uint8 sRGB, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray | None = None


def surface_of(fused: FusedVolume, *, on_progress: Callable[[float], None] = lambda fraction: None) -> Mesh:
    """Return the mesh on which the signed distance is 0, between seen voxels."""
    keys, vertices, faces, count = [], [], [], 0
    bricks = np.argwhere(_any_block(fused.index)) * _BRICK
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


def mesh_of(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None = None) -> Mesh:
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
    return Mesh(vertices, faces, normals, None if colours is None else colours[used])


def without_small_pieces(mesh: Mesh, fraction: float = _SMALLEST_PIECE) -> Mesh:
    """Return the mesh without connected pieces of fewer than this fraction of all faces."""
    if not len(mesh.faces):
        return mesh
    first, second = mesh.faces[:, 0], mesh.faces[:, 1:]
    links = coo_matrix(
        (np.ones(2 * len(first), bool), (np.repeat(first, 2), second.reshape(-1))), shape=(len(mesh.vertices),) * 2
    )
    _, piece = connected_components(links, directed=False)
    of_faces = piece[first]
    large = np.bincount(of_faces, minlength=piece.max() + 1) >= fraction * len(first)
    return mesh_of(mesh.vertices, mesh.faces[large[of_faces]], mesh.colours)


def _any_block(index: np.ndarray) -> np.ndarray:
    """Mark the bricks of 8^3 blocks that contain a block."""
    size = _BRICK // SIDE
    padded = np.pad(index >= 0, [(0, -length % size) for length in index.shape])
    x, y, z = (length // size for length in padded.shape)
    return np.asarray(padded.reshape(x, size, y, size, z, size).any(axis=(1, 3, 5)))


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
