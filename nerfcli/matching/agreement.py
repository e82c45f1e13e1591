"""Measure how the matches of two photos agree with each other, and with the poses and lenses of the photos.

At any depth, the ray of one photo is in the epipolar plane, which contains the ray of the other photo and the baseline.
Letters: x and y are the pixels of a match in the first and in the second photo, F the fundamental matrix, y F x = 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera

# A baseline shorter than this is rounding of the poses, in scene units.
_NO_BASELINE = 1e-12


@dataclass(frozen=True)
class Agreement:
    """How the matches of two photos agree with their poses and lenses; NaN where a lens has no ray for a match.

    Args:
        sampson_px: (N,) signed distance from the epipolar geometry: noise in all coordinates of a match has the same
            standard deviation here.
        line_px: (N,) signed distance of a point from the epipolar line of the other, the larger of the two in size: a
            point moved by d pixels across its line is off by d or more.
        parallax, parallax_px: (N,) angle between the two rays, in radians, and times the focal length.
        behind: (N,) bool, whether the two rays meet behind a camera: noise decides where they are nearly parallel.
    """

    sampson_px: np.ndarray
    line_px: np.ndarray
    parallax: np.ndarray
    parallax_px: np.ndarray
    behind: np.ndarray

    @property
    def count(self) -> int:
        """Number of matches with two rays."""
        return int(np.isfinite(self.parallax).sum())


def agreement(
    first: np.ndarray, second: np.ndarray, cam1_from_cam0: np.ndarray, *, focal_px: float | np.ndarray
) -> Agreement:
    """Measure how matches agree with the relative pose of two photos.

    With unit rays p and q of a match in the second camera's axes and the baseline t, the triple product
    e = q . (t x p) is 0 if the rays meet. Distances are e / |t x q| for the first point and e / |t x p| for the second,
    and Sampson's is e / sqrt(|t x p|^2 + |t x q|^2), all sines of angles, times the focal length. Rays along the
    baseline fit, with distance 0. Without a baseline, both rays should have the same direction: all distances are the
    angle between them.

    Args:
        first, second: (N, 3) unit rays of the match in each camera's axes, NaN where there is none.
        cam1_from_cam0: (4, 4) or (3, 4), or (N, 4, 4) for a pose per match.
        focal_px: pixels per radian, of the pair or of each match.

    Source: Hartley and Zisserman, 2nd edition, section 11.4.3; on the sphere as in Pagani and Stricker 2011.
    """
    t = cam1_from_cam0[..., :3, 3]
    p, q = np.einsum("...ij,...j->...i", cam1_from_cam0[..., :3, :3], first), np.asarray(second, dtype=np.float64)
    of_p, of_q, across = np.cross(t, p), np.cross(t, q), np.cross(p, q)
    lengths = _norm(of_p), _norm(of_q)
    parallax = np.arctan2(_norm(across), _dot(p, q))
    moved = _norm(t) >= _NO_BASELINE
    off = _dot(q, of_p)
    sampson, line = (
        np.where(moved, off / np.maximum(length, 1e-300), parallax)
        for length in (np.hypot(*lengths), np.minimum(*lengths))
    )
    # q d1 = p d0 + t, so these have the signs of the distances d0 and d1.
    behind = (_dot(across, of_q) > 0) | (_dot(across, of_p) > 0)
    return Agreement(focal_px * sampson, focal_px * line, parallax, focal_px * parallax, behind)


def rays_of(cameras: Sequence[Camera], photos: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the unit rays (N, 3) of pixels (N, 2) of photos (N,), in their cameras' axes; NaN where there is none."""
    places: dict[Camera, int] = {}
    labels = np.array([places.setdefault(camera, len(places)) for camera in cameras], dtype=np.int64)[photos]
    rays = np.full((len(pixels), 3), np.nan)
    for camera, place in places.items():
        rows = np.flatnonzero(labels == place)
        directions, valid = camera.bearings(pixels[rows])
        rays[rows[valid]] = directions[valid]
    return rays


def fundamental_matrix(
    x: np.ndarray, y: np.ndarray, *, within_px: float, trials: int = 2000, least: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the fundamental matrix (3, 3) of matches (N, 2); return it and the mask of its inliers, (N,) bool.

    The matrix is NaN, without inliers, where none is found, as with fewer matches than `least`. Inliers are within
    `within_px` of their epipolar lines. Deterministic.
    """
    nothing = np.full((3, 3), np.nan), np.zeros(len(x), dtype=bool)
    if len(x) < least:
        return nothing
    try:
        matrix, mask = cv2.findFundamentalMat(x, y, cv2.USAC_MAGSAC, within_px, 0.999, trials)
    except cv2.error:  # OpenCV's USAC asserts (!model.empty()) on some matches that all lie on a plane
        matrix, mask = cv2.findFundamentalMat(x, y, cv2.FM_RANSAC, within_px, 0.999, trials)
    if matrix is None or mask is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return nothing
    return matrix, mask.ravel().astype(bool)


def epipolar_px(x: np.ndarray, y: np.ndarray, fundamental: np.ndarray) -> np.ndarray:
    """Return the larger of the two distances of each match (N, 2) from its epipolar lines, pixels."""
    ones = np.ones((len(x), 1))
    first, second = np.hstack([x, ones]), np.hstack([y, ones])
    lines, back = first @ fundamental.T, second @ fundamental
    products = np.abs((second * lines).sum(axis=1))
    lengths = np.minimum(np.linalg.norm(lines[:, :2], axis=1), np.linalg.norm(back[:, :2], axis=1))
    return products / np.maximum(lengths, 1e-12)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def _norm(a: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(a, a))
