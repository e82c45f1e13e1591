"""Tracks: which photos saw which points, and where their rays meet. Those of structure from motion:
`captures.model_tracks`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.matching.features import Matches
from nerfcli.photos.loading import LoadedPhoto

# Largest reprojection error, in pixels of the training photo; poses and lenses of captures are often off by one or two.
WITHIN_PX = 3.0
# Rays that meet at a smaller angle do not determine the distance: half a pixel would change it by a tenth or more.
LEAST_ANGLE_RAD = np.radians(1.0)
# A point counts as seen by photos that look at it within this angle of a photo in which it was found.
SAME_SIDE_COS = np.cos(np.radians(40.0))
# More points take time and memory, but do not change what they are used for.
MOST_POINTS = 20_000


@dataclass(frozen=True)
class Tracks:
    """Sightings of points.

    Args:
        photos: (O,) int64, the index of the photo of each sighting.
        points: (O,) int64, the index of its point, from 0 on.
        rays: (O, 3) unit directions from the photo's camera, in the scene's frame; NaN where the lens has no ray.
    """

    photos: np.ndarray
    points: np.ndarray
    rays: np.ndarray

    @property
    def count(self) -> int:
        """Number of points."""
        return int(self.points.max(initial=-1)) + 1


@dataclass(frozen=True)
class Surface:
    """Points that photos agree on.

    Args:
        points: (P, 3) in the scene's frame, float64; NaN where photos do not agree.
        misses_px: (O,) reprojection error of each sighting, in pixels at the centre of the training photo; NaN where it
            is too large, or there is no point.
    """

    points: np.ndarray
    misses_px: np.ndarray

    @property
    def found(self) -> np.ndarray:
        """Points (N, 3) on which photos agree."""
        return self.points[np.isfinite(self.points).all(axis=1)]


def tracks_of_matches(photos: Sequence[LoadedPhoto], matched: Sequence[Matches]) -> Tracks:
    """Return matches as tracks, with a point seen by two photos for each match; some are wrong."""
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))]
    first = 0
    for matches in matched:
        points = first + np.arange(len(matches.pixels[0]))
        first += len(points)
        for number, pixels in zip(matches.photos, matches.pixels, strict=True):
            frame = photos[number].frame
            rays = world_rays(frame.camera.bearings(pixels), frame.world_from_cam)
            parts.append((np.full(len(points), number), points, rays))
    return Tracks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def indices_by_value(numbers: np.ndarray, count: int) -> list[np.ndarray]:
    """Return the positions of each number from 0 to count - 1, in increasing order; other numbers are ignored."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.searchsorted(numbers[order], np.arange(count + 1)))[1:-1]


def world_rays(bearings: tuple[np.ndarray, np.ndarray], world_from_cam: np.ndarray) -> np.ndarray:
    """Return rays (N, 3) in the scene's frame of bearings (N, 3) and their validity (N,); NaN where not valid."""
    return np.where(bearings[1][:, None], bearings[0], np.nan) @ world_from_cam[:3, :3].T


def triangulate(frames: Sequence[Frame], tracks: Tracks) -> Surface:
    """Triangulate each track on which at least two photos agree: the point nearest to all its rays.

    x = (sum_i I - d_i d_i^T)^-1 sum_i (I - d_i d_i^T) o_i,  d_i unit rays, o_i camera centres

    For two rays at an angle a, the least eigenvalue of the matrix is 1 - cos a; below that of `LEAST_ANGLE_RAD`, the
    distance is not known. Accuracy: a few per cent of the distance at worst, except for a few points that are wrong.
    """
    centres = np.array([frame.centre for frame in frames])
    middle = centres.mean(axis=0)  # far from the origin of GPS coordinates, rounding would cost digits
    origins = (centres - middle)[tracks.photos]
    px = np.array([1.0 / frame.camera.focal_px for frame in frames])[tracks.photos]
    misses = np.where(np.isfinite(tracks.rays).all(axis=1), 0.0, np.nan)
    points = np.full((tracks.count, 3), np.nan)
    for _ in range(2):  # the second time without sightings that were far off
        points = _nearest(origins, tracks, np.isfinite(misses))
        away = points[tracks.points] - origins
        across = np.linalg.norm(np.cross(tracks.rays, away), axis=1)
        misses = np.arctan2(across, np.einsum("oi,oi->o", tracks.rays, away)) / px
        misses[~(misses < WITHIN_PX)] = np.nan
    agreed = np.bincount(tracks.points[np.isfinite(misses)], minlength=tracks.count) >= 2
    points[~agreed] = np.nan
    misses[~agreed[tracks.points]] = np.nan
    return Surface(points + middle, misses)


def _nearest(origins: np.ndarray, tracks: Tracks, used: np.ndarray) -> np.ndarray:
    """Return the point nearest to the used rays of each track, (P, 3); NaN where they do not determine one."""
    of, rays, origins = tracks.points[used], tracks.rays[used], origins[used]

    def summed(values: np.ndarray) -> np.ndarray:
        return np.bincount(of, values, tracks.count)

    # Entry by entry: a matrix for each sighting would take as much memory as the photos of a large capture.
    products = np.array([[summed(rays[:, i] * rays[:, j]) for j in range(3)] for i in range(3)]).transpose(2, 0, 1)
    matrices = np.eye(3) * np.bincount(of, minlength=tracks.count)[:, None, None] - products
    along = np.einsum("oi,oi->o", rays, origins)
    sums = np.stack([summed(origins[:, i] - rays[:, i] * along) for i in range(3)], axis=-1)
    determined = np.linalg.eigvalsh(matrices)[:, 0] > 1.0 - np.cos(LEAST_ANGLE_RAD)
    points = np.full((tracks.count, 3), np.nan)
    points[determined] = np.linalg.solve(matrices[determined], sums[determined][:, :, None])[..., 0]
    return points
