"""Epipolar geometry of two photos without poses, and distances of matches from it.

Letters: x and y are the pixels of a match in the first and in the second photo, F the fundamental matrix, y F x = 0.
"""

import cv2
import numpy as np


def fundamental_matrix(
    x: np.ndarray, y: np.ndarray, *, within_px: float, trials: int = 2000, least: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the fundamental matrix (3, 3) of matches (N, 2); return it and the mask of its inliers, (N,) bool.

    The matrix is NaN, without inliers, where none is found. Deterministic.

    Args:
        within_px: inlier threshold, the distance of a match from its epipolar lines.
        trials: maximum number of random samples of matches.
        least: minimum number of matches.
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
