"""Compare verified pairs of photos with the poses of a model.

The verified matches of a pair do not depend on the mapper. A wrong model has small residuals because it has discarded
the observations that contradict it; they are still in the database, and are tested here.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from nerfcli.matching.agreement import Agreement, agreement
from nerfcli.poses.input.job import Solver
from nerfcli.poses.model.held_out import MOST_ERROR_PX
from nerfcli.poses.model.projection import Array, panorama_camera, px_per_radian

# Below this median angle between the rays of a match, the relative pose of a pair is too weak to contradict anything.
LEAST_ANGLE_DEG = 2.0
# Matches are verified within MOST_ERROR_PX; a model that fits more than the pair may leave twice that.
_MOST_PX = 2 * MOST_ERROR_PX
# A relative rotation is estimated from this many matches of a pair: more make it no better than 10 degrees need.
_MOST_FOR_ROTATION = 400


@dataclass(frozen=True)
class VerifiedPair:
    """Two photos by their image ids, and the pixels (matches, 2) in each that two-view geometry verified as matches."""

    one: int
    other: int
    pixels_one: Array
    pixels_other: Array

    @property
    def matches(self) -> int:
        """Number of matches."""
        return len(self.pixels_one)


@dataclass(frozen=True)
class PairAgreement:
    """Agreement of a pair's matches with the poses of a model.

    matches: how many can be judged. fraction: of them within 8 px of the epipolar line and in front
    of both cameras, or with rays that are parallel within the tolerance, as for a far point whatever the baseline.
    angle_deg: the median angle between the rays of a match.
    """

    one: int
    other: int
    matches: int
    fraction: float
    angle_deg: float

    @property
    def contradicts(self) -> bool:
        """True if most of the pair's matches are inconsistent with the model."""
        return self.fraction < 0.5


def count_matches(database: Path) -> list[tuple[int, int, int]]:
    """Return (image id, image id, verified matches) of all pairs in a database, in ascending order."""
    with pycolmap.Database.open(database) as opened:
        pair_ids, counts = opened.read_two_view_geometry_num_inliers()
    counted = zip(pair_ids, counts, strict=True)
    return sorted((*pycolmap.pair_id_to_image_pair(pair_id), count) for pair_id, count in counted)


def read_verified_pairs(database: Path, *, min_matches: int) -> list[VerifiedPair]:
    """Read the pairs with at least `min_matches` verified matches, by image ids."""
    strong = [(one, other) for one, other, count in count_matches(database) if count >= min_matches]
    with pycolmap.Database.open(database) as opened:
        pixels = {
            image_id: np.asarray(opened.read_keypoints(image_id), dtype=np.float64)[:, :2]
            for image_id in {image_id for pair in strong for image_id in pair}
        }
        pairs = []
        for one, other in strong:
            matches = np.asarray(opened.read_two_view_geometry(one, other).inlier_matches, dtype=np.int64)
            pairs.append(VerifiedPair(one, other, pixels[one][matches[:, 0]], pixels[other][matches[:, 1]]))
    return pairs


def placed_pairs(model: pycolmap.Reconstruction, pairs: Iterable[VerifiedPair]) -> list[VerifiedPair]:
    """Return the pairs with both photos in a model."""
    placed = set(model.reg_image_ids())
    return [pair for pair in pairs if pair.one in placed and pair.other in placed]


def agreements(model: pycolmap.Reconstruction, pairs: Iterable[VerifiedPair]) -> list[PairAgreement]:
    """Compare each pair's matches with the model's poses and intrinsics; pairs without a finite ray are left out."""
    found = []
    for pair in placed_pairs(model, pairs):
        seen = compared(_cameras(model, pair), (pair.pixels_one, pair.pixels_other), _other_from_one(model, pair))
        judged = np.isfinite(seen.parallax)
        if not judged.any():
            continue
        angle_deg = float(np.degrees(np.median(seen.parallax[judged])))
        found.append(PairAgreement(pair.one, pair.other, seen.count, fitting(seen), angle_deg))
    return found


def fitting(seen: Agreement) -> float:
    """Return the fraction of the matches with two rays that fit, see `PairAgreement`; there are some."""
    # Noise decides on which side of the cameras nearly parallel rays meet.
    fits = (seen.parallax_px < _MOST_PX) | ((np.abs(seen.line_px) < _MOST_PX) & ~seen.behind)
    return float(fits[np.isfinite(seen.parallax)].mean())


def rays(camera: pycolmap.Camera, pixels: Array) -> Array:
    """Return unit rays (n, 3) in the camera's axes; NaN where the lens model cannot be inverted."""
    found = np.asarray(camera.cam_ray_from_img(pixels), dtype=np.float64).reshape(-1, 3)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@dataclass(frozen=True)
class RotationError:
    """The angle between a pair's own relative rotation and the model's, degrees; weight: the number of its inliers."""

    degrees: float
    weight: int


def rotation_errors(
    model: pycolmap.Reconstruction, pairs: Sequence[VerifiedPair], solver: Solver = Solver()
) -> list[RotationError]:
    """Compare relative rotations from the matches of two photos alone, with the model's intrinsics, with the model's.

    Only the pairs with the most matches of each photo are used, and only if they have parallax: without it, the
    five-point algorithm may turn a camera around.
    """
    chosen = strongest(placed_pairs(model, pairs), per_photo=4)
    with ThreadPoolExecutor(solver.threads) as pool:
        errors = pool.map(partial(_rotation_error, model, seed=solver.seed), chosen)
        return [error for error in errors if error is not None]


def _rotation_error(model: pycolmap.Reconstruction, pair: VerifiedPair, *, seed: int) -> RotationError | None:
    """Compare a pair's own relative rotation with the model's; None without one, or without parallax."""
    cameras = _cameras(model, pair)
    step = max(1, pair.matches // _MOST_FOR_ROTATION)
    one, other = pair.pixels_one[::step], pair.pixels_other[::step]
    found = own_pose(cameras, (one, other), seed=seed)
    if found is None:
        return None
    own, inliers = found
    parallax = compared(cameras, (one[inliers], other[inliers]), own).parallax
    if not len(parallax) or np.degrees(np.nanmedian(parallax)) < LEAST_ANGLE_DEG:
        return None
    degrees = float(np.degrees((own.rotation * _other_from_one(model, pair).rotation.inverse()).angle()))
    return RotationError(degrees, step * int(inliers.sum()))


def own_pose(
    cameras: tuple[pycolmap.Camera, pycolmap.Camera], pixels: tuple[Array, Array], *, seed: int
) -> tuple[pycolmap.Rigid3d, NDArray[np.bool_]] | None:
    """Estimate the transform from the first camera to the second from verified matches alone, and say which agree."""
    # Few trials are enough for these, and pycolmap's own number takes ten times as long.
    options = pycolmap.RANSACOptions(max_error=MOST_ERROR_PX, min_num_trials=50, max_num_trials=500, random_seed=seed)
    found = pycolmap.estimate_relative_pose(cameras[0], pixels[0], cameras[1], pixels[1], options=options)
    return None if found is None else (found["cam2_from_cam1"], np.asarray(found["inlier_mask"], dtype=bool))


def panorama_inliers(
    pixels_one: Array, pixels_other: Array, sizes: tuple[tuple[int, int], tuple[int, int]], *, within_px: float
) -> NDArray[np.bool_]:
    """Return which matches (n, 2) of two panoramas of these (width, height) agree on one motion of the camera."""
    if not len(pixels_one):
        return np.zeros(0, dtype=bool)
    options = pycolmap.RANSACOptions(max_error=within_px, random_seed=0)
    found = pycolmap.estimate_relative_pose(
        panorama_camera(sizes[0]), pixels_one, panorama_camera(sizes[1]), pixels_other, options=options
    )
    return np.zeros(len(pixels_one), dtype=bool) if found is None else np.asarray(found["inlier_mask"], dtype=bool)


def strongest(pairs: Sequence[VerifiedPair], *, per_photo: int) -> list[VerifiedPair]:
    """Return the pairs that are, for one of their photos, among the `per_photo` with the most matches."""
    taken: Counter[int] = Counter()
    kept = []
    for pair in sorted(pairs, key=lambda pair: (-pair.matches, pair.one, pair.other)):
        if min(taken[pair.one], taken[pair.other]) < per_photo:
            kept.append(pair)
            taken.update((pair.one, pair.other))
    return kept


def compared(
    cameras: tuple[pycolmap.Camera, pycolmap.Camera], pixels: tuple[Array, Array], other_from_one: pycolmap.Rigid3d
) -> Agreement:
    """Measure how the matches (n, 2) of two photos agree with a relative pose."""
    one, other = (rays(camera, places) for camera, places in zip(cameras, pixels, strict=True))
    focal_px = 0.5 * sum(px_per_radian(camera) for camera in cameras)
    return agreement(one, other, other_from_one.matrix(), focal_px=focal_px)


def _cameras(model: pycolmap.Reconstruction, pair: VerifiedPair) -> tuple[pycolmap.Camera, pycolmap.Camera]:
    return model.camera(model.image(pair.one).camera_id), model.camera(model.image(pair.other).camera_id)


def _other_from_one(model: pycolmap.Reconstruction, pair: VerifiedPair) -> pycolmap.Rigid3d:
    """Return the transform from the axes of a pair's first camera to those of its second."""
    return model.image(pair.other).cam_from_world() * model.image(pair.one).cam_from_world().inverse()
