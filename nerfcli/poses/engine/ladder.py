"""Mapping attempts, each costlier than the one before, until enough photos are placed.

Every attempt is recorded with its result. The first ones use the same matches in other ways; the last ones add matches
and features.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pycolmap

from nerfcli.errors import duration
from nerfcli.matching.graph import connected_groups
from nerfcli.poses.engine.database import evidence, register_photos
from nerfcli.poses.engine.features import extract, feature_counts, match, start_matching
from nerfcli.poses.engine.initial_focal import with_focal_lengths
from nerfcli.poses.engine.mapped import MappedModels
from nerfcli.poses.engine.mapping import MapperOptions, map_photos, mapper_limit_seconds
from nerfcli.poses.input.job import Job, Report, Tell
from nerfcli.poses.input.pairs import ALL_ALIKE_UP_TO, all_pairs
from nerfcli.poses.input.plan import extraction_seconds, mapping_seconds, matching_seconds
from nerfcli.poses.input.settings import FULL_SIZE, QUALITIES
from nerfcli.poses.judge.parallax import best_rotation_fit
from nerfcli.poses.model.intrinsics import FISHEYE_FROM_DEG, field_of_view_deg
from nerfcli.poses.model.lens_evidence import lenses_of
from nerfcli.poses.model.lens_family import as_fisheye
from nerfcli.poses.model.localise import left_out, localise
from nerfcli.poses.model.merging import merge_models
from nerfcli.poses.model.reasons import FEW_FEATURES, FEW_MATCHES
from nerfcli.poses.model.two_views import count_matches, read_verified_pairs

# Registered fraction below which mapping is tried again; if only a photo or two are missing, they are often at fault.
_GOOD_FRACTION = 0.9
# Below this registered fraction, several times the work done so far is worthwhile.
_FEW_FRACTION = 0.75
# From this many photos, mapping from scratch takes a minute and more, which is not worth it for a few photos.
_MANY_PHOTOS = 250
# With more photos, comparing every pair, or searching full-size photos, takes longer than taking better photos.
_MOST_FOR_ALL = 150
# Searching larger pictures may take this many times as long as the first search, times the fraction of missing photos.
_MOST_FOR_MORE = 5.0
# A focal length that differs from EXIF's by more than this factor (its logarithm) is reported.
_FAR_FROM_EXIF = 0.1
# Each single photo takes some seconds; if more than this are missing, the problem is not one of single photos.
_MOST_SINGLE_PHOTOS = 60

SMALLER_BASELINE = MapperOptions(init_min_tri_angle=8.0, init_min_num_inliers=50)
LOW_ANGLES = MapperOptions(
    init_min_tri_angle=3.0, init_min_num_inliers=30, filter_min_tri_angle=0.5, init_max_forward_motion=1.0
)


class _Ladder:
    def __init__(self, job: Job, report: Report, tell: Tell) -> None:
        self.best = MappedModels([], job, [])
        self.rungs: list[dict[str, Any]] = []
        self.report = report
        self.tell = tell
        self._photos = len(job.files)
        self._results_reported = 0
        self._announced = ""
        self._cut_short: list[str] = []
        self._start = time.perf_counter()
        self._is_over = False

    def has_time(self) -> bool:
        """Return whether there is time for another attempt; the first time there is none, tell the user."""
        most = 2 * mapper_limit_seconds(self._photos)
        if not self._is_over and time.perf_counter() - self._start > most:
            self._is_over = True
            self._cut(f"no further attempts to place photos after {duration(most)}")
        return not self._is_over

    def announce(self, what: str, *, takes: float = 0.0) -> None:
        """Report the results so far and, once, what comes next."""
        self.tell_results()
        if what != self._announced:
            longer = f" (takes about {takes:.1f} times as long as the first features and matches)" if takes else ""
            self.tell(f"next: {what}{longer}")
        self._announced = what

    def tell_results(self) -> None:
        """Report the results that have not been reported yet."""
        for rung in self.rungs[self._results_reported :]:
            largest, *others = rung["models"] or ["none"]
            also = f" (and {len(others)} smaller models)" if len(others) > 1 else f" + {others[0]}" if others else ""
            self.tell(f"{rung['what']}: {largest}{also} of {self._photos} photos registered")
        self._results_reported = len(self.rungs)

    def attempt(self, what: str, job: Job, start: MapperOptions) -> None:
        """Map once; the result counts if it places more photos than the best so far."""
        if self.rungs:
            if not self.has_time():
                return
            self.announce(what)
        number = len(self.rungs)
        models = self._map(what, job, start)
        self._take(what, models, job)
        if len(models) > 1:
            output = Path(job.folder) / f"merged_{number}"
            merged = merge_models(
                models,
                job.database,
                output=output,
                seed=job.seed,
                threads=job.threads,
                fixed=job.fixed_cameras,
                seconds=mapper_limit_seconds(self._photos),
                report=self.report,
                tell=self._cut,
            )
            if _placed(merged) > _placed(models):
                self._take("sub-models merged", merged, job)

    def attempt_instead(self, what: str, job: Job, start: MapperOptions) -> None:
        """Map once; the result replaces the best so far, from another initial lens, if it places as many photos."""
        best = self.best
        self.best = MappedModels([], job, [])
        self.attempt(what, job, start)
        if _placed(self.best.models) < _placed(best.models):
            self.best = best

    def is_wide(self) -> bool:
        """Return whether a camera of the best model has such a wide field of view that it may be a fisheye."""
        return any(
            field_of_view_deg(model.camera(camera_id)) > FISHEYE_FROM_DEG
            for model in self.best.models[:1]
            for camera_id in set(lenses_of(model).values())
        )

    def go_on(self, what: str, start: MapperOptions) -> None:
        """Try to extend the best model to the remaining photos."""
        models, job = self.best.models, self.best.job
        if not models or not self.has_time():
            return
        self.announce(what)
        grown = self._map(what, job, start, base=models[0])
        if grown:
            self._take(what, [grown[0], *models[1:]], job)

    def find_left_out(self) -> None:
        """Locate remaining photos one by one from the 3D points they see."""
        what = "remaining photos one by one, from the 3D points they see"
        models, job = self.best.models, self.best.job
        if not models:
            return
        left = left_out(models[0], job)
        if not 0 < len(left) <= _MOST_SINGLE_PHOTOS:
            return
        self.announce(what)
        grown, attempts = localise(models[0], job, image_ids=left, report=self.report)
        placed = tuple(attempt.image_id for attempt in attempts if not attempt.refused)
        names = dict(zip(job.image_ids, job.names, strict=True))
        found = [{"name": names[one.image_id], **asdict(one)} for one in attempts]
        rest = [model for model in models[1:] if not set(model.reg_image_ids()) <= set(grown.reg_image_ids())]
        self._take(what, [grown, *rest], job)
        self.rungs[-1]["photos"] = found
        if placed:
            self.best = replace(self.best, localised=placed)

    def match(self, job: Job, pairs: Sequence[tuple[int, int]]) -> None:
        """Match pairs of photos, and remember if that was cut short."""
        unmatched = match(job, pairs, self.report)
        if unmatched is not None:
            self._cut(unmatched)

    def verify(self, job: Job) -> None:
        """Verify the matches of a job again, as far as they were verified with other lenses."""
        register_photos(job)
        self.match(job, job.pairs)

    def result(self) -> MappedModels:
        """Return the best models with the record of all attempts."""
        return replace(self.best, attempts=self.rungs, cut_short=tuple(self._cut_short))

    def _map(
        self, what: str, job: Job, start: MapperOptions, *, base: pycolmap.Reconstruction | None = None
    ) -> list[pycolmap.Reconstruction]:
        def cut(seconds: float) -> None:
            self._cut(f"{what}: stopped after {duration(seconds)} without another photo")

        return map_photos(job, self.report, attempt=len(self.rungs), start=start, base=base, stalled=cut)

    def _cut(self, what: str) -> None:
        self.tell(f"cut short: {what}")
        self._cut_short.append(what)

    def _take(self, what: str, models: list[pycolmap.Reconstruction], job: Job) -> None:
        self.rungs.append({"what": what, "models": [model.num_reg_images() for model in models]})
        if _placed(models) > _placed(self.best.models):
            self.best = MappedModels(models, job, self.rungs)

    def fraction(self, candidates: int) -> float:
        """Return the best model's number of photos as a fraction of `candidates`, the number that could register."""
        return _placed(self.best.models) / max(candidates, 1)


def climb(job: Job, report: Report, tell: Tell = lambda text: None) -> MappedModels:
    """Map a job's photos, with as many attempts as it takes.

    The first attempt has pycolmap's own thresholds, and starts from focal lengths estimated from pairs of photos where
    EXIF has no reliable one. If it leaves out photos of a small capture, the pairs that do not look alike are matched
    too. If it places less than half of the photos with a focal length from EXIF, the next one starts without it. If its
    lens came out wide or it leaves out many photos, the next one starts from a fisheye, provided that pairs of photos
    confirm one. If photos that match some other one well are still left out, the next ones start from a pair with a
    smaller baseline, from the strongest pair that was left out, and with low angles; with many photos, only if a
    quarter is left out. Then the remaining pairs are matched, and more features are extracted from the full-size
    photos. Last, single photos are located from the points that they show (see `localise`). If the camera only turned,
    nothing more is tried; nor is it after twenty times the planned time, four minutes at least. If the first attempt is
    not the last, `tell` receives each attempt and its result.
    """
    job = given = with_focal_lengths(job, tell)
    ladder = _Ladder(job, report, tell)
    ladder.attempt("default thresholds", job, MapperOptions())
    featured = sum(photo["features"] >= FEW_FEATURES for photo in evidence(job))
    if ladder.fraction(featured) < _GOOD_FRACTION and _only_turns(job):
        ladder.tell_results()
        tell("not trying anything else: the camera turned on the spot")
        return ladder.result()
    if len(job.files) <= ALL_ALIKE_UP_TO and ladder.fraction(featured) < _GOOD_FRACTION:
        job = _with_all_pairs(ladder, job)
    job = _without_exif(ladder, job, fraction=ladder.fraction(featured))
    job = _with_fisheye(ladder, job, fraction=ladder.fraction(featured))
    _other_starts(ladder, job)
    few_more = len(job.pairs) < math.comb(len(job.files), 2) and len(job.files) <= _MOST_FOR_ALL
    if few_more and ladder.fraction(featured) < _GOOD_FRACTION and ladder.has_time():
        job = _with_all_pairs(ladder, job)
        ladder.attempt("match all pairs", job, SMALLER_BASELINE)
    if _can_have_more_features(job) and ladder.fraction(featured) < _FEW_FRACTION and ladder.has_time():
        _with_more_features(ladder, job, missing=1 - ladder.fraction(featured))
    ladder.find_left_out()
    if len(ladder.rungs) > 1:
        ladder.tell_results()
    _tell_of_exif(given, ladder.best, tell)
    return ladder.result()


def _tell_of_exif(given: Job, best: MappedModels, tell: Tell) -> None:
    """Tell the user where the resulting focal length differs from EXIF's, which was not used.

    Photos of a camera that moves straight ahead determine the focal length poorly.
    """
    for number, (group, used) in enumerate(zip(given.groups, best.job.groups, strict=True), start=1):
        if group.focal_px is None or used.focal_px is not None or not best.models:
            continue
        if number not in best.models[0].cameras:  # none of its photos are registered
            continue
        found_px = best.models[0].camera(number).mean_focal_length()
        if abs(math.log(found_px / group.focal_px)) > _FAR_FROM_EXIF:
            tell(
                f"EXIF's focal length ({group.focal_px:.0f} px) was not used, since few photos registered with it; the "
                f"photos give {found_px:.0f} px: if EXIF is right, give --intrinsics"
            )


def _only_turns(job: Job) -> bool:
    """Return whether rotations of the camera explain all matches, so that no attempt can give an accepted model."""
    turn = best_rotation_fit(read_verified_pairs(job.database, min_matches=FEW_MATCHES), job.sizes)
    return turn is not None and turn.explains_all


def _with_all_pairs(ladder: _Ladder, job: Job) -> Job:
    """Match the pairs of photos that have not been matched, and return the job with all of them."""
    compared = set(job.pairs)
    rest = [pair for pair in all_pairs(len(job.files)) if pair not in compared]
    job = replace(job, pairs=(*job.pairs, *rest))
    ladder.match(job, rest)
    return job


def _with_more_features(ladder: _Ladder, job: Job, *, missing: float) -> None:
    """Search larger pictures for more features, within a time that grows with the fraction of missing photos."""
    longest = max(max(group.width, group.height) for group in job.groups)
    more = replace(job, rung="full-size", max_features=QUALITIES["best"][1], pairs=all_pairs(len(job.files)))
    so_far = _search_seconds(job)
    matching = _search_seconds(replace(more, max_image_size=0))
    full = _search_seconds(replace(more, max_image_size=FULL_SIZE)) - matching
    allowed = _MOST_FOR_MORE * missing * so_far - matching
    fraction = min(1.0, max(allowed, 0.0) / full) ** 0.5  # of the longer side: time is proportional to area
    size = max(round(fraction * longest), job.max_image_size)
    what = "more features from full-size photos" if fraction == 1 else f"more features from photos of {size} pixels"
    more = replace(more, max_image_size=FULL_SIZE if fraction == 1 else size)
    ladder.announce(what, takes=_search_seconds(more) / so_far)
    extract(more, ladder.report)
    start_matching(more, more.pairs)
    ladder.match(more, more.pairs)
    ladder.attempt(what, more, MapperOptions())
    _other_starts(ladder, more)


def _search_seconds(job: Job) -> float:
    """Estimate the CPU seconds for a job's features and matches."""
    sizes = ((group.width, group.height) for group in job.groups for _ in group.photos)
    features = extraction_seconds(sizes, max_image_size=job.max_image_size)
    return features + matching_seconds(len(job.pairs), max_features=job.max_features)


def _other_starts(ladder: _Ladder, job: Job) -> None:
    """Try other ways to start, until nearly all photos that are connected by matches are placed."""
    candidates = len(connected_groups(job.image_ids, [pair[:2] for pair in _strong_pairs(job)])[0])
    if len(job.files) >= _MANY_PHOTOS and _FEW_FRACTION <= ladder.fraction(candidates) < _GOOD_FRACTION:
        ladder.tell_results()
        takes = duration(mapping_seconds(len(job.files)))
        ladder.tell(f"not trying other starts, which take about {takes} each: most photos are registered")
        ladder.go_on("lower angles", LOW_ANGLES)
        return
    steps: list[Callable[[], None]] = [
        lambda: ladder.attempt("start from a smaller baseline", job, SMALLER_BASELINE),
        lambda: _from_left_out(ladder, job),
        lambda: ladder.go_on("lower angles", LOW_ANGLES),
        lambda: ladder.attempt("start from low angles", job, LOW_ANGLES),
    ]
    for step in steps:
        if ladder.fraction(candidates) >= _GOOD_FRACTION:
            return
        step()


def _without_exif(ladder: _Ladder, job: Job, *, fraction: float) -> Job:
    """Map without EXIF's focal lengths if fewer than half of the photos are placed; return the better result's job."""
    bare = replace(job, groups=tuple(group.without_exif() for group in job.groups))
    if fraction >= 0.5 or bare.groups == job.groups or not ladder.has_time():
        return job
    what = "without EXIF's focal length"
    ladder.announce(what)
    ladder.verify(bare)
    bare = with_focal_lengths(bare, ladder.tell)
    ladder.attempt(what, bare, MapperOptions())
    if ladder.best.job is not bare:
        ladder.verify(job)
        return job
    return bare


def _with_fisheye(ladder: _Ladder, job: Job, *, fraction: float) -> Job:
    """Map from a fisheye if the result suggests it and pairs of photos confirm it; return the better result's job."""
    if fraction >= _GOOD_FRACTION and not ladder.is_wide():
        return job
    fisheye = as_fisheye(job)
    if fisheye is None or not ladder.has_time():
        return job
    ladder.announce("start from a fisheye lens")
    ladder.verify(fisheye)
    ladder.attempt_instead("start from a fisheye lens", fisheye, MapperOptions())
    if ladder.best.job is not fisheye:
        ladder.verify(job)
        return job
    return fisheye


def _from_left_out(ladder: _Ladder, job: Job) -> None:
    """Start from the strongest pair with a photo that the best model lacks."""
    placed = set(ladder.best.models[0].reg_image_ids()) if ladder.best.models else set()
    left = [pair for pair in _strong_pairs(job) if not set(pair[:2]) <= placed]
    if left:
        one, other, _ = max(left, key=lambda pair: pair[2])
        start = replace(SMALLER_BASELINE, init_pair=(one, other))
        ladder.attempt("start from the strongest unused pair", job, start)


def _strong_pairs(job: Job) -> list[tuple[int, int, int]]:
    """Return (image id, image id, verified matches) of the pairs with enough matches to place a photo."""
    return [pair for pair in count_matches(job.database) if pair[2] >= FEW_MATCHES]


def _can_have_more_features(job: Job) -> bool:
    """Return whether larger pictures or a higher limit would give any photo more features."""
    larger = any(max(group.width, group.height) > job.max_image_size for group in job.groups)
    limited = job.max_features < QUALITIES["best"][1] and max(feature_counts(job), default=0) >= job.max_features
    return (larger or limited) and len(job.files) <= _MOST_FOR_ALL


def _placed(models: list[pycolmap.Reconstruction]) -> int:
    return models[0].num_reg_images() if models else 0
