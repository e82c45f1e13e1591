"""Choose pairs of photos and compare them: matches, camera motion between them, moving objects.

All of this works without poses, at the picture size `photo_facts.LONGER_SIDE_PX`. Symbols: x and y are the pixels of a
match in the first and the second photo.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from nerfcli.doctor.photo_facts import MOST_FEATURES, PhotoFacts
from nerfcli.matching.agreement import epipolar_px, fundamental_matrix
from nerfcli.matching.features import LOOSE_RATIO, mutual_matches
from nerfcli.matching.stationary import Motions, in_place, motions
from nerfcli.poses.engine.retrieval import alike, likeness
from nerfcli.poses.input.pairs import ALL_ALIKE_UP_TO
from nerfcli.poses.model.two_views import panorama_inliers

# Epipolar tolerance of an inlier, pixels.
EPIPOLAR_PX = 2.0
# Fewer inliers than this may agree on a geometry by chance.
LEAST_MATCHES = 20
# Fewer pairs than this do not decide on a photo or the scene: each of them may be wrong.
FEWEST_PAIRS = 3
# Detail is compared at features of about the same size in both photos: their ratio is within this many octaves.
_SAME_SIZE_OCTAVES = 0.4
# A homography explains a pair if it fits this fraction of the inliers.
_HOMOGRAPHY_EXPLAINS = 0.9

# In captures that are not compared exhaustively, each photo is compared with some later ones by name and with its most
# similar ones. The camera hardly moves between consecutive frames of a video, so there are wide steps, too.
_STEPS_BY_NAME = (1, 2, 8, 20, 50)
_LOOK_ALIKES = 6
# Similar photos are found by this many features of each photo, the largest ones; fewer miss some, more take longer.
_COARSEST = 96

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
class TwoViews:
    """Camera motion between two photos, and the distance between the cameras relative to that of the scene.

    flat: whether a homography explains the pair, so that it shows no depth: the camera only turned, or all is flat.
    """

    flat: bool
    baseline_over_depth: float


@dataclass(frozen=True)
class Patch:
    """A part of the first photo that moved independently, with a number of matches.

    Boxes are left, top, right, bottom in the first and in the second photo, pixels at `photo_facts.LONGER_SIDE_PX`.
    still: whether it is fixed in the image, like a watermark or the background of a turntable.
    """

    box: tuple[float, float, float, float]
    other_box: tuple[float, float, float, float]
    matches: int
    still: bool


@dataclass(frozen=True)
class Pair:
    """Result of comparing two photos. Differences are second minus first.

    Args:
        first, second: indices of the photos, first < second.
        inliers: number of matches that agree on one two-view geometry.
        shift: median distance between x and y of the inliers, as a fraction of the picture's diagonal.
        detail: median difference of log2 detail, at features of about the same size in both; NaN with too few values.
        stops: median difference of log2 light; NaN with too few values.
        stops_spread: median deviation from that median: small if everything became brighter by the same amount.
        red_blue_stops: median difference of log2 red over blue; NaN with too few values.
        views: camera motion between the photos; None with too few inliers.
        patches: parts that moved independently.
        motions: static and moving matches, see `stationary`; None if no match stays in place.
        agreeing: pixels (N, 2) in each photo of the matches that agree on one geometry, at most 200 of them.
    """

    first: int
    second: int
    inliers: int
    shift: float = math.nan
    detail: float = math.nan
    stops: float = math.nan
    stops_spread: float = math.nan
    red_blue_stops: float = math.nan
    views: TwoViews | None = None
    patches: tuple[Patch, ...] = ()
    motions: Motions | None = None
    agreeing: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def linked(self) -> bool:
        """True if the photos certainly show the same scene."""
        return self.inliers >= LEAST_MATCHES


def choose_pairs(photos: Sequence[PhotoFacts]) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, to compare: all of a small capture, about 11 per photo of a large one."""
    count = len(photos)
    if count <= ALL_ALIKE_UP_TO:
        return list(combinations(range(count), 2))
    near = {(i, i + step) for step in _STEPS_BY_NAME for i in range(count - step)}
    features = [photo.features for photo in photos]
    coarsest = [each.descriptors[np.argsort(-each.scales, kind="stable")[:_COARSEST]] for each in features]
    shared = likeness(coarsest, lambda stage, done, total: None)
    return sorted(near | set(alike(shared, _LOOK_ALIKES, paired=near)))


def pair_count(count: int) -> int:
    """Estimate how many pairs `choose_pairs` chooses."""
    if count <= ALL_ALIKE_UP_TO:
        return count * (count - 1) // 2
    return count * (len(_STEPS_BY_NAME) + _LOOK_ALIKES)


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
        return Pair(*numbers, count)
    step = -(-count // 200)  # at most 200 matches, evenly chosen, are enough for a median
    same_size = agree & (np.abs(np.log2(other.scales[b] / one.scales[a])) < _SAME_SIZE_OCTAVES)
    stops_at_matches, red_blue_stops = (other.light[b[agree]] - one.light[a[agree]]).T
    stops = _median(stops_at_matches)
    views, patches, still = None, (), None
    if pinholes and one.size == other.size and in_place(x, y, one.size)[0].any():
        still = motions(x, y, one.size)
    if pinholes and count >= 2 * LEAST_MATCHES:
        centres = [np.array(features.size) / 2 for features in (one, other)]
        views = estimate_motion(x[agree] - centres[0], y[agree] - centres[1], focals_px, within_px=EPIPOLAR_PX)
        patches = moving_patches(x, y, agree, within_px=EPIPOLAR_PX)
    return Pair(
        *numbers,
        inliers=count,
        shift=float(np.median(np.linalg.norm(y[agree] - x[agree], axis=1)) / np.hypot(*one.size)),
        detail=_median(other.detail[b[same_size]] - one.detail[a[same_size]]),
        stops=stops,
        stops_spread=_median(np.abs(stops_at_matches - stops)),
        red_blue_stops=_median(red_blue_stops),
        views=views,
        patches=patches,
        motions=still,
        agreeing=(x[agree][::step].copy(), y[agree][::step].copy()),
    )


def estimate_motion(
    x: np.ndarray, y: np.ndarray, focals_px: tuple[float, float], *, within_px: float
) -> TwoViews | None:
    """Estimate the motion between two photos from inlier matches (N, 2); None if they do not determine it.

    x and y are relative to the picture centres. With K = diag(f, f, 1) and a rotation R, a homography H that explains
    the matches is K^-1 H K = R + t n^T / d: its middle singular value is about 1, and the largest and smallest differ
    by |t| / d. The focal length, between 0.7 and 1.45 times the given one, which may be wrong in EXIF, is chosen to
    minimize that difference, so the result is a lower bound of |t| / d. Otherwise R and t come from the essential
    matrix, and the baseline is relative to the median depth of the triangulated points.

    Accuracy: if the focal lengths are off by 20 %, baseline over depth is off by about as much.
    """
    homography, inside = cv2.findHomography(x, y, cv2.USAC_MAGSAC, within_px, None, 1000, 0.999)
    if homography is not None and inside is not None and inside.mean() >= _HOMOGRAPHY_EXPLAINS:
        ratios = []
        for trial in np.geomspace(0.7, 1.45, 15):
            first, second = (np.diag([focal * trial, focal * trial, 1.0]) for focal in focals_px)
            singular = np.linalg.svd(np.linalg.solve(second, homography @ first), compute_uv=False)
            ratios.append(float((singular[0] - singular[2]) / singular[1]))
        return TwoViews(True, min(ratios))
    one, other = x / focals_px[0], y / focals_px[1]
    threshold = within_px / max(focals_px)
    essential, _ = cv2.findEssentialMat(one, other, np.eye(3), cv2.USAC_MAGSAC, 0.999, threshold, 500)
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, one, other, np.eye(3))
    distances = _distances(one, other, rotation=rotation, translation=translation.ravel())
    return None if len(distances) < 10 else TwoViews(False, float(1 / np.median(distances)))


def moving_patches(x: np.ndarray, y: np.ndarray, agree: np.ndarray, *, within_px: float) -> tuple[Patch, ...]:
    """Return patches of matches (N, 2) that moved independently; `agree` (N,) marks inliers of the camera motion.

    The criteria are strict, since a false alarm costs more trust than a miss: the matches of a patch must move
    together, hardly any match in it may follow the camera, and no single two-view geometry may explain the patch and
    the rest. Motion along the epipolar lines cannot be distinguished from a nearer object, and is missed.
    """
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


def _median(values: np.ndarray) -> float:
    measured = values[~np.isnan(values)]
    return float(np.median(measured)) if len(measured) >= LEAST_MATCHES // 2 else float("nan")


def _distances(one: np.ndarray, other: np.ndarray, *, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Triangulate bearings (N, 2) at z = 1: depths in the first camera, in baselines, of points in front of both."""
    first, second = np.eye(3, 4), np.hstack([rotation, translation[:, None]])
    points = cv2.triangulatePoints(first, second, one.T.astype(np.float64), other.T.astype(np.float64))
    with np.errstate(divide="ignore", invalid="ignore"):
        points = points[:3] / points[3]
    z = points[2]
    z_other = rotation[2] @ points + translation[2]
    return z[np.isfinite(z) & (z > 0) & (z_other > 0)]


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
