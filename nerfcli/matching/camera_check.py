"""Check given cameras against matched features of pairs of photos.

A field trained with a wrong focal length learns a scene that is distorted to fit the photos, so its residuals hardly
reveal the error. Matched features do, at any depth.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.lens_change import FOCAL, changeable, changed
from nerfcli.matching.agreement import agreement, rays_of
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
    misses_px, pair = _misses_by_focal(photos, usable, every=-(-count // 4000))  # thousands of matches are enough

    def costs(places: np.ndarray) -> np.ndarray:
        """Return the costs (places, pairs) of log factors (places,)."""
        misses = (np.log1p(np.square(misses_px(place))) for place in places)
        return np.array([np.bincount(pair, of_matches, minlength=len(usable)) for of_matches in misses])

    step, fine_step = 0.01, 0.001
    coarse = np.arange(-FARTHEST, FARTHEST + step / 2, step)
    lowest = int(costs(coarse).sum(1).argmin())
    given_px = float(np.median(misses_px(0.0)))
    if lowest in (0, len(coarse) - 1):
        return CameraCheck(0.0, math.inf, (given_px, given_px), count)
    fine = coarse[lowest] + np.arange(-step, step + fine_step / 2, fine_step)
    by_pair = costs(fine)
    parts = 10  # of the photos, of which the jackknife leaves out one at a time
    part = np.array([matches.photos for matches in usable]) % parts
    without = np.array([_lowest(fine, by_pair[:, (part != left).all(1)].sum(1)) for left in range(parts)])
    error = float(np.sqrt((parts - 1) / parts * np.square(without - without.mean()).sum()))
    best = _lowest(fine, by_pair.sum(1))
    return CameraCheck(best, error, (given_px, float(np.median(misses_px(best)))), count)


def _misses_by_focal(
    photos: Sequence[LoadedPhoto], pairs: Sequence[Matches], *, every: int
) -> tuple[Callable[[float], np.ndarray], np.ndarray]:
    """Return a function of the log factor of the focal length, and the pair (N,) of every n-th match.

    The function returns how far each of these matches (N,) is from its epipolar lines, in pixels.
    """
    counts = [len(matches.pixels[0][::every]) for matches in pairs]
    pair = np.repeat(np.arange(len(pairs)), counts)
    index = np.array([matches.photos for matches in pairs])[pair].T  # (2, matches)
    pixels = [np.concatenate([matches.pixels[side][::every] for matches in pairs]) for side in (0, 1)]
    cameras = [photo.frame.camera for photo in photos]
    rays = np.empty((len(NODES), 2, len(pair), 3))
    for node, of_node in zip(NODES, rays, strict=True):
        longer = [changed(camera, (FOCAL,), np.array([node])) for camera in cameras]
        of_node[:] = [rays_of(longer, *side) for side in zip(index, pixels, strict=True)]
    finite = np.isfinite(rays).all((0, 1, 3))
    first, second = index[:, finite]
    poses = np.array([photo.frame.world_from_cam for photo in photos])
    second_from_first = rigid.inverse(poses[second]) @ poses[first]
    radians = np.array([radians_per_pixel(camera) for camera in cameras])
    focal_px = 1.0 / np.maximum(radians[first], radians[second])
    rays = rays[:, :, finite]
    same = np.eye(len(NODES), dtype=bool)

    def misses_px(log_focal: float) -> np.ndarray:
        # Lagrange polynomials of the nodes.
        factors = (log_focal - NODES) / np.where(same, 1.0, NODES[:, None] - NODES)
        one, other = np.tensordot(np.where(same, 1.0, factors).prod(axis=1), rays, axes=1)
        return np.abs(agreement(one, other, second_from_first, focal_px=focal_px).line_px)

    return misses_px, pair[finite]


def _lowest(places: np.ndarray, costs: np.ndarray) -> float:
    """Return the minimum of the parabola through the lowest cost and its neighbours."""
    i = int(np.clip(costs.argmin(), 1, len(costs) - 2))
    before, at, after = costs[i - 1 : i + 2]
    bend = before - 2 * at + after
    offset = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(places[i] + np.clip(offset, -1.0, 1.0) * (places[1] - places[0]))
