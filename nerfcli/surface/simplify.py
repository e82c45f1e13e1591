"""Fewer triangles for about the same surface: quadric error metrics, by COLMAP."""

import tempfile
from pathlib import Path

import numpy as np
import pycolmap

from nerfcli.media.mesh_files import read_ply_mesh, write_ply
from nerfcli.surface.marching import Mesh, mesh_of


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
