"""Triangle meshes of the desk scene, made with NumPy alone.

Everything is a triangle and stands in world metres before Blender sees it, so that the mesh that is rendered
and the mesh that the true depth is cast against are the same, without modifiers and without quads that two
programs could split in two ways.
"""

import math
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Mesh:
    """vertices (N, 3) metres, triangles (M, 3) int, uv (M, 3, 2) in [0, 1] with v up, smooth or flat shading."""

    vertices: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    smooth: bool = False


def sheet(points: np.ndarray, *, smooth: bool = True) -> Mesh:
    """The surface through a grid of points (rows, columns, 3); u runs along columns, v along rows."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    triangles = np.concatenate((np.stack((a, b, c), 1), np.stack((a, c, d), 1)))
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    uv = np.stack((u, v), axis=-1).reshape(-1, 2)[triangles]
    return Mesh(points.reshape(-1, 3).astype(float), triangles, uv, smooth)


def panel(corner: tuple[float, ...], along: tuple[float, ...], up: tuple[float, ...]) -> Mesh:
    """A flat parallelogram from its lower left corner and its two sides."""
    origin, x, y = (np.array(v, dtype=float) for v in (corner, along, up))
    return sheet(np.array([[origin, origin + x], [origin + y, origin + x + y]]), smooth=False)


def box_sides(size: tuple[float, float, float]) -> dict[str, Mesh]:
    """The sides of a box on z = 0, centred in x and y: front (-y), back, left (-x), right, top, bottom."""
    x, y, z = size[0] / 2, size[1] / 2, size[2]
    return {
        "front": panel((-x, -y, 0), (2 * x, 0, 0), (0, 0, z)),
        "back": panel((x, y, 0), (-2 * x, 0, 0), (0, 0, z)),
        "left": panel((-x, y, 0), (0, -2 * y, 0), (0, 0, z)),
        "right": panel((x, -y, 0), (0, 2 * y, 0), (0, 0, z)),
        "top": panel((-x, -y, z), (2 * x, 0, 0), (0, 2 * y, 0)),
        "bottom": panel((-x, y, 0), (2 * x, 0, 0), (0, -2 * y, 0)),
    }


def box(size: tuple[float, float, float]) -> Mesh:
    """A box that stands on z = 0, centred in x and y; each side carries the whole picture."""
    return joined(*box_sides(size).values())


def lathe(profile: list[tuple[float, float]], *, segments: int = 64) -> Mesh:
    """The profile (radius, height) turned about the z axis; u goes around, v along the profile."""
    radius, height = np.array(profile).T
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    points = np.stack(
        (
            radius[:, None] * np.cos(angle),
            radius[:, None] * np.sin(angle),
            np.broadcast_to(height[:, None], (len(radius), len(angle))),
        ),
        axis=-1,
    )
    return sheet(points)


def rounded(profile: list[tuple[float, float]], *, steps: int = 8) -> list[tuple[float, float]]:
    """A Catmull-Rom curve through the points of a profile."""
    points = np.array([profile[0], *profile, profile[-1]])
    curve = []
    for p0, p1, p2, p3 in zip(points, points[1:], points[2:], points[3:], strict=False):
        t = np.linspace(0, 1, steps, endpoint=False)[:, None]
        curve.append(
            0.5 * (2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3)
        )
    smooth = np.concatenate([*curve, points[-1:]])
    smooth[:, 0] = np.maximum(smooth[:, 0], 0)
    return [(float(r), float(z)) for r, z in smooth]


def smooth_path(points: list[tuple[float, float, float]], *, steps: int = 10) -> np.ndarray:
    """A Catmull-Rom curve through points in space, (N, 3)."""
    known = np.array([points[0], *points, points[-1]], dtype=float)
    curve = []
    for p0, p1, p2, p3 in zip(known, known[1:], known[2:], known[3:], strict=False):
        t = np.linspace(0, 1, steps, endpoint=False)[:, None]
        curve.append(
            0.5 * (2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3)
        )
    return np.concatenate([*curve, known[-1:]])


def tube(path: np.ndarray, radius: float | np.ndarray, *, sides: int = 10) -> Mesh:
    """A round tube along a path (N, 3) with one radius or one per point; a negligible end closes it.

    The frame is carried along the path by projection, so the tube does not twist.
    """
    radii = np.broadcast_to(np.asarray(radius, dtype=float), (len(path),))
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.cross(tangent[0], (0.31, 0.87, 0.38))
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    rings = []
    for point, direction, size in zip(path, tangent, radii, strict=True):
        normal = normal - direction * (normal @ direction)
        normal /= np.linalg.norm(normal)
        across = np.cross(direction, normal)
        rings.append(point + size * (np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * across))
    rings = [np.broadcast_to(path[0], rings[0].shape), *rings, np.broadcast_to(path[-1], rings[0].shape)]
    return sheet(np.array(rings))


def rod(start: tuple[float, ...], end: tuple[float, ...], radius: float, *, sides: int = 10) -> Mesh:
    """A straight tube between two points."""
    return tube(np.linspace(start, end, 2), radius, sides=sides)


def ball(radius: float, *, segments: int = 48) -> Mesh:
    """A sphere about the origin; v runs from the south pole to the north pole."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    return lathe([(radius * math.cos(a), radius * math.sin(a)) for a in angle], segments=segments)


def joined(*meshes: Mesh) -> Mesh:
    """One mesh of several; the shading of the first."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + offset for mesh, offset in zip(meshes, offsets[:-1], strict=True)]),
        np.concatenate([mesh.uv for mesh in meshes]),
        meshes[0].smooth,
    )


def placed(
    mesh: Mesh,
    at: tuple[float, float, float],
    *,
    turn_deg: float = 0.0,
    tilt_deg: float = 0.0,
    scale: float = 1.0,
) -> Mesh:
    """The mesh scaled, tilted about x, turned about z and moved to `at`."""
    a, b = math.radians(turn_deg), math.radians(tilt_deg)
    turn = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    return replace(mesh, vertices=scale * mesh.vertices @ (turn @ tilt).T + np.array(at))
