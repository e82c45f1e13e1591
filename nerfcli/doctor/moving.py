"""Detect moving objects between two photos: patches whose matches move together, but not with the camera.

The criteria are strict, since a false alarm costs more trust than a miss: the matches of a patch must move together,
hardly any match in it may follow the camera, and no single two-view geometry may explain the patch and the rest.
Motion along the epipolar lines cannot be distinguished from a nearer object, and is missed.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from nerfcli.matching.agreement import epipolar_px, fundamental_matrix

# A match farther than this many tolerances from its epipolar line does not follow the camera.
_FAR = 3.0
# Matches are neighbours within this distance; their motions may differ by `_MOTION_PX` plus a fraction of it.
_REACH_PX = 60.0
_MOTION_PER_DISTANCE = 0.25
_MOTION_PX = 3.0
_LEAST_IN_PATCH = 10
# Fraction of the matches in a patch that must not follow the camera.
_DOMINANT = 0.7
# Largest fraction of the picture's matches in one patch; beyond, it is unclear whether the patch or the rest moved.
_LARGEST_FRACTION = 0.35
# A candidate is rejected if one geometry explains more than this fraction of both the patch and the rest.
_EXPLAINED = 0.8


@dataclass(frozen=True)
class Patch:
    """A part of the first photo that moved independently.

    Args:
        box: left, top, right, bottom in the first photo, pixels at `photo_facts.LONGER_SIDE_PX`.
        other_box: the same in the second photo.
        matches: number of matches in the patch.
        still: True if it is fixed in the image, like a watermark or the background of a turntable.
    """

    box: tuple[float, float, float, float]
    other_box: tuple[float, float, float, float]
    matches: int
    still: bool


def moving_patches(x: np.ndarray, y: np.ndarray, agree: np.ndarray, *, within_px: float) -> tuple[Patch, ...]:
    """Return patches of matches (N, 2) that moved independently; `agree` (N,) marks inliers of the camera motion."""
    fundamental, _ = cv2.findFundamentalMat(x[agree], y[agree], cv2.FM_8POINT)
    if fundamental is None or fundamental.shape != (3, 3):
        return ()
    away = np.flatnonzero(~agree & (epipolar_px(x, y, fundamental) > _FAR * within_px))
    found = []
    for group in _moving_together(x[away], y[away]):
        members = away[group]
        if len(members) <= _LARGEST_FRACTION * len(x) and _is_patch(x, y, agree, members=members, within_px=within_px):
            shift = np.median(np.linalg.norm(y[members] - x[members], axis=1))
            found.append(Patch(_box(x[members]), _box(y[members]), len(members), bool(shift < _MOTION_PX / 2)))
    return tuple(found)


def _moving_together(x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """Group matches that are connected by neighbours with similar motion; small groups are left out."""
    count = len(x)
    if count < _LEAST_IN_PATCH:
        return []
    apart = np.linalg.norm(x[:, None] - x, axis=2)
    motion = y - x
    differs = np.linalg.norm(motion[:, None] - motion, axis=2)
    alike = (apart < _REACH_PX) & (differs < _MOTION_PX + _MOTION_PER_DISTANCE * apart)
    label = connected_components(alike, directed=False)[1]
    groups = [np.flatnonzero(label == which) for which in np.unique(label)]
    # A feature may be detected several times at one place, with several orientations.
    return [group for group in groups if len(np.unique(np.rint(x[group]), axis=0)) >= _LEAST_IN_PATCH]


def _is_patch(x: np.ndarray, y: np.ndarray, agree: np.ndarray, *, members: np.ndarray, within_px: float) -> bool:
    left, top, right, bottom = _box(x[members])
    inside = (x[:, 0] >= left) & (x[:, 0] <= right) & (x[:, 1] >= top) & (x[:, 1] <= bottom)
    if len(members) < _DOMINANT * (len(members) + (inside & agree).sum()):
        return False
    # Limit the rest to three times the patch or 40 matches, so that it does not outvote the patch.
    rest = np.flatnonzero(agree)
    chosen = rest[np.linspace(0, len(rest) - 1, min(len(rest), max(3 * len(members), 40))).astype(int)]
    both = np.concatenate([members, chosen])
    voted, _ = fundamental_matrix(x[both], y[both], within_px=within_px)
    median, _ = cv2.findFundamentalMat(x[both], y[both], cv2.FM_LMEDS)
    for matrix in (voted, median):
        if matrix is None or matrix.shape != (3, 3) or np.isnan(matrix).any():
            continue
        error = epipolar_px(x, y, matrix)
        if min(np.mean(error[members] < 2 * within_px), np.mean(error[chosen] < 2 * within_px)) > _EXPLAINED:
            return False
    return True


def _box(points: np.ndarray) -> tuple[float, float, float, float]:
    (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0)
    return float(left), float(top), float(right), float(bottom)
