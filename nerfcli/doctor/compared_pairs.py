"""Compare two photos: matches, camera motion between them, moving objects.

Everything is found at `photos.LONGER_SIDE_PX` without poses. Letters: x and y are the pixels of a match in the first
and the second photo, F their fundamental matrix, H a homography between them, K the matrix of a camera.
"""

from dataclasses import dataclass

import numpy as np

from nerfcli.doctor import camera_motion
from nerfcli.doctor.moving import Patch, moving_patches
from nerfcli.doctor.photo_facts import PhotoFacts, PhotoFeatures
from nerfcli.media.focal_evidence import focal_evidence
from nerfcli.media.images import Exif
from nerfcli.multiview.epipolar import fundamental_matrix
from nerfcli.multiview.features import LOOSE_RATIO, mutual_matches
from nerfcli.multiview.stationary import Motions, in_place, motions

# Of each photo so many features are compared at first; all of them where these link it to nothing.
QUICK_FEATURES = 1000
# How far a match may be from what a geometry says, pixels.
EPIPOLAR_PX = 2.0
# Fewer matches than these agree on a common geometry by chance.
LEAST_MATCHES = 20
# The fewest whose geometry is looked into.
_LEAST_FOR_GEOMETRY = 40
# Light and detail are compared where both photos show a thing about as large: their ratio is within this many octaves.
_SAME_SIZE_OCTAVES = 0.4
_LEAST_COMPARED = 12


@dataclass(frozen=True)
class Pair:
    """Result of comparing two photos. Differences are second minus first.

    Args:
        first, second: numbers of the photos, first < second.
        matches: features that choose each other.
        inliers: those of them that agree on one geometry of two views.
        shift: median distance between x and y of the inliers, as a share of the picture's diagonal.
        detail: median difference of log2 detail where both show a thing at the same size; NaN where too few tell.
        stops: median difference of log2 light; NaN where too few tell.
        stops_spread: median distance from that median: small where all that is seen became lighter alike.
        redder: median difference of log2 red over blue; NaN where too few tell.
        views: how the camera moved between the photos; None where too few inliers tell.
        patches: what else moved.
        motions: what the matches say of a background that stays in its place; None where none stay.
    """

    first: int
    second: int
    matches: int
    inliers: int
    shift: float
    detail: float
    stops: float
    stops_spread: float
    redder: float
    views: camera_motion.TwoViews | None
    patches: tuple[Patch, ...]
    motions: Motions | None = None

    @property
    def linked(self) -> bool:
        """Whether the photos certainly show the same scene."""
        return self.inliers >= LEAST_MATCHES


def compare(
    photos: tuple[PhotoFacts, PhotoFacts],
    numbers: tuple[int, int],
    focals_px: tuple[float, float],
    *,
    most_features: int = QUICK_FEATURES,
) -> Pair:
    """Match two photos and look at what their matches say.

    Args:
        numbers: of the photos.
        focals_px: at the size in which features were sought, as well as they are known.
        most_features: of each photo, the clearest ones.
    """
    one, other = (photo.features for photo in photos)
    a, b = mutual_matches(one.descriptors[:most_features], other.descriptors[:most_features], ratio=LOOSE_RATIO)
    x, y = one.pixels[a], other.pixels[b]
    _, agree = fundamental_matrix(x, y, within_px=EPIPOLAR_PX)
    count = int(agree.sum())
    if count < LEAST_MATCHES:
        unknown = float("nan")
        return Pair(*numbers, len(a), count, unknown, unknown, unknown, unknown, unknown, None, ())
    same_size = np.abs(np.log2(other.scales[b] / one.scales[a])) < _SAME_SIZE_OCTAVES
    chosen = agree & same_size
    lighter, redder = (other.light[b[agree]] - one.light[a[agree]]).T
    stops = _median(lighter)
    views, patches, still = None, (), None
    if one.size == other.size and in_place(x, y, one.size)[0].any():
        still = motions(x, y, one.size)
    if count >= _LEAST_FOR_GEOMETRY:
        centres = [np.array(features.size) / 2 for features in (one, other)]
        views = camera_motion.estimate(x[agree] - centres[0], y[agree] - centres[1], focals_px)
        patches = moving_patches(x, y, agree, within_px=EPIPOLAR_PX)
    return Pair(
        *numbers,
        matches=len(a),
        inliers=count,
        shift=float(np.median(np.linalg.norm(y[agree] - x[agree], axis=1)) / np.hypot(*one.size)),
        detail=_median(other.detail[b[chosen]] - one.detail[a[chosen]]),
        stops=stops,
        stops_spread=_median(np.abs(lighter - stops)),
        redder=_median(redder),
        views=views,
        patches=patches,
        motions=still,
    )


def focal_px(features: PhotoFeatures, exif: Exif) -> float:
    """Return the focal length at the size of the features: from EXIF, else a typical value."""
    longer = max(features.size)
    known_px = focal_evidence(exif).focal_px
    return longer * (1.0 if known_px is None else known_px / max(exif.width, exif.height))


def _median(values: np.ndarray) -> float:
    measured = values[~np.isnan(values)]
    return float(np.median(measured)) if len(measured) >= _LEAST_COMPARED else float("nan")
