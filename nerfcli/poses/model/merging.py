"""Merge sub-models that see the same points.

A mapper that can add no more photos starts again elsewhere, and leaves models that each have their own frame. Matches
between photos of two models give pairs of points, if both features belong to a point of their model; a similarity that
aligns many of these pairs joins the models.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
from numpy.typing import NDArray

from nerfcli.cameras.alignment import align as similarity
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import duration
from nerfcli.poses.input.job import Job, Report, Tell
from nerfcli.poses.model import held_out
from nerfcli.poses.model.held_out import MAPPER
from nerfcli.poses.model.intrinsics import refine_model
from nerfcli.poses.model.locate import pixels_of, place
from nerfcli.poses.model.projection import Array, is_ahead, offsets_px
from nerfcli.poses.model.reasons import MIN_MATCHES
from nerfcli.poses.model.two_views import VerifiedPair, agreements, count_matches, read_verified_pairs

# Until all models are merged, adjustments end at this relative change of the cost; then there are so many rounds of
# triangulation.
_TOLERANCE, _REFINEMENTS = 1e-4, 2


# A model, and the similarity that moves it into the frame of another.
_Aligned = tuple[pycolmap.Reconstruction, pycolmap.Sim3d]


@dataclass(frozen=True)
class CommonPoints:
    """Points that both of two models contain: (n, 3) in each, with pixels (n, 2) in photos (n,) of the first."""

    first: Array
    second: Array
    photos: NDArray[np.int64]
    pixels: Array


def merge_models(
    models: Sequence[pycolmap.Reconstruction],
    job: Job,
    *,
    seconds: float = math.inf,
    report: Report = lambda stage, done, total: None,
    tell: Tell = lambda text: None,
) -> list[pycolmap.Reconstruction]:
    """Return the models, largest first, each merged with those smaller ones that have enough in common with it.

    All that align with a model are merged with it at once. If all photos of a model are in a larger one, it is dropped.

    Args:
        models: of the job's database, largest first; they are not changed.
        seconds: time after which the remaining models are not merged; `tell` then receives how many are left.
        report: called with ("merge", models done, models in all).
    """
    pairs = read_verified_pairs(job.database, min_matches=1)
    tracks = _matched_keypoints(job.database)
    with pycolmap.Database.open(job.database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions(min_num_matches=MIN_MATCHES))
    join = partial(_join, job=job, cache=cache, pairs=pairs)
    merged: list[pycolmap.Reconstruction] = []
    left = list(models)
    start = time.perf_counter()
    while left:
        base, left = left[0], left[1:]
        grows = True
        while grows:
            known = set(base.reg_image_ids())
            left = [model for model in left if not known.issuperset(model.reg_image_ids())]
            report("merge", len(models) - len(left) - 1, len(models))
            if time.perf_counter() - start > seconds:
                tell(f"merging: {len(left)} of {len(models)} sub-models are left after {duration(seconds)}")
                return _largest_first([*merged, base, *left])
            similarities = [align(base, common_points(base, model, tracks), seed=job.seed) for model in left]
            aligned = [(model, s) for model, s in zip(left, similarities, strict=True) if s is not None]
            base, taken = join(base, aligned)
            left = [model for model in left if not any(model is one for one, _ in taken)]
            grows = bool(taken)
        if not any(base is model for model in models):
            base = _triangulated_again(base, job)
        merged.append(base)
    report("merge", len(models), len(models))
    return _largest_first(merged)


def common_points(
    first: pycolmap.Reconstruction, second: pycolmap.Reconstruction, tracks: dict[tuple[int, int], NDArray[np.int64]]
) -> CommonPoints:
    """Find common points of two models: points of common photos, and points connected by matches.

    tracks: by pair of image ids, (matches, 2) numbers of the matching features.
    """
    pairs: set[tuple[int, int, int, int]] = set()  # point in first, point in second, photo of first, its feature
    in_first, in_second = set(first.reg_image_ids()), set(second.reg_image_ids())
    for photo in in_first & in_second:
        for index, point in enumerate(first.image(photo).points2D):
            twin = second.image(photo).points2D[index]
            if point.has_point3D() and twin.has_point3D():
                pairs.add((point.point3D_id, twin.point3D_id, photo, index))
    for (one, other), matches in tracks.items():
        for photo, partner, columns in ((one, other, matches), (other, one, matches[:, ::-1])):
            if photo not in in_first or partner not in in_second:
                continue
            here, there = first.image(photo).points2D, second.image(partner).points2D
            for index, twin_index in columns:
                if here[int(index)].has_point3D() and there[int(twin_index)].has_point3D():
                    pairs.add((here[int(index)].point3D_id, there[int(twin_index)].point3D_id, photo, int(index)))
    ordered = sorted(pairs)
    return CommonPoints(
        np.array([first.point3D(a).xyz for a, _, _, _ in ordered]).reshape(-1, 3),
        np.array([second.point3D(b).xyz for _, b, _, _ in ordered]).reshape(-1, 3),
        np.array([photo for _, _, photo, _ in ordered], dtype=np.int64),
        np.array([first.image(photo).points2D[index].xy for _, _, photo, index in ordered]).reshape(-1, 2),
    )


def align(first: pycolmap.Reconstruction, common: CommonPoints, *, seed: int) -> pycolmap.Sim3d | None:
    """Return first_from_second, which moves most points to where the first's photos see them; None for too few."""
    count = len(common.first)
    if count < MIN_MATCHES:
        return None
    rng = np.random.default_rng(seed)
    best = np.zeros(count, dtype=bool)
    rows_of = {int(photo): np.flatnonzero(common.photos == photo) for photo in np.unique(common.photos)}
    for _ in range(500):
        sample = rng.choice(count, 3, replace=False)
        if not np.ptp(common.second[sample], axis=0).any():  # one point, seen in three photos
            continue
        fits = _fits(first, common, rows_of, similarity(common.second[sample], common.first[sample]))
        if fits.sum() > best.sum():
            best = fits
    if best.sum() < MIN_MATCHES:
        return None
    found = similarity(common.second[best], common.first[best])
    return pycolmap.Sim3d(found.scale, pycolmap.Rotation3d(found.rotation), found.translation)


def _fits(
    first: pycolmap.Reconstruction,
    common: CommonPoints,
    rows_of: Mapping[int, NDArray[np.int64]],
    first_from_second: Similarity,
) -> NDArray[np.bool_]:
    moved = first_from_second.apply(common.second)
    fits = np.zeros(len(moved), dtype=bool)
    for photo, rows in rows_of.items():
        image = first.image(photo)
        pose = image.cam_from_world()
        local = moved[rows] @ pose.rotation.matrix().T + pose.translation
        camera = first.camera(image.camera_id)
        distances = np.linalg.norm(offsets_px(camera, local, common.pixels[rows]), axis=1)
        fits[rows] = is_ahead(camera, local) & (distances < MAPPER.abs_pose_max_error)  # NaN is not smaller
    return fits


def _join(
    base: pycolmap.Reconstruction,
    aligned: Sequence[_Aligned],
    *,
    job: Job,
    cache: pycolmap.DatabaseCache,
    pairs: Sequence[VerifiedPair],
) -> tuple[pycolmap.Reconstruction, Sequence[_Aligned]]:
    """Return the base with the photos of all models that agree with it, in its frame, and these models.

    While the matches of a model with the others disagree with the joined one, the worst is left out.
    """
    while aligned:
        joined = pycolmap.Reconstruction(base)
        owners = dict.fromkeys(base.reg_image_ids(), -1)
        for number, (model, base_from_model) in enumerate(aligned):
            moved = pycolmap.Reconstruction(model)
            moved.transform(base_from_model)
            owners = dict.fromkeys(moved.reg_image_ids(), number) | owners
            _add(joined, moved, {photo for photo, owner in owners.items() if owner == number})
        _merge_tracks(joined, cache, seed=job.seed)
        held_out.adjust(joined, job.solver, tolerance=_TOLERANCE)
        held_out.drop_misfits(joined)
        agreeing = [
            _agreeing_fraction(joined, {photo for photo, owner in owners.items() if owner == number}, pairs)
            for number in range(len(aligned))
        ]
        worst = int(np.argmin(agreeing))
        if agreeing[worst] > 1 / 2:
            return joined, aligned
        aligned = [one for number, one in enumerate(aligned) if number != worst]
    return base, aligned


def _add(joined: pycolmap.Reconstruction, model: pycolmap.Reconstruction, photos: set[int]) -> None:
    """Add these photos of a model in the same frame, and the points that at least two of them see."""
    for photo in sorted(photos):
        image = model.image(photo)
        camera = model.camera(image.camera_id)
        place(joined, camera, image.cam_from_world(), image_id=photo, name=image.name, pixels=pixels_of(image))
    for point in model.points3D.values():
        seen = [element for element in point.track.elements if element.image_id in photos]
        if len(seen) > 1:
            joined.add_point3D(point.xyz, pycolmap.Track(seen))


def _merge_tracks(model: pycolmap.Reconstruction, cache: pycolmap.DatabaseCache, *, seed: int) -> None:
    """Join points that matches connect, and add observations to points, in place."""
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    mapper.complete_and_merge_tracks(pycolmap.IncrementalTriangulatorOptions(random_seed=seed))
    mapper.end_reconstruction(discard=False)


def _triangulated_again(model: pycolmap.Reconstruction, job: Job) -> pycolmap.Reconstruction:
    """Return the model with points from all matches, adjusted until it converges."""
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads, random_seed=job.seed, extract_colors=False, ba_global_max_refinements=_REFINEMENTS
    )
    options.mapper.random_seed = options.triangulation.random_seed = job.seed
    free = not job.solver.fixed
    with TemporaryDirectory(dir=job.folder, prefix="merger-") as output:
        model = pycolmap.triangulate_points(
            model, job.database, output, output, clear_points=True, options=options, refine_intrinsics=free
        )
    refine_model(model, job.solver)
    return model


def _agreeing_fraction(model: pycolmap.Reconstruction, photos: set[int], pairs: Sequence[VerifiedPair]) -> float:
    """Return the fraction of the matches between these photos and the others that agree with the model; 0 for none."""
    between = [pair for pair in pairs if (pair.one in photos) != (pair.other in photos)]
    found = agreements(model, between)
    return sum(a.matches * a.fraction for a in found) / max(sum(a.matches for a in found), 1)


def _largest_first(models: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    return sorted(models, key=lambda model: -model.num_reg_images())


def _matched_keypoints(database: Path) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Return, by pair of image ids, the (matches, 2) feature numbers of the verified matches."""
    with pycolmap.Database.open(database) as opened:
        return {
            (one, other): np.asarray(opened.read_two_view_geometry(one, other).inlier_matches, dtype=np.int64)
            for one, other, count in count_matches(database)
            if count
        }
