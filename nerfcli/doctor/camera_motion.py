"""Camera motion between two photos: rotation only, in front of a plane, or with parallax at all depths.

Symbols: x and y are the pixels of a match, relative to the picture centres; H a homography, K = diag(f, f, 1),
R a rotation.
"""

from dataclasses import dataclass

import cv2
import numpy as np

# A homography explains a pair if it fits this fraction of the inliers.
_EXPLAINS = 0.9


@dataclass(frozen=True)
class TwoViews:
    """Camera motion between two photos.

    Args:
        homography_fraction: of the matches that one homography fits: near 1 if the camera only
            turned, or if everything it saw is flat.
        baseline_over_depth: distance between the camera positions, relative to the distance of the scene.
    """

    homography_fraction: float
    rotation_deg: float
    baseline_over_depth: float

    @property
    def flat(self) -> bool:
        """True if a homography explains the pair, so that it shows no depth."""
        return self.homography_fraction >= _EXPLAINS


def estimate(x: np.ndarray, y: np.ndarray, focals_px: tuple[float, float], *, within_px: float) -> TwoViews | None:
    """Estimate the motion between two photos from inlier matches (N, 2); None if they do not determine it.

    If a homography H explains the matches, K^-1 H K = R + t n^T / d: its middle singular value is about 1, and the
    largest and smallest differ by |t| / d. The focal length, between 0.7 and 1.45 times the given one, is chosen to
    minimize that difference, so the result is a lower bound of |t| / d. Otherwise R and t come from the essential
    matrix, and the baseline is relative to the median depth of the triangulated points.

    Accuracy: if the focal lengths are off by 20 %, baseline over depth is off by about as much.
    """
    homography, inside = cv2.findHomography(x, y, cv2.USAC_MAGSAC, within_px, None, 1000, 0.999)
    fraction = 0.0 if homography is None or inside is None else float(inside.mean())
    if homography is not None and fraction >= _EXPLAINS:
        rotation_deg, ratio = _of_homography(homography, focals_px)
        return TwoViews(fraction, rotation_deg, ratio)
    one, other = x / focals_px[0], y / focals_px[1]
    threshold = within_px / max(focals_px)
    essential, _ = cv2.findEssentialMat(one, other, np.eye(3), cv2.USAC_MAGSAC, 0.999, threshold, 500)
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, one, other, np.eye(3))
    distances = _distances(one, other, rotation=rotation, translation=translation.ravel())
    if len(distances) < 10:
        return None
    return TwoViews(fraction, _angle_deg(rotation), float(1 / np.median(distances)))


def _of_homography(homography: np.ndarray, focals_px: tuple[float, float]) -> tuple[float, float]:
    """Return the rotation angle in degrees and |t| / d of a homography between pixels relative to the centres."""
    found = []
    # Focal lengths to try, relative to the given one, which may be wrong in EXIF.
    for trial in np.geomspace(0.7, 1.45, 15):
        first, second = (np.diag([focal * trial, focal * trial, 1.0]) for focal in focals_px)
        normalised = np.linalg.solve(second, homography @ first)
        left, singular, right = np.linalg.svd(normalised)
        rotation = left @ np.diag([1, 1, np.linalg.det(left) * np.linalg.det(right)]) @ right
        found.append(((singular[0] - singular[2]) / singular[1], _angle_deg(rotation)))
    ratio, angle = min(found)
    return angle, float(ratio)


def _distances(one: np.ndarray, other: np.ndarray, *, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Triangulate bearings (N, 2) at z = 1: depths in the first camera, in baselines, of points in front of both."""
    first, second = np.eye(3, 4), np.hstack([rotation, translation[:, None]])
    points = cv2.triangulatePoints(first, second, one.T.astype(np.float64), other.T.astype(np.float64))
    with np.errstate(divide="ignore", invalid="ignore"):
        points = points[:3] / points[3]
    z = points[2]
    z_other = rotation[2] @ points + translation[2]
    return z[np.isfinite(z) & (z > 0) & (z_other > 0)]


def _angle_deg(rotation: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))
