"""Points at which two descriptions of a capture are compared: pairs of a view and a point that it sees."""

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.frame import Capture
from nerfcli.convert.axes import poses_of

# Most pairs of a view and a point that are tried; if there are more, each view gets a random subset of the points.
MOST_PAIRS = 500_000

# Synthetic points per view that are tried, at distances from half to twice the capture's own.
SYNTHETIC_PER_VIEW = 24


@dataclass(frozen=True)
class Probes:
    """Points used for verification.

    Args:
        frame_index: (M,) index of the view.
        point_index: (M,) index of the capture's point; -1 for a synthetic one.
        points: (M, 3) in the world.
        pixels: (M, 2) position of the point in the view.
        distances: (M,) distance of the point from the camera's centre.
    """

    frame_index: np.ndarray
    point_index: np.ndarray
    points: np.ndarray
    pixels: np.ndarray
    distances: np.ndarray


def probes_of(capture: Capture) -> Probes:
    """Return the capture's points that are visible inside the pictures of its cameras, and synthetic points.

    All pairs of a view and a point are tried, or `MOST_PAIRS` random ones, equally many for each view. The choice is
    the same in every call.
    """
    rng = np.random.default_rng(0)
    num_frames, num_points = len(capture.frames), len(capture.points)
    per_frame = min(num_points, max(1, MOST_PAIRS // num_frames))
    if per_frame == num_points:
        point_index = np.tile(np.arange(num_points), num_frames)
    else:
        point_index = rng.integers(0, num_points, num_frames * per_frame)
    frame_index = np.repeat(np.arange(num_frames), per_frame)
    synthetic_frames, synthetic_points = _synthetic(capture, rng)
    frame_index = np.concatenate([frame_index, synthetic_frames])
    point_index = np.concatenate([point_index, np.full(len(synthetic_frames), -1)])
    points = np.concatenate([capture.points[point_index[: num_frames * per_frame]], synthetic_points])
    pixels, kept, distances = projected(capture, frame_index, points)
    sizes = np.array([frame.camera.size for frame in capture.frames])
    kept &= np.all((pixels >= 0) & (pixels <= sizes[frame_index]), axis=1)
    return Probes(frame_index[kept], point_index[kept], points[kept], pixels[kept], distances[kept])


def rows_of_each(items: Sequence[Hashable], index: np.ndarray) -> Iterator[tuple[Any, np.ndarray]]:
    """Yield each distinct item, in the order of first appearance, and the rows of `index` (M,) that refer to it."""
    places: dict[Hashable, int] = {}
    labels = np.array([places.setdefault(item, len(places)) for item in items], dtype=np.int64)[index]
    order = np.argsort(labels, kind="stable")
    yield from zip(places, np.split(order, np.searchsorted(labels[order], np.arange(1, len(places)))), strict=True)


def scene_distance(capture: Capture) -> float:
    """Estimate the distance of the scene: from points, depth bounds, or the spread of the cameras."""
    centres = poses_of(capture)[:, :3, 3]
    if len(capture.points):
        distance = np.linalg.norm(np.median(capture.points, axis=0) - centres, axis=1).mean()
    elif capture.depth_bounds is not None:
        distance = np.median(capture.depth_bounds)
    else:
        distance = 2 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()
    return float(distance) if np.isfinite(distance) and distance > 0 else 1.0


def _synthetic(capture: Capture, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return frame indices (M,) and world points (M, 3) in directions that extend beyond the picture of each view.

    The directions are those of an equidistant lens with the camera's focal length, theta = radius / focal: wider than a
    perspective picture, and all around for a panorama. This avoids inverting lenses, which is slow if every photo has
    its own.
    """
    cameras = [frame.camera for frame in capture.frames]
    size = np.array([camera.size for camera in cameras], dtype=np.float64)
    centre = np.array([camera.principal_point for camera in cameras])
    focal_px = np.array([camera.focal_px for camera in cameras])
    fraction = rng.random((len(cameras), SYNTHETIC_PER_VIEW, 2))
    across = (fraction * size[:, None] - centre[:, None]) / focal_px[:, None, None]
    theta = np.linalg.norm(across, axis=2, keepdims=True)
    directions = np.concatenate([across * np.sinc(theta / np.pi), np.cos(theta)], axis=2)
    distances = scene_distance(capture) * 2.0 ** rng.uniform(-1, 1, theta.shape)
    points = rigid.apply(poses_of(capture), directions * distances)
    return np.repeat(np.arange(len(cameras)), SYNTHETIC_PER_VIEW), points.reshape(-1, 3)


def projected(
    capture: Capture, frame_index: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points (M, 3) into views (M,): pixels (M, 2), their validity (M,) bool, distances (M,)."""
    cam_from_world = rigid.inverse(poses_of(capture))[frame_index]
    in_camera = np.einsum("mij,mj->mi", cam_from_world[:, :3, :3], points) + cam_from_world[:, :3, 3]
    pixels, valid = np.zeros((len(in_camera), 2)), np.zeros(len(in_camera), dtype=bool)
    for camera, rows in rows_of_each([frame.camera for frame in capture.frames], frame_index):
        pixels[rows], valid[rows] = camera.project(in_camera[rows])
    return pixels, valid, np.linalg.norm(in_camera, axis=1)
