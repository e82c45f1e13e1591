"""Plan of structure from motion with an estimate of its time, reported before it starts.

The seconds and bytes are those of a 2-core server; other machines are within a factor of two.
"""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from nerfcli.errors import duration
from nerfcli.poses.input.pairs import Pairing, retrieval_feature_count
from nerfcli.poses.input.photos import Photos
from nerfcli.poses.input.settings import Search


class Stage(NamedTuple):
    """Words for a stage: what is being done, what is counted, and what a plan calls it, if it is in one."""

    doing: str
    counted: str
    planned: str = ""


# All stages, in the order of the work.
STAGES = {
    "read": Stage("reading photos", "photos read"),
    "extract": Stage("finding features", "photos, features", "features"),
    "features": Stage("counting features", "features per photo"),
    "pair": Stage("choosing pairs", "photos, finding similar ones", "pairs"),
    "match": Stage("matching photos", "pairs compared", "matches"),
    "matches": Stage("counting matches", "verified matches per photo"),
    "map": Stage("placing photos", "photos registered", "poses"),
    "merge": Stage("merging sub-models", "sub-models, merging them"),
    "locate": Stage("locating single photos", "trials to locate single photos"),
    "check": Stage("checking the poses", "checks of the poses", "checks"),
    "stabilise": Stage("trying a principal point for each photo", "trials of principal points", "principal points"),
    "settle": Stage("adjusting with a principal point for each photo", "adjustments of principal points"),
}
_ORDER = tuple(STAGES)
# Photos with few features are searched again, enlarged by this factor, or up to the size of the largest searched
# pictures: frames of small videos have matches in their finest detail.
ENLARGEMENT = 1.5
# Memory of SIFT per pixel of the searched picture: it is enlarged to four times the pixels; of that, and of all smaller
# octaves together a third more, six blurred pictures and five differences are kept in float32.
_SIFT_BYTES = 4 * 4 / 3 * 11 * 4
# Large photos are searched few at a time, so that all pictures of SIFT need no more than this, or one photo at a time.
_MOST_SIFT_BYTES = 2e9
# A stage that took less than planned shortens the others by no more than this factor. Replays of 14 captures are within
# a factor of two of what is left at 86 % of their moments, without a limit at 62 %.
_LEAST_STRETCH = 0.8
# Least time limit of a step, however few the photos.
LEAST_LIMIT_SECONDS = 120


@dataclass(frozen=True)
class Plan:
    """Amount of work, with estimates of time and memory.

    photos: number. rule, pairs: see `Pairing`; pairs is an upper bound on their number. seconds: per stage, for
    `features` features per photo. memory_bytes: peak memory of the worker process.
    """

    photos: int
    max_image_size: int
    max_features: int
    rule: str
    pairs: int
    seconds: dict[str, float]
    features: int = 4096
    memory_bytes: int = 0

    def describe(self) -> str:
        """Describe the plan in one sentence."""
        times = ", ".join(f"{STAGES[stage].planned} {duration(seconds)}" for stage, seconds in self.seconds.items())
        about = f"about {duration(sum(self.seconds.values()))}"
        memory = f"{self.memory_bytes / 1e9:.1f} GB of memory"
        return f"{self.photos} photos, {self.pairs} pairs to match ({self.rule}), {about}: {times}; {memory}"


def make_plan(photos: Photos, pairing: Pairing, search: Search, *, threads: int) -> Plan:
    """Return the plan for these photos."""
    count = len(photos.photos)
    all_pairs = math.comb(count, 2)
    pairs = min(len(pairing.pairs) + pairing.neighbours * count, all_pairs)
    sizes = [(photo.width, photo.height) for photo in photos.photos]
    searched = _searched_pixels(sizes, max_image_size=search.max_image_size)
    features = min(search.max_features, round(0.009 * sum(searched) / max(count, 1)))
    look_alikes = all_pairs * 0.0003 * (retrieval_feature_count(count) / 256) ** 2
    seconds = {
        "extract": extraction_seconds(sizes, max_image_size=search.max_image_size) / threads,
        "pair": look_alikes / threads if pairing.neighbours else 0.0,
        "match": matching_seconds(pairs, max_features=features) / threads,
        "map": mapping_seconds(count),
        "check": checking_seconds(count),
        "stabilise": 1.2 + count * 0.02,
    }
    # The libraries, each photo in the mapper, and the pictures that are searched at the same time.
    _, searches_bytes = searched_at_a_time(sizes, max_image_size=search.max_image_size, threads=threads)
    return Plan(
        photos=count,
        max_image_size=search.max_image_size,
        max_features=search.max_features,
        rule=pairing.rule,
        pairs=pairs,
        seconds={stage: round(value, 1) for stage, value in seconds.items() if value > 0},
        features=features,
        memory_bytes=round(500e6 + count * 1.5e6 + searches_bytes),
    )


def extraction_seconds(sizes: Iterable[tuple[int, int]], *, max_image_size: int) -> float:
    """Estimate the CPU seconds to extract features from photos of these sizes (width, height)."""
    return sum(_searched_pixels(sizes, max_image_size=max_image_size)) / 1e6 * 0.3


def _searched_pixels(sizes: Iterable[tuple[int, int]], *, max_image_size: int, enlargement: float = 1.0) -> list[float]:
    return [width * height * min(enlargement, max_image_size / max(width, height)) ** 2 for width, height in sizes]


def searched_at_a_time(sizes: Iterable[tuple[int, int]], *, max_image_size: int, threads: int) -> tuple[int, float]:
    """Return how many photos of these sizes (width, height) are searched at the same time, and the bytes for that."""
    pixels = _searched_pixels(sizes, max_image_size=max_image_size, enlargement=ENLARGEMENT)
    each = max(pixels, default=0.0) * _SIFT_BYTES
    count = max(1, min(threads, int(_MOST_SIFT_BYTES / (each + 1))))
    return count, count * each


def matching_seconds(pairs: int, *, max_features: int) -> float:
    """Estimate the CPU seconds to match this many pairs of photos with up to `max_features` features each."""
    features = max_features / 4096
    return pairs * features * (0.012 + 0.015 * features)


def mapping_seconds(photos: int, *, matches: float = 2000.0) -> float:
    """Estimate the seconds to place this many photos one after the other, with so many verified matches for each."""
    # All photos are adjusted again and again; of more matches, more points are redundant and left out of that.
    return photos * (0.09 + photos * 0.0005) * (matches / 2000.0) ** 0.5


def at_once_seconds(photos: int) -> float:
    """Estimate the CPU seconds to place this many photos with the global mapper."""
    return photos * (0.1 + photos * 0.0015)


def limit_seconds(planned: float) -> float:
    """Return the time limit of a step: if it takes 10 times as long as planned, it may never end."""
    return max(10 * planned, LEAST_LIMIT_SECONDS)


def checking_seconds(photos: int, *, matches: float = 2000.0) -> float:
    """Estimate the seconds to check the poses of this many photos, with so many verified matches for each."""
    return (1 + photos * (0.04 + photos * 0.0002)) * (matches / 2000.0) ** 0.5


class TimeEstimate:
    """Estimate of the remaining time: measured for the current stage, from the plan for later ones.

    The planned seconds of the current stage are scaled by the time it has taken so far, after its beginning; those of
    later stages by the smallest scale of any stage, at least 0.8. A slow machine slows all stages, whereas a single
    slow stage has its own cause (matches of shiny things, poses of a dense walk), and so has a single fast one. Work
    that an earlier call has done does not count. How many features the matcher compares is known only after they are
    found, whether there are sub-models to merge or single photos to locate only after mapping, and whether principal
    points differ only after a trial; if that adds work, the fraction done stays constant until it is correct again.

    `clock` returns seconds.
    """

    def __init__(self, plan: Plan, clock: Callable[[], float] = time.monotonic):
        self._plan = plan
        self._clock = clock
        self._start = clock()
        self._stage, self._place = "", -1
        self._began = (0.0, 0.0)
        self._ratio = 0.0
        self._stretches: list[float] = []  # of earlier stages: their seconds over the planned ones for that work
        self._latest = (0.0, 0.0)  # of the current stage: its seconds, and the planned ones for that work
        self._planned = dict.fromkeys(_ORDER, 0.0) | plan.seconds
        self._seconds = dict(self._planned)
        self._fraction = 0.0
        self._at = ("", 0, 0)

    def update(self, stage: str, done: int, total: int) -> tuple[float, float]:
        """Return (fraction of all work that is done, remaining seconds)."""
        now = self._clock()
        if stage == "features":
            self._seconds["match"] *= done / max(self._plan.features, 1)
            stage, done, total = self._at
        elif stage == "matches":
            for name, seconds in (("map", mapping_seconds), ("check", checking_seconds)):
                self._seconds[name] = self._planned[name] = seconds(self._plan.photos, matches=done)
            stage, done, total = self._at
        self._at = (stage, done, total)
        if stage == "merge":
            self._seconds[stage] = 0.2 * self._planned["map"]
        elif stage == "locate":
            self._seconds[stage] = 0.7 * total
        elif stage == "settle":
            self._seconds[stage] = 5 * self._planned["stabilise"]
        ratio = _fraction_done(stage, done, total)
        place = _ORDER.index(stage) if stage in _ORDER else len(_ORDER)
        if (place, ratio) < (self._place, self._ratio):  # the work has gone back for another attempt
            self._fraction = 0.0
            # Whether it needs these again is not known yet.
            self._seconds |= {name: 0.0 for name in ("merge", "locate", "settle") if name != stage}
        if stage != self._stage or ratio < self._ratio:
            took, of_plan = self._latest
            if of_plan > _telling(self._stage) * self._seconds.get(self._stage, 0.0):
                self._stretches.append(took / of_plan)
            self._stage, self._began, self._latest = stage, (now, ratio), (0.0, 0.0)
        self._place, self._ratio = place, ratio
        planned = self._seconds.get(stage, 0.0)
        began, ratio_before = self._began
        took, of_plan = now - began, planned * (ratio - ratio_before)
        self._latest = (took, of_plan)
        stretch = max(_LEAST_STRETCH, min(self._stretches, default=1.0))
        if planned > 0:
            # The beginning of a stage says little about the rest: its first twentieth counts as planned until done.
            unseen = max(_telling(stage) * planned - of_plan, 0.0)
            own = (took + unseen * stretch) / (of_plan + unseen)
            left = own * planned * (1 - ratio)
            stretch = max(_LEAST_STRETCH, min(own, *self._stretches) if self._stretches else own)
        else:
            left = took * (1 - ratio) / (ratio - ratio_before) if ratio > ratio_before else 0.0
        left += stretch * sum(self._seconds[name] for name in _ORDER[place + 1 :])
        spent = now - self._start
        self._fraction = max(self._fraction, spent / (spent + left) if left > 0 else 1.0)
        return self._fraction, left


def _fraction_done(stage: str, done: int, total: int) -> float:
    """Return the fraction of a stage's time that has passed."""
    if stage == "check" and total == 4:
        return (0.0, 0.02, 0.5, 0.8, 1.0)[done]  # lens models take half
    return (done / total) ** (1.3 if stage == "map" else 1.0) if total else 1.0  # mapping slows down


def _telling(stage: str) -> float:
    """Return the fraction of a stage after which its speed is informative.

    The time of one sub-model says nothing about the next, and the first check, which depends much on the photos, says
    little about the others.
    """
    return {"merge": 1.0, "check": 0.25}.get(stage, 0.05)
