"""SIFT features of a photo, and matches between the features of two photos.

No cameras are needed. Used by training, `doctor` and `convert --detect`.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.photos.images import reduced

# A match is kept if it is nearer than this times the second-nearest feature. Source: Lowe 2004, section 7.1.
RATIO = 0.75
# For use where the geometry of the pair is estimated next, which removes wrong matches.
LOOSE_RATIO = 0.8


@dataclass(frozen=True)
class Features:
    """Features of a photo, in the order in which SIFT finds them.

    Args:
        pixels: (N, 2) in the photo, pixel centres at 0.5.
        sizes: (N,) float32, diameters of the features, in pixels of the photo.
        angles: (N,) float32, orientations in radians, clockwise from the x axis.
        responses: (N,) float32, contrast.
        descriptors: (N, 128) float32, whole numbers from 0 to 255.
    """

    pixels: np.ndarray
    sizes: np.ndarray
    angles: np.ndarray
    responses: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True)
class Matches:
    """Features that two photos (indices) have in common, (N, 2) in each, pixel centres at 0.5; some are wrong."""

    photos: tuple[int, int]
    pixels: tuple[np.ndarray, np.ndarray]


def find_features(
    grey: np.ndarray,
    *,
    longer_side_px: int,
    most: int,
    used: np.ndarray | None = None,
    contrast: float = 0.04,
    enlargement: float = 1.0,
) -> Features:
    """Find SIFT features in a grey photo (H, W) uint8, reduced until its longer side is at most `longer_side_px`.

    Args:
        most: number of features to keep, by contrast; a few more at equal contrast.
        used: (H, W) bool, where to look for features; None for everywhere.
        contrast: that a feature needs, as OpenCV counts it: three times the difference of two blurred pictures, of 1
            between black and white.
        enlargement: factor, at least 1, by which the reduced photo is enlarged to find smaller features.
    """
    height, width = grey.shape
    searched = reduced(grey, longer_side_px)
    if enlargement > 1:
        searched = cv2.resize(searched, None, fx=enlargement, fy=enlargement, interpolation=cv2.INTER_CUBIC)
    size = (searched.shape[1], searched.shape[0])
    mask, of_all = None, most
    if used is not None:
        mask = cv2.resize(used.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        # OpenCV chooses features before it applies the mask; if all were chosen, most descriptors would be in vain.
        of_all = math.ceil(most / max(mask.mean(), 1 / 16))
    # Without precise upscaling, OpenCV's keypoints are off by a quarter of a pixel.
    sift = cv2.SIFT.create(nfeatures=of_all, contrastThreshold=contrast, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(searched, mask)
    if descriptors is None:
        keypoints, descriptors = [], np.zeros((0, 128), dtype=np.float32)
    # OpenCV has pixel centres at whole numbers.
    found = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2) + 0.5
    responses = np.array([keypoint.response for keypoint in keypoints], dtype=np.float32)
    kept = responses >= (-np.partition(-responses, most - 1)[most - 1] if len(responses) > most else 0)
    return Features(
        found[kept] * (width / size[0], height / size[1]),
        np.array([keypoint.size for keypoint in keypoints], dtype=np.float32)[kept] * np.float32(width / size[0]),
        np.radians([keypoint.angle for keypoint in keypoints], dtype=np.float32)[kept],
        responses[kept],
        descriptors[kept],
    )


def mutual_matches(one: np.ndarray, other: np.ndarray, *, ratio: float = RATIO) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of features that are each other's nearest, and nearer than `ratio` times the second nearest.

    Squared distances between SIFT descriptors, (N, 128) and (M, 128), are exact in float32.
    """
    if min(len(one), len(other)) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    a, b = (descriptors.astype(np.float32) for descriptors in (one, other))
    distances = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2 * (a @ b.T)  # squared; (one, other)
    back = distances.argmin(axis=0)
    rows = np.arange(len(a))
    nearest = distances.argmin(axis=1)
    best = distances[rows, nearest].copy()
    distances[rows, nearest] = np.inf
    clear = best < ratio**2 * distances.min(axis=1)
    kept = clear & (back[nearest] == rows)
    return rows[kept], nearest[kept]
