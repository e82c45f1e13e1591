"""Visibility of points: which photos see them, according to the field's depths, and the angle between the rays."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn.functional import normalize

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import apply
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import RenderedPicture, render_picture

# Neighbours whose depths differ by more than this fraction are not on the same surface.
_STEP = 0.1


def normals_of_points(points: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the unit normals (H, W, 3) of the points of a picture, towards the camera, in its axes.

    Cross product of central differences along rows and columns; one-sided where a neighbour is missing or on another
    surface. NaN where both neighbours are, and where there is no depth.

    Args:
        points: (H, W, 3) in the axes of the camera.
        depth: (H, W) depth of the points, along the optical axis or along the ray; NaN where unknown.
    """
    across, down = _slope(points.swapaxes(0, 1), depth.T).swapaxes(0, 1), _slope(points, depth)
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.divide(normals, length, out=np.full_like(normals, np.nan), where=length > 0)
    # Points are measured from the camera: a normal towards it is against the ray.
    away = (normals * points).sum(-1) > 0
    return np.where(away[..., None], -normals, normals).astype(np.float32)


def _slope(points: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the change of the points per row of pixels, NaN where neither neighbour is on the same surface."""
    missing, steps = np.full_like(points[:1], np.nan), np.diff(points, axis=0)
    steps[np.abs(np.diff(depth, axis=0)) > _STEP * np.minimum(depth[:-1], depth[1:])] = np.nan
    after, before = np.concatenate([steps, missing]), np.concatenate([missing, steps])
    both = (after + before) / 2
    return np.where(np.isnan(both), np.where(np.isnan(after), before, after), both)


# Longer side of the depth maps of the photos, pixels.
MAX_SIZE = 160
# A photo sees a point if the photo's depth there differs from the point's distance by at most this fraction of it...
SAME = 0.01
# ...and the angle of incidence is at most this: beyond it, one pixel covers too much of the surface.
STEEPEST_DEG = 80.0
# Number of points processed at a time, so that their data stay in the processor's cache.
_BLOCK = 2**12
# Number of angles between two rays that are compared at a time: each point has as many as pairs of cameras.
_ANGLES = 2**25


@dataclass(frozen=True)
class DepthMap:
    """Distances (H, W) from a camera to the surface along its rays, float32; NaN where there is none."""

    frame: Frame
    distances: np.ndarray

    def points(self) -> np.ndarray:
        """Return the points (N, 3) of the surface in the scene's frame, row by row, without pixels that see none."""
        rays, _ = self.frame.camera.pixel_bearings()
        there = np.isfinite(self.distances.ravel())
        return apply(self.frame.world_from_cam, rays[there] * self.distances.ravel()[there, None])


def depth_maps(
    model: Model,
    frames: Sequence[Frame],
    *,
    max_size: int = MAX_SIZE,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> list[DepthMap]:
    """Render a map of at most `max_size` pixels of the median distance for each photo, through its lens, not steep."""
    maps = []
    for frame in frames:
        small = small_frame(frame, max_size)
        seen = render_picture(model, small, background=model.background, depth=DepthRequest("median", "ray"))
        assert seen.depth is not None
        maps.append(without_steep(DepthMap(small, seen.depth)))
        on_progress(len(maps) / len(frames))
    return maps


def without_steep(view: DepthMap) -> DepthMap:
    """Return the map without the surfaces at an incidence above `STEEPEST_DEG`."""
    rays, _ = view.frame.camera.pixel_bearings()
    rays = rays.reshape(*view.distances.shape, 3)
    cosines = -(normals_of_points(rays * view.distances[..., None], view.distances) * rays).sum(-1)
    # A NaN normal, without a surface around the pixel, is not steep: edges of objects are kept.
    steep = cosines < np.cos(np.radians(STEEPEST_DEG))
    return DepthMap(view.frame, np.where(steep, np.float32(np.nan), view.distances))


def sees(view: DepthMap, points: np.ndarray) -> np.ndarray:
    """Return which points (N, 3) of the scene, finite, a camera sees: (N,) bool.

    A point is seen if it is inside the picture and one of the four nearest pixels has its distance.
    """
    camera, pose = view.frame.camera, view.frame.world_from_cam
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    pixels, valid = camera.project(local)
    rows = np.flatnonzero(valid & (pixels >= 0).all(1) & (pixels <= (camera.width, camera.height)).all(1))
    distance = np.linalg.norm(local[rows], axis=1)
    # The centre of the first pixel is at 0.5, and at 1.5 with a border.
    bordered, stride = np.pad(view.distances, 1, mode="edge").ravel(), camera.width + 2
    left, top = np.floor(pixels[rows] + 0.5).astype(int).T
    corner, same = top * stride + left, np.zeros(len(rows), dtype=bool)
    for offset in (0, 1, stride, stride + 1):
        same |= np.abs(bordered[corner + offset] - distance) <= SAME * distance  # False at NaN
    seen = np.zeros(len(points), dtype=bool)
    seen[rows] = same
    return seen


def coverage_and_parallax(views: Sequence[DepthMap], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how many cameras see each point (N, 3) of the scene, and the largest angle between two of their rays.

    Returns:
        coverage: (N,) float32, a whole number; NaN where the point is NaN.
        parallax: (N,) float32 degrees, 0 where fewer than two cameras see it; NaN where the point is NaN.
    """
    coverage, parallax = np.full(len(points), np.nan, np.float32), np.full(len(points), np.nan, np.float32)
    centres = np.stack([view.frame.centre for view in views])
    defined = np.flatnonzero(np.isfinite(points).all(axis=1))
    for first in range(0, len(defined), _BLOCK):
        rows = defined[first : first + _BLOCK]
        seen = np.stack([sees(view, points[rows]) for view in views], axis=1)  # (rows, views)
        coverage[rows], parallax[rows] = seen.sum(axis=1), largest_angle_deg(seen, points[rows], centres)
    return coverage, parallax


def largest_angle_deg(seen: np.ndarray, points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the largest angle in degrees between the rays of two cameras that see a point.

    Args:
        seen, points, centres: (N, cameras) bool, (N, 3), and (cameras, 3).

    Returns:
        (N,) float32; 0 where fewer than two see it. Accurate to 0.03 degrees at small angles.
    """
    largest = np.zeros(len(points), np.float32)
    several = np.flatnonzero(seen.sum(axis=1) > 1)
    for first in range(0, len(several), _BLOCK):
        rows = several[first : first + _BLOCK]
        used = np.flatnonzero(seen[rows].any(axis=0))
        here = seen[np.ix_(rows, used)]
        # A camera that does not see the point is replaced by one that does, which adds no angle.
        chosen = np.where(here, np.arange(len(used)), here.argmax(axis=1)[:, None])
        away = (centres[used] - points[rows, None]).astype(np.float32)  # (rows, used, 3)
        rays = normalize(torch.from_numpy(np.take_along_axis(away, chosen[..., None], axis=1)), dim=-1)
        parts = rays.split(max(1, _ANGLES // len(used) ** 2))
        cosines = torch.cat([torch.bmm(part, part.transpose(1, 2)).amin((1, 2)) for part in parts]).numpy()
        largest[rows] = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return largest


def small_frame(frame: Frame, max_size: int) -> Frame:
    """Return the frame with its picture reduced to a longer side of at most `max_size` pixels, with the same lens."""
    camera = frame.camera
    factor = max(1.0, max(camera.width, camera.height) / max_size)
    size = (max(1, round(camera.width / factor)), max(1, round(camera.height / factor)))
    return replace(frame, camera=camera.resized(*size))


def with_coverage(
    picture: RenderedPicture, frame: Frame, *, axis: str, photo_depths: Sequence[DepthMap]
) -> RenderedPicture:
    """Return a picture with median depth with coverage and parallax, by all photos, of the points at that depth."""
    assert picture.median is not None
    rays, _ = frame.camera.pixel_bearings()
    if axis == "z":
        ahead = rays[:, 2] > 0
        rays = rays / np.where(ahead, rays[:, 2], 1.0)[:, None]
    points = apply(frame.world_from_cam, rays * picture.median.reshape(-1, 1))
    coverage, parallax = coverage_and_parallax(photo_depths, points)
    shape = picture.median.shape
    return replace(picture, coverage=coverage.reshape(shape), parallax=parallax.reshape(shape))
