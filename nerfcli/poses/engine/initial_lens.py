"""Initial lenses for mapping, from verified pairs of photos, before any photo is placed.

Focal lengths are estimated where EXIF has no reliable one. Notation: p, q are the pixels of a match from the
centre of the picture, in units of the focal length, with 1 appended; E = U diag(1, 1, 0) V the essential matrix of a
pair, q^T E p = 0.

If the lens was a fisheye, a mapper that starts from a perspective lens finds few photos that fit together, or many that
fit badly. A pair of photos alone can tell: with the right projection, more of its matches agree on one motion of the
camera. Without a known lens, matches may agree on any fundamental matrix, which is more general than a motion with a
known lens; so a perspective photo never gains by a fisheye.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from nerfcli.photos.focal_evidence import usual_focal_px
from nerfcli.poses.engine.database import register_photos
from nerfcli.poses.input.job import CameraGroup, Job, Tell
from nerfcli.poses.model.held_out import MOST_ERROR_PX
from nerfcli.poses.model.intrinsics import START_FISHEYE, START_MODEL
from nerfcli.poses.model.projection import Array
from nerfcli.poses.model.reasons import FEW_MATCHES
from nerfcli.poses.model.two_views import VerifiedPair, read_verified_pairs

# Pairs determine the focal length if its spread is small and the cost rises beside it; photos of an object from all
# sides and one distance do not.
_LARGEST_SPREAD = 0.05
_LEAST_RISE = 0.1
# Focal lengths that are compared, over the longer side: fields of view from 103 to 14 degrees.
_GRID = np.geomspace(0.4, 4.0, 48)
# Number of matches of each pair that is used.
_MATCHES = 50
_LEAST_PAIRS = 20
_VERIFIED_PX = 2.0
# Distances from the epipolar line beyond this count by their logarithm.
_NOISE_PX = 1.5
# Largest cost of a pair for a focal length, px^2: one with wrong matches, or of a moving object, must not decide.
_MOST_PER_PAIR = 3.0
_TWO = np.array([1.0, 1.0, 0.0])
# Focal lengths of fisheyes to try, over the longer side: an equidistant lens shows 1 / fraction radians along it.
_FISHEYE_FOCAL_FRACTIONS = np.geomspace(0.25, 0.85, 8)
# More matches must agree by this factor.
_CLEARLY_MORE = 1.1
_LEAST_FISHEYE_MATCHES = 60
# A focal length that differs from EXIF's by more than this factor (its logarithm) is reported.
_FAR_FROM_EXIF = 0.1


def estimate_focal_lengths(job: Job, tell: Tell) -> Job:
    """Return the job, and update its database, with focal lengths estimated from pairs of photos that determine them.

    Only cameras without a reliable focal length from EXIF or the user are estimated. By default the mapper starts
    from 1.2 times the longer side; if that is a third off, it takes up to three times as long.
    """
    unknown = [
        group
        for group in job.groups
        if group.params is None and not group.focal_is_prior and "FISHEYE" not in group.model
    ]
    if not unknown:
        return job
    pairs = read_verified_pairs(job.database, min_matches=FEW_MATCHES)
    groups = tuple(_estimated(group, job, pairs, tell) if group in unknown else group for group in job.groups)
    if groups == job.groups:
        return job
    estimated = replace(job, groups=groups)
    register_photos(estimated)
    return estimated


def _estimated(group: CameraGroup, job: Job, pairs: Sequence[VerifiedPair], tell: Tell) -> CameraGroup:
    photos = {job.image_ids[number] for number in group.photos}
    of_group = [pair for pair in pairs if pair.one in photos and pair.other in photos]
    found = focal_length(of_group, (group.width, group.height), seed=job.seed)
    if found is None or found.spread > _LARGEST_SPREAD or found.rise < _LEAST_RISE:
        return group
    tell(
        f"starting from a focal length of {found.px:.0f} px, estimated from {found.pairs} pairs of photos "
        f"(spread {100 * found.spread:.1f} %)"
    )
    return replace(group, estimated_focal_px=found.px)


@dataclass(frozen=True)
class FocalLength:
    """Focal length in pixels, and the number of pairs that it is estimated from.

    spread: relative, half of the interval with 80 % of the estimates from resampled pairs. rise: of the mean cost per
    pair if the focal length is a fifth shorter or longer, px^2, whichever is less; 3 at most.
    """

    px: float
    pairs: int
    spread: float
    rise: float


def focal_length(pairs: Sequence[VerifiedPair], size: tuple[int, int], *, seed: int) -> FocalLength | None:
    """Estimate the focal length with which essential matrices fit the matches of all pairs best.

    With a wrong focal length, a fundamental matrix corresponds to no rotation and direction (Kruppa's equations). For
    each focal length of a grid, each pair gets the essential matrix that fits its matches best; its cost above that of
    the pair's own best focal length, up to a limit, is summed over the pairs. Flat scenes, pure rotations, and cameras
    that look at one point from one distance fit any focal length; then there is no rise, or a large spread. The pairs
    are of one camera, with negligible distortion and the principal point at the centre. None if fewer than 20 of them
    have enough matches.
    """
    rng = np.random.default_rng(seed)
    usable = [pair for pair in pairs if pair.matches >= _MATCHES]
    drawn = [usable[index] for index in rng.permutation(len(usable))[:300]]
    found = [two_views for pair in drawn if (two_views := _two_views(pair, size, rng)) is not None]
    if len(found) < _LEAST_PAIRS:
        return None
    F, p, q = (np.array(parts) for parts in zip(*found, strict=True))
    focal_px = _GRID * max(size)
    costs = np.array([_fitted_cost(F, p, q, each) for each in focal_px]).T  # (pairs, focal lengths)
    costs = np.minimum(costs - costs.min(axis=1, keepdims=True), _MOST_PER_PAIR)
    again = [_lowest(focal_px, costs[rng.integers(len(costs), size=len(costs))].sum(axis=0)) for _ in range(100)]
    low, high = np.quantile(np.log(again), [0.1, 0.9])
    mean = costs.mean(axis=0)
    px = _lowest(focal_px, mean)
    away = np.interp(np.log([px / 1.2, px * 1.2]), np.log(focal_px), mean)
    return FocalLength(px, len(found), float(high - low) / 2, float(away.min() - mean.min()))


def _two_views(
    pair: VerifiedPair, size: tuple[int, int], rng: np.random.Generator
) -> tuple[Array, Array, Array] | None:
    """Return the fundamental matrix of a pair, and some of its inliers in each photo, pixels from the centre."""
    options = pycolmap.RANSACOptions(max_error=_VERIFIED_PX, random_seed=int(rng.integers(2**31)))
    options.min_num_trials, options.max_num_trials = 50, 1000  # the matches are verified
    one, other = (pixels - np.array(size) / 2 for pixels in (pair.pixels_one, pair.pixels_other))
    found = pycolmap.estimate_fundamental_matrix(one, other, options)
    inliers = np.flatnonzero([] if found is None else found["inlier_mask"])
    if found is None or len(inliers) < _MATCHES:
        return None
    inliers = rng.choice(inliers, _MATCHES, replace=False)
    return found["F"], one[inliers], other[inliers]


def _fitted_cost(F: Array, p: Array, q: Array, focal_px: float) -> Array:
    """Return per pair the robust sum of squared Sampson distances, px^2, of the essential matrix that fits best.

    Gauss-Newton with weights from the essential matrix nearest to F, by the rotations U and V. With a = U^T q and
    b = V p, the residual q^T E p is a1 b1 + a2 b2; a rotation U exp([w]x) changes it by w . (diag(1, 1, 0) b x a), a
    rotation exp([w]x) V by w . (b x diag(1, 1, 0) a).
    """
    scale = np.diag([focal_px, focal_px, 1.0])
    U, _, V = np.linalg.svd(scale @ F @ scale)
    p, q = (np.insert(pixels / focal_px, 2, 1.0, axis=-1) for pixels in (p, q))
    best = np.full(len(F), np.inf)
    for _ in range(6):
        a, b = q @ U, p @ np.swapaxes(V, 1, 2)  # (pairs, matches, 3)
        there, back = (b * _TWO) @ np.swapaxes(U, 1, 2), (a * _TWO) @ V  # E p and E^T q
        slope = np.sqrt(there[..., 0] ** 2 + there[..., 1] ** 2 + back[..., 0] ** 2 + back[..., 1] ** 2)
        factor = focal_px / np.maximum(slope, 1e-12)
        (a1, a2, a3), (b1, b2, b3) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
        px = factor * (a1 * b1 + a2 * b2)  # (pairs, matches)
        best = np.minimum(best, (_NOISE_PX**2 * np.log1p((px / _NOISE_PX) ** 2)).sum(axis=-1))
        both = b1 * a2 - b2 * a1
        J = factor[..., None] * np.stack([b2 * a3, -b1 * a3, both, -b3 * a2, b3 * a1, both], axis=-1)
        weighted = J / (1 + (px / _NOISE_PX) ** 2)[..., None]
        normal = np.swapaxes(J, 1, 2) @ weighted
        # One of six rotations changes nothing.
        normal += 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        step = np.linalg.solve(normal, -np.einsum("nmk,nm->nk", weighted, px)[..., None])[..., 0]
        U, V = U @ Rotation.from_rotvec(step[:, :3]).as_matrix(), Rotation.from_rotvec(step[:, 3:]).as_matrix() @ V
    return best


def _lowest(focal_px: Array, costs: Array) -> float:
    """Return the focal length at the vertex of the parabola through the lowest cost and its neighbours."""
    index = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
    before, lowest, after = costs[index - 1 : index + 2]
    bend = before - 2 * lowest + after
    offset = np.clip((before - after) / (2 * bend), -0.5, 0.5) if bend > 0 else 0.0
    return float(focal_px[index] * (focal_px[1] / focal_px[0]) ** offset)


def tell_of_exif(given: Job, used: Job, model: pycolmap.Reconstruction, tell: Tell) -> None:
    """Tell the user where a model's focal length differs from EXIF's, which was not used.

    Photos of a camera that moves straight ahead determine the focal length poorly.
    """
    for number, (group, taken) in enumerate(zip(given.groups, used.groups, strict=True), start=1):
        if group.focal_px is None or taken.focal_px is not None or number not in model.cameras:
            continue
        found_px = model.cameras[number].mean_focal_length()
        if abs(math.log(found_px / group.focal_px)) > _FAR_FROM_EXIF:
            tell(
                f"EXIF's focal length ({group.focal_px:.0f} px) was not used, since few photos registered with it; the "
                f"photos give {found_px:.0f} px: if EXIF is right, give --intrinsics"
            )


def detect_fisheyes(job: Job) -> Job | None:
    """Return the job with cameras that start from a fisheye where pairs of photos indicate one; None if none do.

    Only cameras without a model from a file or the user are tested.
    """
    groups = []
    with pycolmap.Database.open(job.database) as database:
        for group in job.groups:
            is_open = group.choose and group.model == START_MODEL and group.params is None
            focal_px = _fisheye_focal_px(group, job, database) if is_open else None
            groups.append(group if focal_px is None else _fisheye(group, focal_px))
    return None if tuple(groups) == job.groups else replace(job, groups=tuple(groups))


def _fisheye(group: CameraGroup, focal_px: float) -> CameraGroup:
    params = (focal_px, focal_px, group.width / 2, group.height / 2, 0.0, 0.0, 0.0, 0.0)
    return replace(group, model=START_FISHEYE, params=params)


def _fisheye_focal_px(group: CameraGroup, job: Job, database: pycolmap.Database) -> float | None:
    """Return the focal length of a fisheye with which clearly more matches agree than without one; None without any."""
    pairs = _strongest_pairs({job.image_ids[number] for number in group.photos}, database)
    if not pairs:
        return None
    ransac = {"random_seed": job.seed, "max_error": MOST_ERROR_PX, "max_num_trials": 1000}
    options = pycolmap.TwoViewGeometryOptions(ransac=ransac)
    usual_px = usual_focal_px(group.width, group.height)
    camera = pycolmap.Camera.create_from_model_name(1, START_MODEL, usual_px, group.width, group.height)
    any_geometry = partial(pycolmap.estimate_two_view_geometry, options=options)
    of_one_motion = partial(pycolmap.estimate_calibrated_two_view_geometry, options=options)
    freely = sum(_agreeing(any_geometry, camera, pair) for pair in pairs)
    longer = max(group.width, group.height)
    found = []
    for focal_px in longer * _FISHEYE_FOCAL_FRACTIONS:
        start = _fisheye(group, float(focal_px))
        camera = pycolmap.Camera.create_from_model_name(1, start.model, focal_px, group.width, group.height)
        camera.params = list(start.params or ())
        found.append((sum(_agreeing(of_one_motion, camera, pair) for pair in pairs), float(focal_px)))
    best, focal_px = max(found)
    return focal_px if best > _CLEARLY_MORE * freely else None


def _agreeing(
    estimate: Callable[..., pycolmap.TwoViewGeometry], camera: pycolmap.Camera, pair: tuple[Array, Array]
) -> int:
    """Return how many of a pair's matches agree on one geometry."""
    matches = np.repeat(np.arange(len(pair[0]), dtype=np.uint32)[:, None], 2, axis=1)
    return len(estimate(camera, pair[0], camera, pair[1], matches=matches).inlier_matches)


def _strongest_pairs(images: set[int], database: pycolmap.Database) -> list[tuple[Array, Array]]:
    """Return pixels (matches, 2) in both photos of the pairs with the most matches, each photo in at most one pair.

    All matches of photos that were taken side by side agree whatever the lens, so that one pair per photo is enough.
    """
    pair_ids, counts = database.read_num_matches()
    pairs = [(count, *pycolmap.pair_id_to_image_pair(pair_id)) for pair_id, count in zip(pair_ids, counts, strict=True)]
    chosen: list[tuple[Array, Array]] = []
    for count, one, other in sorted(pairs, reverse=True):
        if count < _LEAST_FISHEYE_MATCHES or len(chosen) == 8:
            break
        if {one, other} <= images:
            images = images - {one, other}
            matches = np.asarray(database.read_matches(one, other), dtype=np.int64)
            matches = matches[:: max(1, len(matches) // 400)]
            first, second = (np.asarray(database.read_keypoints(i), dtype=np.float64)[:, :2] for i in (one, other))
            chosen.append((first[matches[:, 0]], second[matches[:, 1]]))
    return chosen
