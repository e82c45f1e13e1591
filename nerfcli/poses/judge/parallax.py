"""Parallax: how far matches deviate from a pure rotation of the camera.

Without a baseline there is no depth, and a mapper that is made to find some finds noise. A turn about the lens moves
every pixel by a homography whatever its depth; the focal length and one distortion term that fit this best are sought,
and what is left over is parallax.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from nerfcli.poses.model.two_views import VerifiedPair

Array = NDArray[np.float64]

# Matches are verified to 4 px; real baselines leave 20 px and more in most pairs, turns leave the noise of features.
NO_PARALLAX_PX = 3.0
# One pair in four may be mistaken.
_QUANTILE = 0.75
_MOST_PAIRS = 40
_MOST_MATCHES = 150
# Sought within these multiples of the longer side; beyond, any pair looks like a turn.
_FOCAL_RANGE = (0.3, 4.0)
_FOCAL_STARTS = (0.4, 0.55, 0.75, 1.0, 1.4, 2.0, 2.8)
_MOST_DISTORTION = 0.4
_STEPS = 40


@dataclass(frozen=True)
class Turn:
    """The best explanation of all matches by turns of the camera alone.

    parallax_px: what is left of three pairs in four, or less. focal_px: as a pinhole in the largest picture.
    """

    parallax_px: float
    focal_px: float

    @property
    def explains_all(self) -> bool:
        """Whether there is no significant parallax."""
        return self.parallax_px < NO_PARALLAX_PX


def best_turn(pairs: Sequence[VerifiedPair], sizes: Mapping[int, tuple[int, int]]) -> Turn | None:
    """Find how well rotations of one camera explain the matches; None without a pair.

    Args:
        pairs: verified pairs; of many, an even choice is used.
        sizes: width and height of every photo, pixels, by image id.
    """
    if not pairs:
        return None
    chosen = pairs[:: -(-len(pairs) // _MOST_PAIRS)]
    longest = max(max(sizes[photo]) for pair in chosen for photo in (pair.one, pair.other))

    def left_over(values: Array) -> float:
        focal, distortion = float(np.exp(values[0])), float(values[1])
        if not _FOCAL_RANGE[0] < focal < _FOCAL_RANGE[1] or abs(distortion) > _MOST_DISTORTION:
            return 1e6
        focal *= longest
        medians = [
            _rest(
                _rays(pair.pixels_one[:_MOST_MATCHES], sizes[pair.one], focal_px=focal, distortion=distortion),
                _rays(pair.pixels_other[:_MOST_MATCHES], sizes[pair.other], focal_px=focal, distortion=distortion),
            )
            for pair in chosen
        ]
        return float(np.quantile(medians, _QUANTILE) * focal)

    start = min(np.log(_FOCAL_STARTS), key=lambda value: left_over(np.array([value, 0.0])))
    simplex = np.array([[start, 0.0], [start + 0.15, 0.0], [start, 0.05]])
    options = {"maxiter": _STEPS, "initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-2}
    found = minimize(left_over, simplex[0], method="Nelder-Mead", options=options)
    return Turn(float(found.fun), float(np.exp(found.x[0]) * longest))


def _rays(pixels: Array, size: tuple[int, int], *, focal_px: float, distortion: float) -> Array:
    """Unit rays of a pinhole with one radial term, its inverse by fixed-point iteration."""
    distorted = (pixels - np.array(size) / 2) / focal_px
    straight = distorted
    for _ in range(5):
        squared = np.minimum((straight**2).sum(axis=1, keepdims=True), 25.0)
        straight = distorted / np.maximum(1 + distortion * squared, 0.2)
    rays = np.column_stack([straight, np.ones(len(straight))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _rest(p: Array, q: Array) -> float:
    """Median angle between q and p after the rotation that fits them best (Kabsch 1976, three times reweighted)."""
    weights = np.ones(len(p))
    distances = weights
    for _ in range(3):
        u, _, vt = np.linalg.svd((q * weights[:, None]).T @ p)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        distances = np.linalg.norm(p @ rotation.T - q, axis=1)
        weights = 1 / np.maximum(distances, np.median(distances) + 1e-9)
    return float(np.median(distances))
