"""Epipolar geometry of two photos, with and without poses, and distances of matches from it.

Letters: x and y are the pixels of a match in the first and in the second photo, F the fundamental matrix, y F x = 0.
"""

import cv2
import numpy as np


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


def sampson_angles(
    first: np.ndarray, second: np.ndarray, rotation: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the Sampson distance, as an angle, of matches from the epipolar geometry of poses; NaN without baseline.

    |b2 E b1| / sqrt(|E b1|^2 + |E^T b2|^2) with unit directions b and E = [t]x R of cam2_from_cam1.

    Args:
        first, second: unit viewing directions (N, 3) of the match in each camera.
        rotation, t: (3, 3) and (3,) of cam2_from_cam1, or (N, 3, 3) and (N, 3) for a pose per match.

    Returns:
        the angles (N,), radians; and whether the point of the match is behind a camera, (N,) bool, which means little
        where its two rays are nearly parallel.

    Source: Hartley and Zisserman, 2nd edition, section 11.4.3; on the sphere as in Pagani and Stricker 2011.
    """
    turned = np.einsum("...ij,...j->...i", rotation, first)  # the first direction in the second camera's axes
    normal1, normal2 = np.cross(t, turned), np.cross(second, t)  # E b1; E^T b2, up to the rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        angles = np.abs((second * normal1).sum(axis=-1)) / np.sqrt(
            (normal1**2).sum(axis=-1) + (normal2**2).sum(axis=-1)
        )
    across = np.cross(turned, second)
    # second d2 = turned d1 + t, so these have the signs of the distances d1 and d2.
    behind = ((across * normal2).sum(axis=-1) < 0) | ((across * normal1).sum(axis=-1) > 0)
    return angles, behind
