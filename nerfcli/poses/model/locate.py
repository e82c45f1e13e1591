"""Locate photos that match no other photo well, from the 3D points of the whole model.

Two photos far apart may share too few certain matches to place one of them. The points of a model were seen by many
photos: a feature that looks more like one point than like any other votes for it, and a pose that many votes agree on
is no accident. At the positions where that pose predicts points, more features match than by looks alone; beside these
positions, where none should match, hardly any do. A photo that fails this test is not placed.

Source: 2D-3D matching as in Sattler et al. 2011 (ICCV), with the ratio test between points of section 3.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree

from nerfcli.poses.input.job import Job, Report
from nerfcli.poses.model.intrinsics import refine_model
from nerfcli.poses.model.point_descriptors import (
    ALIKE,
    BLOCK,
    KnownPoints,
    PhotoFeatures,
    known_points,
    photo_features,
    resembling,
    votes,
)
from nerfcli.poses.model.projection import Array, is_ahead, offsets_px, projected
from nerfcli.poses.model.reasons import FEW_FEATURES, FEW_MATCHES, MIN_MATCHES
from nerfcli.poses.model.two_views import VerifiedPair, agreements, read_verified_pairs

Indices = NDArray[np.int64]

# A photo needs at least this many agreeing votes, and this many features found, to be placed.
_LEAST_VOTES = 10
_LEAST_FOUND = 25
# At offsets in eight directions from the predicted positions, in tolerances, at least `_CLEARLY` times fewer features
# must match.
_BESIDE = [(6.0, 9.0)[i % 2] * np.array([np.cos(i * np.pi / 4), np.sin(i * np.pi / 4)]) for i in range(8)]
_HERE = np.zeros(2)
_CLEARLY = 2.5
# Least fraction of the picture over which the found features must spread. A detail that merely resembles one elsewhere
# covers less.
_LEAST_AREA = 0.05
# Largest standard deviations of a pose: of its angles, and of its position relative to the distance of its points.
_MOST_TURN_DEG, _MOST_SHIFT = 0.5, 0.02


@dataclass(frozen=True)
class LocationAttempt:
    """Result of an attempt to locate a photo.

    votes: number of features that vote for a point. agreeing: votes that the pose explains. found: points found where
    the pose predicts them. beside: the largest number found where none should be. refused: why the photo was not
    placed, "" if it was.
    """

    image_id: int
    votes: int = 0
    agreeing: int = 0
    found: int = 0
    beside: int = 0
    refused: str = ""


@dataclass(frozen=True)
class _Placed:
    pose: pycolmap.Rigid3d
    features: Indices
    points: Indices


def locate_photos(
    model: pycolmap.Reconstruction,
    job: Job,
    *,
    image_ids: Sequence[int],
    report: Report = lambda stage, done, total: None,
) -> tuple[pycolmap.Reconstruction, list[LocationAttempt]]:
    """Return an adjusted copy of the model with the photos that can be located from its points, and the attempts.

    Photos that resemble the points of a newly placed one are tried again, so that chains of photos are followed. A
    photo is not kept if its verified matches with another photo, if there are enough of them, contradict its pose.

    `report` is called with ("locate", done, total), in trials, of which each photo may have several.
    """
    grown = pycolmap.Reconstruction(model)
    if model.num_points3D() < _LEAST_FOUND:
        why = "the model has too few points"
        return grown, [LocationAttempt(image_id, refused=why) for image_id in sorted(image_ids)]
    attempts: dict[int, LocationAttempt] = {}
    left = sorted(image_ids)
    files = dict(zip(job.image_ids, job.files, strict=True))
    with pycolmap.Database.open(job.database) as database, ThreadPoolExecutor(job.threads) as pool:
        rounds = 3  # a placed photo may make it possible to place others
        total = rounds * len(left)
        placed_before: list[int] = []
        for turn in range(rounds):
            model_points = known_points(grown, database)
            fresh = np.isin(model_points.photos, placed_before)
            photos = [photo_features(grown, database, image_id) for image_id in left]
            trial = partial(_try_to_place, model_points=model_points, fresh=fresh if turn > 0 else None, seed=job.seed)
            placed_now = []
            results = zip(left, photos, pool.map(trial, left, photos), strict=True)
            for number, (image_id, photo, (placed, attempt)) in enumerate(results):
                report("locate", turn * len(image_ids) + number, total)
                attempts[image_id] = attempt or attempts[image_id]
                if photo is None or placed is None:
                    continue
                place(grown, photo.camera, placed.pose, image_id=image_id, name=files[image_id], pixels=photo.pixels)
                for feature, point in zip(placed.features, model_points.ids[placed.points], strict=True):
                    grown.add_observation(int(point), pycolmap.TrackElement(image_id, int(feature)))
                placed_now.append(image_id)
            left = [image_id for image_id in left if image_id not in placed_now]
            if not left or not placed_now:
                break
            placed_before = placed_now
        report("locate", total, total)
    pairs = read_verified_pairs(job.database, min_matches=FEW_MATCHES)
    if any(not attempt.refused for attempt in attempts.values()):
        refine_model(grown, job.solver)
    for image_id in (image_id for image_id, attempt in attempts.items() if not attempt.refused):
        if doubt := _doubt(grown, image_id, pairs):
            grown.deregister_frame(grown.image(image_id).frame_id)
            attempts[image_id] = replace(attempts[image_id], refused=doubt)
    return grown, [attempts[image_id] for image_id in sorted(attempts)]


def left_out(model: pycolmap.Reconstruction, job: Job) -> list[int]:
    """Return the ids of images that a model does not place although they have enough features."""
    placed = set(model.reg_image_ids())
    with pycolmap.Database.open(job.database) as database:
        return [
            image_id
            for image_id in job.image_ids
            if image_id not in placed
            and database.num_keypoints_for_image(image_id) >= FEW_FEATURES
            and database.exists_descriptors(image_id)
        ]


def shared_pairs(model: pycolmap.Reconstruction, image_ids: Sequence[int], *, min_matches: int) -> list[VerifiedPair]:
    """Return the pairs of these photos with all others of a model, matched by the points that both see."""
    pixels: dict[tuple[int, int], list[tuple[Array, Array]]] = {}
    for image_id in image_ids:
        for seen in model.image(image_id).get_observation_points2D():
            for element in model.point3D(seen.point3D_id).track.elements:
                if element.image_id != image_id:
                    there = model.image(element.image_id).points2D[element.point2D_idx]
                    both = (seen.xy, there.xy) if image_id < element.image_id else (there.xy, seen.xy)
                    pair = min(image_id, element.image_id), max(image_id, element.image_id)
                    pixels.setdefault(pair, []).append(both)
    return [
        VerifiedPair(*pair, np.array([one for one, _ in both]), np.array([other for _, other in both]))
        for pair, both in sorted(pixels.items())
        if len(both) >= min_matches
    ]


def _doubt(model: pycolmap.Reconstruction, image_id: int, pairs: Sequence[VerifiedPair]) -> str:
    """Return the evidence against a photo's pose after the adjustment, "" if there is none."""
    observations = model.image(image_id).num_points3D
    if observations < MIN_MATCHES:
        return f"only {observations} of its points remain after the adjustment"
    own = [pair for pair in pairs if image_id in (pair.one, pair.other)]
    against = [agreement for agreement in agreements(model, own) if agreement.contradicts]
    return f"{against[0].matches} verified matches contradict its pose" if against else ""


def _try_to_place(
    image_id: int, photo: PhotoFeatures | None, *, model_points: KnownPoints, fresh: NDArray[np.bool_] | None, seed: int
) -> tuple[_Placed | None, LocationAttempt | None]:
    """Return a photo's pose, or None, and the record; None if it resembles too few of the points that are `fresh`."""
    if photo is None:
        return None, LocationAttempt(image_id, refused="its camera is unknown")
    if fresh is not None and resembling(photo, model_points.descriptors[fresh]) < _LEAST_VOTES:
        return None, None
    return _place(photo, model_points, seed=seed)


def _place(photo: PhotoFeatures, model_points: KnownPoints, *, seed: int) -> tuple[_Placed | None, LocationAttempt]:
    """Return a photo's pose with the points it sees, or None; and the record of the attempt."""
    features, points = votes(photo, model_points)
    first = _pose(photo, model_points, features, points, seed=seed)
    agreeing = 0 if first is None else len(first.features)
    attempt = LocationAttempt(photo.image_id, len(features), agreeing)

    def refused(why: str) -> tuple[None, LocationAttempt]:
        return None, replace(attempt, refused=why)

    if first is None or agreeing < _LEAST_VOTES:
        return refused(f"only {agreeing} of {len(features)} features agree on a pose")
    others = ~np.isin(features, first.features)
    second = _pose(photo, model_points, features[others], points[others], seed=seed)
    rivals = 0 if second is None or _alike(first, second, model_points) else len(second.features)
    if rivals >= agreeing / 2:
        return refused(f"{rivals} features agree on a different pose than the {agreeing} others")
    placed = first
    for within in (2.0, 1.0):  # in tolerances: larger at first, since the first pose is rough
        found = _pose(photo, model_points, *_expected(photo, model_points, placed.pose, within=within), seed=seed)
        if found is None:
            break
        placed = found
    count, *beside = (len(_expected(photo, model_points, placed.pose, beside=step)[0]) for step in (_HERE, *_BESIDE))
    attempt = replace(attempt, found=count, beside=max(beside))
    if count < _LEAST_FOUND or count < _CLEARLY * max(beside):
        return refused(f"{count} features match the expected positions, but {max(beside)} match wrong ones by chance")
    area = _area(photo, placed.features)
    if area < _LEAST_AREA:
        return refused(f"only {100 * area:.0f} % of the picture agrees with the model")
    turn_deg, shift = _deviations(photo, model_points, placed)
    if turn_deg > _MOST_TURN_DEG or shift > _MOST_SHIFT:
        return refused(f"its position is uncertain by {100 * shift:.1f} % of the distance")
    return placed, attempt


def _pose(
    photo: PhotoFeatures, model_points: KnownPoints, features: Indices, points: Indices, *, seed: int
) -> _Placed | None:
    """Return the pose that most of the features agree on, with these features."""
    if len(features) < _LEAST_VOTES:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions(
        ransac={"max_error": photo.tolerance_px, "random_seed": seed, "max_num_trials": 40_000, "confidence": 0.9999}
    )
    found = pycolmap.estimate_and_refine_absolute_pose(
        photo.pixels[features], model_points.places[points], photo.camera, estimation_options=options
    )
    if found is None:
        return None
    inliers = np.asarray(found["inlier_mask"], dtype=bool)
    return _Placed(found["cam_from_world"], features[inliers], points[inliers])


def _expected(
    photo: PhotoFeatures,
    model_points: KnownPoints,
    pose: pycolmap.Rigid3d,
    *,
    within: float = 1.0,
    beside: Array = _HERE,
) -> tuple[Indices, Indices]:
    """Return the features that look like the points that a pose predicts there, and these points.

    within: search radius. beside: offset of the search from the predicted positions. Both are in tolerances.
    """
    local = model_points.places @ pose.rotation.matrix().T + pose.translation
    pixels = np.full((len(local), 2), np.nan)
    ahead = is_ahead(photo.camera, local)
    pixels[ahead] = projected(photo.camera, local[ahead])
    pixels += photo.tolerance_px * beside
    with np.errstate(invalid="ignore"):
        seen = np.flatnonzero(np.all((pixels >= 0) & (pixels < (photo.camera.width, photo.camera.height)), axis=1))
    found = KDTree(photo.pixels).query_ball_point(pixels[seen], within * photo.tolerance_px)
    near = {int(point): features for point, features in zip(seen, found, strict=True) if features}
    looks = np.flatnonzero(np.isin(model_points.of, np.array(list(near), dtype=np.int64)))
    features = np.array([feature for point in model_points.of[looks] for feature in near[int(point)]], dtype=np.int64)
    looks = np.repeat(looks, np.array([len(near[int(point)]) for point in model_points.of[looks]], dtype=np.int64))
    distances = np.empty(len(features))
    for start in range(0, len(features), BLOCK * 64):
        rows = slice(start, start + BLOCK * 64)
        cosines = np.einsum("ij,ij->i", photo.descriptors[features[rows]], model_points.descriptors[looks[rows]])
        distances[rows] = np.sqrt(np.maximum(2 - 2 * cosines, 0))
    points = model_points.of[looks]
    order = np.argsort(distances, kind="stable")
    order = order[distances[order] < ALIKE]
    for ids in (points, features):  # the most similar feature of each point, and the reverse
        _, first = np.unique(ids[order], return_index=True)
        order = order[np.sort(first)]
    return features[order], points[order]


def _area(photo: PhotoFeatures, features: Indices) -> float:
    """Return the fraction of the picture that the features cover, as an ellipse of their spread."""
    spread = np.sqrt(max(np.linalg.det(np.cov(photo.pixels[features].T)), 0.0))
    return float(4 * np.pi * spread / (photo.camera.width * photo.camera.height))


def _alike(one: _Placed, other: _Placed, model_points: KnownPoints) -> bool:
    """Return whether two poses are the same except for noise."""
    turned = np.degrees((one.pose.rotation * other.pose.rotation.inverse()).angle())
    places = [np.asarray(placed.pose.inverse().translation) for placed in (one, other)]
    distance = np.median(np.linalg.norm(model_points.places[one.points] - places[0], axis=1))
    return bool(turned < 5 and np.linalg.norm(places[0] - places[1]) < 0.1 * distance)


def _deviations(photo: PhotoFeatures, model_points: KnownPoints, placed: _Placed) -> tuple[float, float]:
    """Return the standard deviations of a pose: angles in degrees, position relative to the distance of its points."""
    refined = pycolmap.refine_absolute_pose(
        placed.pose,
        photo.pixels[placed.features],
        model_points.places[placed.points],
        np.ones(len(placed.features), dtype=bool),
        photo.camera,
        return_covariance=True,
    )
    if refined is None:
        return np.inf, np.inf
    pose = refined["cam_from_world"]
    local = model_points.places[placed.points] @ pose.rotation.matrix().T + pose.translation
    noise_px = np.sqrt(np.mean(offsets_px(photo.camera, local, photo.pixels[placed.features]) ** 2))
    spread = np.sqrt(np.maximum(np.diag(refined["covariance"]), 0)) * noise_px  # three of angles, three of translation
    distance = np.median(np.linalg.norm(local, axis=1))
    return float(np.degrees(spread[:3].max())), float(spread[3:].max() / distance)


def place(
    model: pycolmap.Reconstruction,
    camera: pycolmap.Camera,
    cam_from_world: pycolmap.Rigid3d,
    *,
    image_id: int,
    name: str,
    pixels: Array,
) -> None:
    """Give a photo a pose in a model, and add it, with its camera and its features at `pixels` (n, 2), if it is new."""
    if not model.exists_camera(camera.camera_id):
        model.add_camera_with_trivial_rig(camera)
    if model.exists_image(image_id):
        frame = model.frame(model.image(image_id).frame_id)
        frame.rig_from_world = cam_from_world
        model.register_frame(frame.frame_id)
    else:
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=camera.camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(image, cam_from_world)


def pixels_of(image: pycolmap.Image) -> Array:
    """Return the pixels of all features of a photo in a model, (n, 2)."""
    return np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
