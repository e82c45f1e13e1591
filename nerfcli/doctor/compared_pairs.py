"""Compare two photos: matches, camera motion between them, moving objects.

All of this works without poses, at the picture size `photo_facts.LONGER_SIDE_PX`. Symbols: x and y are the pixels of a
match in the first and the second photo.
"""

import math
from dataclasses import dataclass

import numpy as np

from nerfcli.doctor import camera_motion
from nerfcli.doctor.moving import Patch, moving_patches
from nerfcli.doctor.photo_facts import MOST_FEATURES, PhotoFacts, PhotoFeatures
from nerfcli.matching.agreement import fundamental_matrix
from nerfcli.matching.features import LOOSE_RATIO, mutual_matches
from nerfcli.matching.stationary import Motions, in_place, motions
from nerfcli.photos.exif import Exif
from nerfcli.photos.focal_evidence import focal_evidence, usual_focal_px
from nerfcli.poses.model.two_views import panorama_inliers

# Epipolar tolerance of an inlier, pixels.
EPIPOLAR_PX = 2.0
# Fewer inliers than this may agree on a geometry by chance.
LEAST_MATCHES = 20
# Fewer pairs than this do not decide on a photo or the scene: each of them may be wrong.
FEWEST_PAIRS = 3
# Detail is compared at features of about the same size in both photos: their ratio is within this many octaves.
_SAME_SIZE_OCTAVES = 0.4


@dataclass(frozen=True)
class Pair:
    """Result of comparing two photos. Differences are second minus first.

    Args:
        first, second: indices of the photos, first < second.
        matches: number of mutual nearest neighbours among the features.
        inliers: number of matches that agree on one two-view geometry.
        shift: median distance between x and y of the inliers, as a fraction of the picture's diagonal.
        detail: median difference of log2 detail, at features of about the same size in both; NaN with too few values.
        stops: median difference of log2 light; NaN with too few values.
        stops_spread: median deviation from that median: small if everything became brighter by the same amount.
        redder: median difference of log2 red over blue; NaN with too few values.
        views: camera motion between the photos; None with too few inliers.
        patches: parts that moved independently.
        motions: static and moving matches, see `stationary`; None if no match stays in place.
        agreeing: pixels (N, 2) in each photo of the matches that agree on one geometry, at most 200 of them.
    """

    first: int
    second: int
    matches: int
    inliers: int
    shift: float = math.nan
    detail: float = math.nan
    stops: float = math.nan
    stops_spread: float = math.nan
    redder: float = math.nan
    views: camera_motion.TwoViews | None = None
    patches: tuple[Patch, ...] = ()
    motions: Motions | None = None
    agreeing: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def linked(self) -> bool:
        """True if the photos certainly show the same scene."""
        return self.inliers >= LEAST_MATCHES


def compare(
    photos: tuple[PhotoFacts, PhotoFacts],
    numbers: tuple[int, int],
    focals_px: tuple[float, float],
    *,
    most_features: int = MOST_FEATURES // 2,
) -> Pair:
    """Match two photos and analyse their matches.

    Args:
        focals_px: best known focal lengths, at the size at which features were detected.
        most_features: number of features of each photo to use, strongest first; by default half of them.
    """
    one, other = (photo.features for photo in photos)
    a, b = mutual_matches(one.descriptors[:most_features], other.descriptors[:most_features], ratio=LOOSE_RATIO)
    x, y = one.pixels[a], other.pixels[b]
    # Movements are estimated for pinholes; two panoramas are compared by their rays, without a movement.
    pinholes = not any(photo.is_panorama for photo in photos)
    if all(photo.is_panorama for photo in photos):
        agree = panorama_inliers(x, y, (one.size, other.size), within_px=EPIPOLAR_PX)
    else:
        _, agree = fundamental_matrix(x, y, within_px=EPIPOLAR_PX)
    count = int(agree.sum())
    if count < LEAST_MATCHES:
        return Pair(*numbers, len(a), count)
    same_size = agree & (np.abs(np.log2(other.scales[b] / one.scales[a])) < _SAME_SIZE_OCTAVES)
    lighter, redder = (other.light[b[agree]] - one.light[a[agree]]).T
    stops = _median(lighter)
    views, patches, still = None, (), None
    if pinholes and one.size == other.size and in_place(x, y, one.size)[0].any():
        still = motions(x, y, one.size)
    if pinholes and count >= 2 * LEAST_MATCHES:
        centres = [np.array(features.size) / 2 for features in (one, other)]
        views = camera_motion.estimate(x[agree] - centres[0], y[agree] - centres[1], focals_px, within_px=EPIPOLAR_PX)
        patches = moving_patches(x, y, agree, within_px=EPIPOLAR_PX)
    return Pair(
        *numbers,
        matches=len(a),
        inliers=count,
        shift=float(np.median(np.linalg.norm(y[agree] - x[agree], axis=1)) / np.hypot(*one.size)),
        detail=_median(other.detail[b[same_size]] - one.detail[a[same_size]]),
        stops=stops,
        stops_spread=_median(np.abs(lighter - stops)),
        redder=_median(redder),
        views=views,
        patches=patches,
        motions=still,
        agreeing=_some(x[agree], y[agree]),
    )


def focal_px(features: PhotoFeatures, exif: Exif) -> float:
    """Return the focal length at the feature-detection size: from EXIF, else a typical value."""
    known_px = focal_evidence(exif).focal_px
    if known_px is None:
        return usual_focal_px(*features.size)
    return max(features.size) * (known_px / max(exif.width, exif.height))


def _some(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return at most 200 of the matches, evenly chosen: enough for a median."""
    kept = slice(None, None, -(-len(x) // 200))
    return x[kept].copy(), y[kept].copy()


def _median(values: np.ndarray) -> float:
    measured = values[~np.isnan(values)]
    return float(np.median(measured)) if len(measured) >= LEAST_MATCHES // 2 else float("nan")
