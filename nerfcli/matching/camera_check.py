"""Check given cameras against matched features of pairs of photos.

A field trained with a wrong focal length learns a scene that is distorted to fit the photos, so its residuals hardly
reveal the error. Matched features do: at any depth, the ray of one photo is in the epipolar plane, which contains the
ray of the other photo and the baseline.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras.lens_change import FOCAL, changeable, changed
from nerfcli.matching.correspondences import radians_per_pixel
from nerfcli.matching.features import Matches
from nerfcli.photos.loading import LoadedPhoto

# Limit of the search in logarithms of factors of the focal length. A wrong unit or crop is off by more, and is obvious
# in every photo.
FARTHEST = 0.1
# The check needs at least this many matches and pairs of photos.
FEWEST_MATCHES, FEWEST_PAIRS = 60, 10
# Log factors at which rays are computed (Chebyshev nodes); interpolation between them is accurate to 1e-6 rad.
NODES = FARTHEST * np.cos(np.pi * (np.arange(6) + 0.5) / 6)


@dataclass(frozen=True)
class CameraCheck:
    """Result of a check of cameras against matches.

    Args:
        log_focal: logarithm of the factor by which all focal lengths should be multiplied.
        error: its standard error; infinite where the best factor is at the end of the search range.
        misses_px: median distances of features from their epipolar lines, without and with the factor.
        matches: number of matches.
    """

    log_focal: float
    error: float
    misses_px: tuple[float, float]
    matches: int


def check_cameras(photos: Sequence[LoadedPhoto], matched: Sequence[Matches]) -> CameraCheck | None:
    """Check cameras against matches; None where there are too few.

    The factor minimises the sum of log(1 + miss^2) over all matches, with misses in pixels: the larger a miss, the more
    likely the match is wrong. Its error comes from a jackknife over photos, because a wrong pose moves all matches of a
    photo alike.
    """
    usable = [
        matches
        for matches in matched
        if all(FOCAL in changeable(photos[index].frame.camera) for index in matches.photos)
    ]
    count = sum(len(matches.pixels[0]) for matches in usable)
    if count < FEWEST_MATCHES or len(usable) < FEWEST_PAIRS:
        return None
    rays = _Rays(photos, usable, every=-(-count // 4000))  # thousands of matches are enough

    def costs(places: np.ndarray) -> np.ndarray:
        """Return the costs (places, pairs) of log factors (places,)."""
        return np.array([rays.sums(np.log1p(np.square(rays.misses(place)))) for place in places])

    step, fine_step = 0.01, 0.001
    coarse = np.arange(-FARTHEST, FARTHEST + step / 2, step)
    lowest = int(costs(coarse).sum(1).argmin())
    if lowest in (0, len(coarse) - 1):
        miss = _median_miss(rays, 0.0)
        return CameraCheck(0.0, math.inf, (miss, miss), count)
    fine = coarse[lowest] + np.arange(-step, step + fine_step / 2, fine_step)
    by_pair = costs(fine)
    parts = 10  # of the photos, of which the jackknife leaves out one at a time
    part = np.array([matches.photos for matches in usable]) % parts
    without = np.array([_lowest(fine, by_pair[:, (part != left).all(1)].sum(1)) for left in range(parts)])
    error = float(np.sqrt((parts - 1) / parts * np.square(without - without.mean()).sum()))
    best = _lowest(fine, by_pair.sum(1))
    return CameraCheck(best, error, (_median_miss(rays, 0.0), _median_miss(rays, best)), count)


class _Rays:
    """Every n-th match of each pair of photos, with its rays at any focal length."""

    def __init__(self, photos: Sequence[LoadedPhoto], pairs: Sequence[Matches], *, every: int):
        self._pairs = len(pairs)
        pixels = [np.concatenate([matches.pixels[side][::every] for matches in pairs]) for side in (0, 1)]
        self._pair = np.repeat(np.arange(len(pairs)), [len(matches.pixels[0][::every]) for matches in pairs])
        indices = np.array([matches.photos for matches in pairs])[self._pair]  # (matches, 2)
        rays = [_rays_at_nodes(photos, indices[:, side], pixels[side]) for side in (0, 1)]
        finite = np.isfinite(rays[0]).all((0, 2)) & np.isfinite(rays[1]).all((0, 2))
        self._rays = [ray[:, finite] for ray in rays]
        self._pair, indices = self._pair[finite], indices[finite]
        centres = np.array([photo.frame.centre for photo in photos])
        angles = np.array([radians_per_pixel(photo.frame.camera) for photo in photos])
        self._baselines = centres[indices[:, 1]] - centres[indices[:, 0]]
        self._pixels = angles[indices].max(axis=1)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sums (pairs,) of values (N,) of the matches of each pair."""
        return np.bincount(self._pair, values, minlength=self._pairs)

    def misses(self, log_focal: float) -> np.ndarray:
        """Return the angles (N,) between rays and their epipolar planes, in pixels."""
        # Lagrange polynomials of the nodes.
        apart = NODES[:, None] - NODES[None, :] + np.eye(len(NODES))
        fractions = np.prod(np.where(np.eye(len(NODES), dtype=bool), 1.0, (log_focal - NODES[None, :]) / apart), axis=1)
        one, other = (np.tensordot(fractions, ray, axes=1) for ray in self._rays)
        away = []
        for ray, partner in ((one, other), (other, one)):
            normal = np.cross(self._baselines, partner)
            length = np.linalg.norm(normal, axis=1)
            # A ray along the baseline has no epipolar plane: its miss is 0.
            away.append(np.abs(np.einsum("ni,ni->n", ray, normal)) / np.maximum(length, 1e-300))
        return np.maximum(*away) / self._pixels


def _rays_at_nodes(photos: Sequence[LoadedPhoto], indices: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the directions (nodes, N, 3) in the world of pixels (N, 2) of photos (N,); NaN where there is none."""
    numbers = {camera: number for number, camera in enumerate({photos[index].frame.camera for index in set(indices)})}
    camera_of_ray = np.array([numbers.get(photo.frame.camera, -1) for photo in photos])[indices]
    rays = np.empty((len(NODES), len(pixels), 3))
    for camera, number in numbers.items():
        rows = camera_of_ray == number
        for node, of_node in zip(NODES, rays, strict=True):
            bearings, valid = changed(camera, (FOCAL,), np.array([node])).bearings(pixels[rows])
            of_node[rows] = np.where(valid[:, None], bearings, np.nan)
    world_from_cam = np.array([photo.frame.world_from_cam[:3, :3] for photo in photos])[indices]
    return np.einsum("nij,knj->kni", world_from_cam, rays)


def _median_miss(rays: _Rays, log_focal: float) -> float:
    """Return the median miss of all matches, pixels."""
    return float(np.median(rays.misses(log_focal)))


def _lowest(places: np.ndarray, costs: np.ndarray) -> float:
    """Return the minimum of the parabola through the lowest cost and its neighbours."""
    i = int(np.clip(costs.argmin(), 1, len(costs) - 2))
    before, at, after = costs[i - 1 : i + 2]
    bend = before - 2 * at + after
    offset = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(places[i] + np.clip(offset, -1.0, 1.0) * (places[1] - places[0]))
