"""Parallax: how far matches deviate from a pure rotation of the camera.

Without a baseline there is no depth, and a mapper that is forced to find some finds noise. A rotation about the lens
moves every pixel by a homography, whatever its depth; the focal length, two radial terms and the principal point that
fit this best are estimated, and the remaining error is parallax. With fewer terms, made-up depth that compensates for
the mapper's simple lens model would fit better than a rotation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from nerfcli.poses.model.projection import Array, panorama_camera, px_per_radian
from nerfcli.poses.model.two_views import VerifiedPair, rays

# Matches are verified to 4 px; real baselines leave 20 px and more in most pairs, rotations leave feature noise only.
NO_PARALLAX_PX = 3.0
# One pair in four may be wrong.
_QUANTILE = 0.75
_MOST_PAIRS = 40
_MOST_MATCHES = 150
# The focal length is searched within these multiples of the longer side; beyond them, any pair looks like a rotation.
_FOCAL_RANGE = (0.3, 4.0)
_FOCAL_STARTS = (0.4, 0.55, 0.75, 1.0, 1.4, 2.0, 2.8)
# Largest values of the two radial terms, and of the principal point's distance from the centre over the longer side.
_MOST = np.array([0.4, 0.4, 0.1, 0.1])


@dataclass(frozen=True)
class RotationFit:
    """The best explanation of all matches by rotations of the camera alone.

    parallax_px: the remaining error that three pairs in four do not exceed (median over the matches of each). focal_px:
    as a pinhole in the largest picture; of panoramas, the pixels per radian. moved_px: how far matches are apart in
    the two pictures of a pair, as for parallax_px.
    """

    parallax_px: float
    focal_px: float
    moved_px: float = np.inf

    @property
    def explains_all(self) -> bool:
        """True if there is no significant parallax."""
        return self.parallax_px < NO_PARALLAX_PX

    @property
    def stands_still(self) -> bool:
        """True if matches are at the same place in all photos: the camera did not move, whatever turns before it."""
        return self.moved_px < NO_PARALLAX_PX


def best_rotation_fit(pairs: Sequence[VerifiedPair], sizes: Mapping[int, tuple[int, int]]) -> RotationFit | None:
    """Find how well rotations of one camera explain the matches; None without a pair.

    If there are many pairs, an even selection is used. `sizes` are width and height, pixels, by image id.
    """
    if not pairs:
        return None
    chosen, counts = _selected(pairs)
    longest = max(max(sizes[photo]) for pair in chosen for photo in (pair.one, pair.other))
    one = _from_middle([(pair.pixels_one, sizes[pair.one]) for pair in chosen], counts)
    other = _from_middle([(pair.pixels_other, sizes[pair.other]) for pair in chosen], counts)

    def left_over(values: Array) -> float:
        focal, (second, fourth), middle = float(np.exp(values[0])), values[1:3], values[3:]
        if not _FOCAL_RANGE[0] < focal < _FOCAL_RANGE[1] or np.any(np.abs(values[1:]) > _MOST):
            return 1e6
        shift = middle[:, None] * longest
        focal *= longest
        p, q = (_rays((places - shift) / focal, second, fourth) for places in (one, other))
        return float(np.quantile(_rest(p, q, counts), _QUANTILE) * focal)

    start = np.zeros(5)
    start[0] = min(np.log(_FOCAL_STARTS), key=lambda value: left_over(np.array([value, 0.0, 0.0, 0.0, 0.0])))
    simplex = np.vstack([start, start + np.diag((0.15, 0.05, 0.05, 0.01, 0.01))])
    options = {"maxiter": 200, "initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-2}
    found = minimize(left_over, start, method="Nelder-Mead", options=options)
    moved = [np.median(np.linalg.norm(pair.pixels_one - pair.pixels_other, axis=1)) for pair in chosen]
    return RotationFit(float(found.fun), float(np.exp(found.x[0]) * longest), float(np.quantile(moved, _QUANTILE)))


def panorama_rotation_fit(pairs: Sequence[VerifiedPair], sizes: Mapping[int, tuple[int, int]]) -> RotationFit | None:
    """Find how well rotations explain the matches between panoramas, whose rays are known, as `best_rotation_fit`."""
    if not pairs:
        return None
    chosen, counts = _selected(pairs)
    photos = {photo for pair in chosen for photo in (pair.one, pair.other)}
    cameras = {photo: panorama_camera(sizes[photo]) for photo in photos}
    one, other = np.zeros((2, len(chosen), 3, counts.max()))
    for place, (count, pair) in enumerate(zip(counts, chosen, strict=True)):
        one[place, :, :count] = rays(cameras[pair.one], pair.pixels_one[:count]).T
        other[place, :, :count] = rays(cameras[pair.other], pair.pixels_other[:count]).T
    focal_px = max(px_per_radian(camera) for camera in cameras.values())
    return RotationFit(float(np.quantile(_rest(one, other, counts), _QUANTILE) * focal_px), focal_px)


def _selected(pairs: Sequence[VerifiedPair]) -> tuple[Sequence[VerifiedPair], NDArray[np.int64]]:
    """Return an even selection of the pairs, and how many matches of each are used."""
    chosen = pairs[:: -(-len(pairs) // _MOST_PAIRS)]
    return chosen, np.array([min(pair.matches, _MOST_MATCHES) for pair in chosen])


def _from_middle(photos: Sequence[tuple[Array, tuple[int, int]]], counts: NDArray[np.int64]) -> Array:
    """Return the first pixels of each photo relative to its centre, (P, 2, M); zero beyond its count (P,)."""
    places = np.zeros((len(photos), 2, counts.max()))
    for place, count, (pixels, size) in zip(places, counts, photos, strict=True):
        place[:, :count] = (pixels[:count] - np.array(size) / 2).T
    return places


def _rays(distorted: Array, second: float, fourth: float) -> Array:
    """Return unit rays (P, 3, M) of a pinhole with two radial terms, inverted by fixed-point iteration."""
    x, y = given_x, given_y = distorted[:, 0], distorted[:, 1]
    for _ in range(5):
        squares = np.minimum(x * x + y * y, 25.0)
        scale = np.maximum(1 + squares * (second + squares * fourth), 0.2)
        x, y = given_x / scale, given_y / scale
    return np.stack([x, y, np.ones_like(x)], axis=1) / np.sqrt(x * x + y * y + 1)[:, None]


def _rest(p: Array, q: Array, counts: NDArray[np.int64]) -> Array:
    """Return each pair's median angle, (P,), between the first rays of p and q (P, 3, M), after the best rotation.

    The rotation is found as in Kabsch 1976, reweighted three times. Coordinates are the second axis, since sums of
    three terms along the last one take longer than all else.
    """
    there = np.arange(p.shape[2]) < counts[:, None]
    weights = there.astype(np.float64)
    median = np.zeros(len(p))
    pairs = np.arange(len(p))
    for _ in range(3):
        u, _, vt = np.linalg.svd((q * weights[:, None]) @ p.swapaxes(1, 2))
        u[..., 2] *= np.linalg.det(u @ vt)[:, None]
        x, y, z = ((u @ vt) @ p - q).swapaxes(0, 1)
        distances = np.where(there, np.sqrt(x * x + y * y + z * z), np.inf)
        ordered = np.sort(distances, axis=1)
        median = (ordered[pairs, (counts - 1) // 2] + ordered[pairs, counts // 2]) / 2
        weights = 1 / np.maximum(distances, median[:, None] + 1e-9)
    return median
