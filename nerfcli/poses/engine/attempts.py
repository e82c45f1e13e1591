"""Mapping attempts, each costlier than the one before, until enough photos are placed.

The first attempt has pycolmap's own thresholds. `FALLBACKS` lists what may follow, in order, each with the reason that
calls it: the first ones use the same matches in other ways, the last ones add matches and features. Every attempt is
recorded with its result.
"""

import math
import time
from collections.abc import Callable, Sequence, Set
from contextlib import nullcontext
from dataclasses import asdict, replace
from typing import Any

import pycolmap

from nerfcli.errors import duration
from nerfcli.matching.graph import connected_groups
from nerfcli.poses.engine.database import camera_of_group, copied, feature_counts, register_photos
from nerfcli.poses.engine.features import extract, match, start_matching
from nerfcli.poses.engine.initial_lens import detect_fisheyes, estimate_focal_lengths, tell_of_exif
from nerfcli.poses.engine.mapping import MappedModels, MapperOptions, map_photos, mapper_limit_seconds
from nerfcli.poses.input.job import Job, Report, Tell
from nerfcli.poses.input.pairs import ALL_ALIKE_UP_TO, all_pairs
from nerfcli.poses.input.plan import extraction_seconds, mapping_seconds, matching_seconds
from nerfcli.poses.input.settings import LARGEST_PX, MOST_FEATURES
from nerfcli.poses.judge.parallax import best_rotation_fit
from nerfcli.poses.model.intrinsics import FISHEYE_FROM_DEG, field_of_view_deg
from nerfcli.poses.model.lens_evidence import lenses_of
from nerfcli.poses.model.locate import left_out, locate_photos
from nerfcli.poses.model.merging import merge_models
from nerfcli.poses.model.reasons import FEW_FEATURES, FEW_MATCHES, MIN_MATCHES
from nerfcli.poses.model.rotations import misleading_pairs
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
# Each single photo takes some seconds; if more than this are missing, the problem is not one of single photos.
_MOST_SINGLE_PHOTOS = 60

SMALLER_BASELINE = MapperOptions(init_min_tri_angle=8.0, init_min_num_inliers=50)
LOW_ANGLES = MapperOptions(
    init_min_tri_angle=3.0, init_min_num_inliers=30, filter_min_tri_angle=0.5, init_max_forward_motion=1.0
)


def map_with_fallbacks(job: Job, report: Report, tell: Tell = lambda text: None) -> MappedModels:
    """Map a job's photos, with as many of the `FALLBACKS` as it takes.

    Mapping starts from focal lengths estimated from pairs of photos where EXIF has no reliable one. If the camera only
    turned, no further attempt is made; nor is one after twenty times the planned time, four minutes at least. If the
    first attempt is not the last, `tell` receives each attempt and its result.
    """
    given = estimate_focal_lengths(job, tell)
    attempts = MappingAttempts(given, report, tell)
    attempts.map("default thresholds", MapperOptions(), without=_misleading(given, tell))
    if attempts.too_many_left_out() and _only_turns(given):
        attempts.tell_results()
        tell("not trying anything else: the camera stood still or turned on the spot")
        return attempts.result()
    if attempts.placed_fraction() >= _FEW_FRACTION:  # cheaper than any other way to place the last few
        locate_single_photos(attempts)
    for reason, fallback in FALLBACKS:
        if reason(attempts) and attempts.has_time():
            fallback(attempts)
    locate_single_photos(attempts)
    if len(attempts.record) > 1:
        attempts.tell_results()
    if attempts.best.models:
        tell_of_exif(given, attempts.best.job, attempts.best.models[0], tell)
    return attempts.result()


class MappingAttempts:
    """The attempts so far: their record, the best models, and the job with which the next one begins."""

    def __init__(self, job: Job, report: Report, tell: Tell) -> None:
        self.job = job
        self.best = MappedModels([], job, [])
        self.record: list[dict[str, Any]] = []
        self.photos = len(job.files)
        self.report = report
        self.tell = tell
        self._with_features = sum(count >= FEW_FEATURES for count in feature_counts(job))
        self.located_from: list[pycolmap.Reconstruction] = []  # the models whose other photos were tried one by one
        self._reported = 0
        self._announced = ""
        self._cut_short: list[str] = []
        self._start = time.perf_counter()
        self._is_over = False

    def placed_fraction(self, candidates: int | None = None) -> float:
        """Return the best model's number of photos over `candidates`, by default those with enough features."""
        return _placed(self.best.models) / max(self._with_features if candidates is None else candidates, 1)

    def too_many_left_out(self) -> bool:
        """Return whether too many of the photos with enough features are left out."""
        return self.placed_fraction() < _GOOD_FRACTION

    def connected_fraction(self) -> float:
        """Return the placed fraction of the largest group of photos that pairs with enough matches connect."""
        pairs = [pair[:2] for pair in _strong_pairs(self.job)]
        return self.placed_fraction(len(connected_groups(self.job.image_ids, pairs)[0]))

    def may_have_a_fisheye(self) -> bool:
        """Return whether photos are left out, or a field of view came out so wide that the lens may be a fisheye."""
        return self.too_many_left_out() or any(
            field_of_view_deg(model.camera(camera_id)) > FISHEYE_FROM_DEG
            for model in self.best.models[:1]
            for camera_id in set(lenses_of(model).values())
        )

    def can_have_more_features(self) -> bool:
        """Return whether a higher limit, or larger pictures of not too many photos, would give any more features."""
        job, are_many = self.job, self.photos > _MOST_FOR_ALL
        most = job.halved_from if are_many else MOST_FEATURES
        limited = job.max_features < most and max(feature_counts(job), default=0) >= job.max_features
        larger = _longest_px(job) > job.max_image_size
        return limited or (larger and not are_many)

    def have_unmatched_pairs(self) -> bool:
        """Return whether some pairs of photos have not been compared."""
        return len(self.job.pairs) < math.comb(self.photos, 2)

    def has_time(self) -> bool:
        """Return whether there is time for another attempt; the first time there is none, tell the user."""
        most = 2 * mapper_limit_seconds(self.photos)
        if not self._is_over and time.perf_counter() - self._start > most:
            self._is_over = True
            self._cut(f"no further attempts to place photos after {duration(most)}")
        return not self._is_over

    def announce(self, what: str, *, takes: float = 0.0) -> None:
        """Tell the results so far and, once, what comes next."""
        self.tell_results()
        if what != self._announced:
            longer = f" (takes about {takes:.1f} times as long as the first features and matches)" if takes else ""
            self.tell(f"next: {what}{longer}")
        self._announced = what

    def tell_results(self) -> None:
        """Report the results that have not been reported yet."""
        for attempt in self.record[self._reported :]:
            largest, *others = attempt["models"] or ["none"]
            also = f" (and {len(others)} smaller models)" if len(others) > 1 else f" + {others[0]}" if others else ""
            self.tell(f"{attempt['what']}: {largest}{also} of {self.photos} photos registered")
        self._reported = len(self.record)

    def map(self, what: str, start: MapperOptions, *, without: Set[frozenset[int]] = frozenset()) -> None:
        """Map from scratch and merge sub-models; the result counts if it places more photos than the best so far.

        The mapper does not see the pairs `without`, image ids.
        """
        if self.record:
            if not self.has_time():
                return
            self.announce(what)
        job = self.job
        with copied(job, "reduced", without=without) if without else nullcontext(job) as seen:
            models = self._run_mapper(what, seen, start)
        self.take(what, models, job)
        if len(models) > 1:
            seconds = mapper_limit_seconds(self.photos)
            merged = merge_models(models, job, seconds=seconds, report=self.report, tell=self._cut)
            if _placed(merged) > _placed(models):
                self.take("sub-models merged", merged, job)

    def map_with(self, what: str, other: Job, *, or_equal: bool = False) -> None:
        """Map with the lenses of another job, and go on with that job if its result is the best, `or_equal` to it."""
        given, best = self.job, self.best
        self.job = other
        if or_equal:
            self.best = MappedModels([], other, [])
        self.map(what, MapperOptions())
        if _placed(self.best.models) < _placed(best.models):
            self.best = best
        if self.best.job is not other:
            self.job = given
            self.verify(given)

    def extend(self, what: str, start: MapperOptions) -> None:
        """Try to extend the best model, if there is one, to the remaining photos."""
        models, job = self.best.models, self.best.job
        if not models or not self.has_time():
            return
        self.announce(what)
        grown = self._run_mapper(what, job, start, base=models[0])
        if grown:
            self.take(what, [grown[0], *models[1:]], job, located=self.best.located)

    def match(self, job: Job, pairs: Sequence[tuple[int, int]]) -> None:
        """Match pairs of photos, and remember if that was cut short."""
        unmatched = match(job, pairs, self.report)
        if unmatched is not None:
            self._cut(unmatched)

    def verify(self, job: Job) -> None:
        """Verify the matches of a job again, as far as they were verified with other lenses."""
        register_photos(job)
        self.match(job, job.pairs)

    def take(
        self, what: str, models: list[pycolmap.Reconstruction], job: Job, *, located: tuple[int, ...] = ()
    ) -> None:
        """Record the result of an attempt; it is the best so far if it places more photos.

        `located` are photos that the first model may have from its points, see `MappedModels`.
        """
        self.record.append({"what": what, "models": [model.num_reg_images() for model in models]})
        if _placed(models) > _placed(self.best.models):
            self.best = MappedModels(models, job, self.record, located)

    def result(self) -> MappedModels:
        """Return the best models with the record of all attempts."""
        return replace(self.best, attempts=self.record, cut_short=tuple(self._cut_short))

    def _run_mapper(
        self, what: str, job: Job, start: MapperOptions, *, base: pycolmap.Reconstruction | None = None
    ) -> list[pycolmap.Reconstruction]:
        def cut(seconds: float) -> None:
            without = f"stopped after {duration(seconds)} without another photo"
            self._cut(f"{what}: {without}; only its largest snapshot is kept")

        return map_photos(job, self.report, attempt=len(self.record), start=start, base=base, stalled=cut)

    def _cut(self, what: str) -> None:
        self.tell(f"cut short: {what}")
        self._cut_short.append(what)


def match_remaining_pairs(attempts: MappingAttempts) -> None:
    """Match the pairs of photos that have not been matched; the next attempts use all of them."""
    job = attempts.job
    matched = set(job.pairs)
    rest = [pair for pair in all_pairs(len(job.files)) if pair not in matched]
    attempts.job = replace(job, pairs=(*job.pairs, *rest))
    attempts.match(attempts.job, rest)


def map_without_exif(attempts: MappingAttempts) -> None:
    """Map without EXIF's focal lengths."""
    what, bare = "without EXIF's focal length", _without_exif(attempts.job)
    attempts.announce(what)
    attempts.verify(bare)
    attempts.map_with(what, estimate_focal_lengths(bare, attempts.tell))


def map_from_fisheye(attempts: MappingAttempts) -> None:
    """Map from a fisheye lens if pairs of photos confirm one."""
    what, fisheye = "start from a fisheye lens", detect_fisheyes(attempts.job)
    if fisheye is not None:
        attempts.announce(what)
        attempts.verify(fisheye)
        attempts.map_with(what, fisheye, or_equal=True)


def map_from_other_starts(attempts: MappingAttempts) -> None:
    """Start in other ways, until nearly all photos that are connected by matches are placed.

    With many photos, only extend the best model, unless a quarter is left out.
    """
    if attempts.photos >= _MANY_PHOTOS and _FEW_FRACTION <= attempts.connected_fraction() < _GOOD_FRACTION:
        attempts.tell_results()
        takes = duration(mapping_seconds(attempts.photos))
        attempts.tell(f"not trying other starts, which take about {takes} each: most photos are registered")
        attempts.extend("lower angles", LOW_ANGLES)
        return
    for start in (
        lambda: attempts.map("start from a smaller baseline", SMALLER_BASELINE),
        lambda: _map_from_unused_pair(attempts),
        lambda: attempts.extend("lower angles", LOW_ANGLES),
        lambda: attempts.map("start from low angles", LOW_ANGLES),
    ):
        if attempts.connected_fraction() < _GOOD_FRACTION:
            start()


def _map_from_unused_pair(attempts: MappingAttempts) -> None:
    """Start from the strongest pair with a photo that the best model lacks."""
    placed = set(attempts.best.models[0].reg_image_ids()) if attempts.best.models else set()
    unused = [pair for pair in _strong_pairs(attempts.job) if not set(pair[:2]) <= placed]
    if unused:
        one, other, _ = max(unused, key=lambda pair: pair[2])
        attempts.map("start from the strongest unused pair", replace(SMALLER_BASELINE, init_pair=(one, other)))


def map_with_all_pairs(attempts: MappingAttempts) -> None:
    """Match the remaining pairs, and start from a smaller baseline."""
    match_remaining_pairs(attempts)
    attempts.map("match all pairs", SMALLER_BASELINE)


def map_with_more_features(attempts: MappingAttempts) -> None:
    """Search larger pictures for more features; in many photos, only for as many features as fewer begin with."""
    job = attempts.job
    without_halving = replace(job, max_features=job.halved_from or job.max_features, halved_from=0)
    if attempts.photos > _MOST_FOR_ALL:
        more = replace(without_halving, variant="full-size")
        what = f"{more.max_features:,} features from each photo"
    else:
        seconds = _MOST_FOR_MORE * (1 - attempts.placed_fraction()) * _search_seconds(without_halving)
        more = _with_larger_pictures(without_halving, seconds)
        what = f"more features from pictures of {more.max_image_size} pixels"
    attempts.job = more
    attempts.announce(what, takes=_search_seconds(more) / _search_seconds(job))
    extract(more, attempts.report)
    start_matching(more, more.pairs)
    attempts.match(more, more.pairs)
    attempts.map(what, MapperOptions())
    map_from_other_starts(attempts)


def _with_larger_pictures(job: Job, seconds: float) -> Job:
    """Return the job with all pairs, more features, and pictures as large as the CPU seconds allow."""
    more = replace(job, variant="full-size", max_features=MOST_FEATURES, pairs=all_pairs(len(job.files)))
    matching = matching_seconds(len(more.pairs), max_features=more.max_features)
    full = _search_seconds(replace(more, max_image_size=LARGEST_PX)) - matching
    fraction = min(1.0, max(seconds - matching, 0.0) / full) ** 0.5  # of the longer side: time is proportional to area
    return replace(more, max_image_size=max(round(fraction * _longest_px(job)), job.max_image_size))


def _longest_px(job: Job) -> int:
    """Return the longest side of any photo, or of the largest pictures that are searched if that is shorter."""
    return min(LARGEST_PX, max(max(group.width, group.height) for group in job.groups))


# What follows the first attempt, in this order: each if its reason holds, and time is left.
FALLBACKS: tuple[tuple[Callable[[MappingAttempts], bool], Callable[[MappingAttempts], None]], ...] = (
    (lambda a: a.too_many_left_out() and a.photos <= ALL_ALIKE_UP_TO, match_remaining_pairs),
    (lambda a: a.placed_fraction() < 0.5 and _without_exif(a.job) != a.job, map_without_exif),
    (MappingAttempts.may_have_a_fisheye, map_from_fisheye),
    (lambda a: a.connected_fraction() < _GOOD_FRACTION, map_from_other_starts),
    (lambda a: a.too_many_left_out() and a.photos <= _MOST_FOR_ALL and a.have_unmatched_pairs(), map_with_all_pairs),
    (lambda a: a.placed_fraction() < _FEW_FRACTION and a.can_have_more_features(), map_with_more_features),
)


def locate_single_photos(attempts: MappingAttempts) -> None:
    """Locate the photos that the best model lacks one by one, from the 3D points that they show."""
    what = "remaining photos one by one, from the 3D points they see"
    models, job = attempts.best.models, attempts.best.job
    left = left_out(models[0], job) if models else []
    if not 0 < len(left) <= _MOST_SINGLE_PHOTOS or attempts.best.models is attempts.located_from:
        return
    attempts.announce(what)
    grown, located = locate_photos(models[0], job, image_ids=left, report=attempts.report)
    placed = tuple(one.image_id for one in located if not one.refused)
    rest = [model for model in models[1:] if not set(model.reg_image_ids()) <= set(grown.reg_image_ids())]
    attempts.take(what, [grown, *rest], job, located=(*attempts.best.located, *placed))
    attempts.record[-1]["photos"] = [{"name": job.name_of[one.image_id], **asdict(one)} for one in located]
    attempts.located_from = attempts.best.models


def _without_exif(job: Job) -> Job:
    groups = (replace(group, focal_px=None, focal_is_prior=False) for group in job.groups)
    return replace(job, groups=tuple(groups))


def _misleading(job: Job, tell: Tell) -> Set[frozenset[int]]:
    """Return the pairs that mislead the mapper, and tell the user how many they are."""
    pairs = read_verified_pairs(job.database, min_matches=MIN_MATCHES)
    cameras = {job.image_ids[photo]: camera_of_group(group) for group in job.groups for photo in group.photos}
    found = misleading_pairs(pairs, cameras, job.solver)
    if found:
        tell(
            f"mapping without {len(found)} of {len(pairs)} pairs of photos: the rotations of the others contradict them"
        )
    return found


def _only_turns(job: Job) -> bool:
    """Return whether rotations of the camera explain all matches, so that no attempt can give an accepted model."""
    turn = best_rotation_fit(read_verified_pairs(job.database, min_matches=FEW_MATCHES), job.sizes)
    return turn is not None and turn.explains_all


def _search_seconds(job: Job) -> float:
    """Estimate the CPU seconds for a job's features and matches."""
    sizes = ((group.width, group.height) for group in job.groups for _ in group.photos)
    features = extraction_seconds(sizes, max_image_size=job.max_image_size)
    return features + matching_seconds(len(job.pairs), max_features=job.max_features)


def _strong_pairs(job: Job) -> list[tuple[int, int, int]]:
    """Return (image id, image id, verified matches) of the pairs with enough matches to place a photo."""
    return [pair for pair in count_matches(job.database) if pair[2] >= FEW_MATCHES]


def _placed(models: list[pycolmap.Reconstruction]) -> int:
    return models[0].num_reg_images() if models else 0
