"""Captures with true geometry for `uncertainty.py`, and which photos see which points, from the geometry alone.

Rays hit spheres and two more scenes of balls and blocks in closed form, and the triangles of the desk by embreex, which
reports only the triangle: the distance to its plane is computed here in float64.
"""

import importlib
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from nerfcli import scene as scenes
from nerfcli.cameras.frame import Frame
from nerfcli.render.visibility import largest_angle_deg, small_frame
from nerfcli.scene import Scene

sys.path.insert(0, str(Path(__file__).parent.parent / "sample_scenes"))
import desk_scene
import make_spheres
from make_spheres import Ball, Box

DESK = Path(__file__).parent.parent / "sample_scenes" / "desk"
DESK_SEED = 20260
# From the axes of OpenCV to those of OpenGL, as in transforms.json.
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# A photo sees a point if the first hit of its ray is within `SAME` of it, at an incidence below `STEEPEST_DEG`.
SAME, STEEPEST_DEG = 0.002, 80.0
# Degrees of the ring that are withheld; every how many of the other photos are controls.
SECTOR_DEG, CONTROL_EVERY = 120.0, 8
# Longer side in pixels of the views in which depth is compared.
VIEW_PX = 64
STRATA = ("U0", "U1", "W", "D")


class Truth(Protocol):
    """The true surface of a scene."""

    def first_hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distance (N,) and normal (N, 3), of either sign, of the first hits of unit rays (N, 3) from (3,).

        Infinite and NaN for rays that hit nothing.
        """
        ...


@dataclass(frozen=True)
class Solids:
    """Balls and boxes, in closed form."""

    things: tuple[Ball | Box, ...]

    def first_hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Truth`."""
        distances = np.stack([make_spheres.hit(thing, origin, rays) for thing in self.things])
        nearest, distance = distances.argmin(axis=0), distances.min(axis=0)
        normals = np.full(rays.shape, np.nan)
        for index, thing in enumerate(self.things):
            rows = (nearest == index) & np.isfinite(distance)
            local = origin + distance[rows, None] * rays[rows] - np.array(thing.centre)
            if isinstance(thing, Ball):
                normals[rows] = local / thing.radius
            else:
                reach = np.abs(local) / np.array(thing.half_size)
                normals[rows] = np.eye(3)[reach.argmax(axis=1)]
        return distance, normals


class Triangles:
    """Triangles (N, 3, 3)."""

    def __init__(self, corners: np.ndarray):
        mesh_construction = importlib.import_module("embreex.mesh_construction")
        self._corners = corners.astype(np.float32).astype(np.float64)
        edges = self._corners[:, 1:] - self._corners[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        self._normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
        self._scene: Any = importlib.import_module("embreex.rtcore_scene").EmbreeScene()
        self._mesh: Any = mesh_construction.TriangleMesh(self._scene, corners.astype(np.float32))

    def first_hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Truth`."""
        starts = np.broadcast_to(origin, rays.shape).astype(np.float32)
        found = self._scene.run(np.ascontiguousarray(starts), np.ascontiguousarray(rays, dtype=np.float32))
        there = found >= 0
        distance, normals = np.full(len(rays), np.inf), np.full(rays.shape, np.nan)
        triangle = found[there]
        normals[there] = self._normals[triangle]
        height = ((self._corners[triangle, 0] - origin) * normals[there]).sum(axis=1)
        distance[there] = height / (rays[there] * normals[there]).sum(axis=1)
        return distance, normals


def blocks(seed: int) -> Solids:
    """Return blocks and balls on a slab, which occlude one another."""
    rng = np.random.default_rng(seed)
    things: list[Ball | Box] = [Box((0.0, 0.0, -0.37), (1.1, 1.1, 0.12), (0.5, 0.55, 0.6), 8.0)]
    for _ in range(5):
        x, y = rng.uniform(-0.8, 0.8, 2)
        half = rng.uniform(0.08, 0.25, 2)
        height = rng.uniform(0.15, 0.5)
        base = rng.uniform(0.3, 0.7, 3)
        things.append(Box((x, y, -0.25 + height), (half[0], half[1], height), tuple(base), rng.uniform(8, 16)))
    for _ in range(4):
        radius = rng.uniform(0.12, 0.3)
        x, y = rng.uniform(-0.8, 0.8, 2)
        things.append(Ball((x, y, -0.25 + radius), radius, tuple(rng.uniform(0.3, 0.7, 3)), rng.uniform(8, 16)))
    return Solids(tuple(things))


def truth_of(name: str) -> Truth:
    """Return the true surface of a scene: spheres, blocks-SEED or desk."""
    if name == "desk":
        return Triangles(np.concatenate([p.mesh.vertices[p.mesh.triangles] for p in desk_scene.furnish(DESK_SEED)]))
    return Solids(make_spheres.THINGS) if name == "spheres" else blocks(int(name.partition("-")[2]))


def write_capture(name: str, folder: Path) -> None:
    """Write the photos of a scene with their true cameras, as transforms.json."""
    folder.mkdir(parents=True, exist_ok=True)
    if name == "desk":
        recorded = json.loads((DESK / "truth" / "cameras.json").read_text(encoding="utf-8"))
        f, cx, cy, k1, k2 = recorded["camera"]["params"]
        lens = {"fl_x": f, "fl_y": f, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "p1": 0.0, "p2": 0.0}
        lens |= {"camera_model": "OPENCV", "w": 800, "h": 600}
        files = {
            str((DESK / "images" / image["name"]).resolve()): np.array(image["world_from_cam"]) @ OPENGL
            for image in recorded["images"]
        }
    else:
        truth = truth_of(name)
        assert isinstance(truth, Solids)
        lens, files = {"camera_angle_x": make_spheres.CAMERA_ANGLE_X}, {}
        for index in range(make_spheres.NUM_VIEWS):
            pose = make_spheres.camera_pose(index)
            path = folder / f"view_{index:02d}.png"
            Image.fromarray(make_spheres.picture(pose, things=truth.things)).save(path)
            files[path.name] = pose
    frames = [{"file_path": path, "transform_matrix": pose.tolist()} for path, pose in files.items()]
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), encoding="utf-8")


def withheld(frames: Sequence[Frame], *, sector: int) -> tuple[list[str], list[str]]:
    """Return the names of the photos in a sector of the ring, from 90 degrees times its number, and of the controls."""
    middle = np.mean([frame.centre for frame in frames], axis=0)
    inside, others = [], []
    for frame in frames:
        x, y = (frame.centre - middle)[:2]
        azimuth = math.degrees(math.atan2(y, x))
        (inside if (azimuth - 90.0 * sector) % 360.0 < SECTOR_DEG else others).append(frame.name)
    return inside, others[::CONTROL_EVERY]


def load_replicate(capture: Path, folder: Path, *, sector: int) -> Scene:
    """Return the scene whose held-out photos are those of a sector and the controls; FOLDER/held_out.txt lists them."""
    inside, controls = withheld(scenes.load(capture).frames, sector=sector)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "held_out.txt").write_text("\n".join([*inside, *controls]), encoding="utf-8")
    return scenes.load(capture, holdout=str(folder / "held_out.txt"))


def looks(frames: Sequence[Frame]) -> list[Frame]:
    """Return the views in which depth is compared."""
    return [small_frame(frame, VIEW_PX) for frame in frames]


@dataclass(frozen=True)
class TruePixels:
    """The truth in the pixels of some views, one view after the other.

    Args:
        distance: (P,) along the ray, infinite where nothing is hit.
        photos: (P,) number of training photos that see the point.
        parallax_deg: (P,) the largest angle between two of them, degrees.
    """

    distance: np.ndarray
    photos: np.ndarray
    parallax_deg: np.ndarray

    @property
    def stratum(self) -> np.ndarray:
        """(P,) index in `STRATA`; -1 where nothing is hit."""
        return stratum_of(self.photos, self.parallax_deg, hit=np.isfinite(self.distance))


def stratum_of(photos: np.ndarray, parallax_deg: np.ndarray, *, hit: np.ndarray) -> np.ndarray:
    """Return the index in `STRATA` of each point, by the photos that see it.

    U0: none. U1: one, or less than 2 degrees between them. D: at least three, with at least 10 degrees. W: all others.
    """
    stratum = np.full(len(photos), STRATA.index("W"))
    stratum[(photos >= 3) & (parallax_deg >= 10.0)] = STRATA.index("D")
    stratum[(photos == 1) | (parallax_deg < 2.0)] = STRATA.index("U1")
    stratum[photos == 0] = STRATA.index("U0")
    stratum[~hit] = -1
    return stratum


def true_pixels(truth: Truth, views: Sequence[Frame], training: Sequence[Frame]) -> TruePixels:
    """Return the true distances in the pixels of views, and which training photos see the points there."""
    columns = []
    for view in views:
        bearings, _ = view.camera.pixel_bearings()
        rays = bearings @ view.world_from_cam[:3, :3].T
        distance, normals = truth.first_hit(view.centre, rays)
        there = np.flatnonzero(np.isfinite(distance))
        points = view.centre + distance[there, None] * rays[there]
        # The normal on the side that this view sees: a photo on the other side of a thin sheet does not see the point.
        towards = np.where((normals[there] * rays[there]).sum(axis=1) > 0, -1.0, 1.0)[:, None] * normals[there]
        seen = np.stack([sees(truth, photo, points, towards) for photo in training], axis=1)
        photos, parallax = np.zeros(len(rays), int), np.zeros(len(rays))
        photos[there] = seen.sum(axis=1)
        parallax[there] = largest_angle_deg(seen, points, np.stack([photo.centre for photo in training]))
        columns.append((distance, photos, parallax))
    return TruePixels(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def sees(truth: Truth, photo: Frame, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return which points (N, 3) with outward normals (N, 3) a photo sees: in its frame, first hit, not too steep."""
    offsets = points - photo.centre
    distance = np.linalg.norm(offsets, axis=1)
    rays = offsets / distance[:, None]
    pixels, valid = photo.camera.project(offsets @ photo.world_from_cam[:3, :3])
    size = (photo.camera.width, photo.camera.height)
    inside = valid & (pixels >= 0).all(axis=1) & (pixels <= size).all(axis=1)
    rows = np.flatnonzero(inside & (-(rays * normals).sum(axis=1) > math.cos(math.radians(STEEPEST_DEG))))
    seen = np.zeros(len(points), dtype=bool)
    seen[rows] = np.abs(truth.first_hit(photo.centre, rays[rows])[0] - distance[rows]) < SAME
    return seen
