"""Plan of structure from motion with an estimate of its time, reported before it starts."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

from nerfcli.poses.input.pairs import Pairing, looked_at_features
from nerfcli.poses.input.photos import Photos
from nerfcli.poses.input.settings import PoseSettings

# How many times as long a photo takes whose features are sought in the enlarged picture too, see `features.extract`.
_ENLARGED_FACTOR = 3.0
# CPU seconds, measured on one core of a 2-core server; within a factor of two on others.
_SECONDS_PER_MEGAPIXEL = 0.4
_SECONDS_PER_PAIR = 0.045
_FEATURES_PER_PAIR = 4096
_SECONDS_PER_LOOK = 0.0006
_FEATURES_PER_LOOK = 256
# Of a picture as it is searched, about.
_FEATURES_PER_PIXEL = 0.015
# Of the mapper: the first for few photos; the second for each other photo, since all are adjusted again and again. From
# the right focal length, 302 frames of a walk took 149 s with the merger of sub-models, 200 made ones 54 s.
_MAP_SECONDS_PER_PHOTO, _MAP_SECONDS_PER_TWO = 0.38, 0.0005
# Of mapping, what merging its sub-models takes.
_MERGE_SHARE = 0.2
# Of a photo that is located by 3D points.
_SECONDS_PER_LOCATED = 0.7
# Of the global mapper.
_AT_ONCE_SECONDS_PER_PHOTO = 0.5
_CHECK_SECONDS, _CHECK_SECONDS_PER_PHOTO = 5.0, 0.13
# How the time of a stage grows with what it has done, as a power: the mapper's photos take longer and longer.
_GROWTH = {"map": 1.3}
# Of the checks, the share of their time that is over after each of the four: single photos 2 %, lens models half.
# Measured on 11, 16, 20 and 50 photos.
_CHECK_SHARES = (0.0, 0.02, 0.5, 0.8, 1.0)
# So many times the planned seconds are the most: most captures take a third of these to twice, on a busy machine more.
_MOST_TIMES_PLANNED = 10
# Memory: of the libraries and of each photo in the mapper, and of a pixel that a thread searches in enlarged pictures.
# Fitted to 50 photos of 270x480 (0.60 GB), 18 of 4000x2250 on one thread and on two (0.67, 0.77), and 1,000 (2.0).
_BYTES, _BYTES_PER_PHOTO, _BYTES_PER_PIXEL = 500_000_000, 1_500_000, 70
# Of a stage, the share after which its speed says something; what one sub-model took says nothing of the next.
# The first check, of which much depends on the photos, says little of the others.
_TELLING, _TELLING_OF = 0.05, {"merge": 1.0, "check": 0.25}


@dataclass(frozen=True)
class Plan:
    """photos: how many. rule and pairs: see `Pairing`; pairs is the most that may come of it. seconds: per stage, where
    a photo has `features`. memory_bytes: of the process that does the work, at its peak.
    """

    photos: int
    max_image_size: int
    max_features: int
    rule: str
    pairs: int
    seconds: dict[str, float]
    features: int = _FEATURES_PER_PAIR
    memory_bytes: int = 0

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    def describe(self) -> str:
        """Return one sentence."""
        times = ", ".join(f"{_WORDS[stage]} {duration(seconds)}" for stage, seconds in self.seconds.items())
        about = f"about {duration(sum(self.seconds.values()))}"
        memory = f"{self.memory_bytes / 1e9:.1f} GB of memory"
        return f"{self.photos} photos, {self.pairs} pairs to match ({self.rule}), {about}: {times}; {memory}"


# In the order of the work.
_WORDS = {"extract": "features", "pair": "pairs", "match": "matches", "map": "poses", "check": "checks"}


def make_plan(photos: Photos, pairing: Pairing, settings: PoseSettings, *, threads: int) -> Plan:
    """Return the plan for these photos; threads is how many there really are."""
    count = len(photos.photos)
    all_pairs = count * (count - 1) // 2
    pairs = min(len(pairing.pairs) + pairing.neighbours * count, all_pairs)
    sizes = [(photo.width, photo.height) for photo in photos.photos]
    searched = _searched_pixels(sizes, max_image_size=settings.max_image_size)
    features = min(settings.max_features, round(_FEATURES_PER_PIXEL * sum(searched) / max(count, 1)))
    seconds = {
        "extract": extraction_seconds(sizes, max_image_size=settings.max_image_size) / threads,
        "pair": looking_seconds(count) / threads if pairing.neighbours else 0.0,
        "match": matching_seconds(pairs, max_features=features) / threads,
        "map": mapping_seconds(count),
        "check": checking_seconds(count),
    }
    return Plan(
        photos=count,
        max_image_size=settings.max_image_size,
        max_features=settings.max_features,
        rule=pairing.rule,
        pairs=pairs,
        seconds={stage: round(value, 1) for stage, value in seconds.items() if value > 0},
        features=features,
        memory_bytes=round(_BYTES + count * _BYTES_PER_PHOTO + threads * max(searched, default=0.0) * _BYTES_PER_PIXEL),
    )


def extraction_seconds(sizes: Iterable[tuple[int, int]], *, max_image_size: int) -> float:
    """CPU seconds to find features in photos of these sizes (width, height)."""
    return sum(_searched_pixels(sizes, max_image_size=max_image_size)) / 1e6 * _SECONDS_PER_MEGAPIXEL


def _searched_pixels(sizes: Iterable[tuple[int, int]], *, max_image_size: int) -> list[float]:
    return [width * height * min(1.0, max_image_size / max(width, height)) ** 2 for width, height in sizes]


def looking_seconds(photos: int) -> float:
    """CPU seconds to find which of so many photos look alike."""
    return math.comb(photos, 2) * _SECONDS_PER_LOOK * (looked_at_features(photos) / _FEATURES_PER_LOOK) ** 2


def matching_seconds(pairs: int, *, max_features: int) -> float:
    """CPU seconds to match so many pairs of photos with so many features each."""
    return pairs * _SECONDS_PER_PAIR * max_features / _FEATURES_PER_PAIR


def mapping_seconds(photos: int) -> float:
    """CPU seconds to place so many photos one after the other."""
    return photos * (_MAP_SECONDS_PER_PHOTO + photos * _MAP_SECONDS_PER_TWO)


def at_once_seconds(photos: int) -> float:
    """CPU seconds to place so many photos with the global mapper."""
    return photos * _AT_ONCE_SECONDS_PER_PHOTO


def limit_seconds(planned: float, *, least: float) -> float:
    """Return after how many seconds a step is stopped: what takes so many times as long as planned may never end."""
    return max(_MOST_TIMES_PLANNED * planned, least)


def checking_seconds(photos: int) -> float:
    """CPU seconds to check the poses of so many photos."""
    return _CHECK_SECONDS + photos * _CHECK_SECONDS_PER_PHOTO


class Outlook:
    """Estimate of the remaining time: measured for the current stage, from the plan for later ones.

    The plan's seconds are stretched by how long the stage at hand has taken so far, after its beginning; those of
    later stages by the least that any stage was. The machine slows all of them, whereas what makes one of them slow is
    its own (matches of shiny things, poses of a dense walk). Work that an earlier call has done counts for nothing.
    Which photos are enlarged to find more features in them is known only after the first search, how many features
    the matcher compares after the second, and whether there are sub-models to merge or single photos to locate after
    mapping; where that adds work, the share that is done stands still until it is true again.

    Args:
        plan: for the stages that have not begun.
        clock: seconds.
    """

    def __init__(self, plan: Plan, clock: Callable[[], float] = time.monotonic):
        self._plan = plan
        self._clock = clock
        self._start = clock()
        self._stage = ""
        self._began = (0.0, 0.0)
        self._ratio = 0.0
        self._stretches: list[float] = []  # of the stages before: their seconds, over what the plan has for that work
        self._latest = (0.0, 0.0)  # of the stage at hand: its seconds, and what the plan has for that work
        self._seconds = dict(plan.seconds)
        self._share = 0.0
        self._at = ("", 0, 0)

    def update(self, stage: str, done: int, total: int) -> tuple[float, float]:
        """Return (fraction of all work that is done, remaining seconds)."""
        now = self._clock()
        if stage == "features":
            self._plan_matching(done)
            stage, done, total = self._at
        self._at = (stage, done, total)
        if stage == "enlarge":
            self._plan_enlarging(total)
        if stage == "merge":
            self._plan_before_checks(stage, _MERGE_SHARE * self._plan.seconds.get("map", 0.0))
        if stage == "locate":
            self._plan_before_checks(stage, _SECONDS_PER_LOCATED * total)
        ratio = _share_done(stage, done, total)
        if self._begins_again(stage, ratio):
            self._share = 0.0
        if stage != self._stage or ratio < self._ratio:
            took, of_plan = self._latest
            if of_plan > _telling(self._stage) * self._seconds.get(self._stage, 0.0):
                self._stretches.append(took / of_plan)
            self._stage, self._began, self._latest = stage, (now, ratio), (0.0, 0.0)
        self._ratio = ratio
        planned = self._seconds.get(stage, 0.0)
        began, ratio_before = self._began
        took, of_plan = now - began, planned * (ratio - ratio_before)
        self._latest = (took, of_plan)
        stretch = min(self._stretches, default=1.0)
        if planned > 0:
            # What a stage begins with says little of its rest: its first twentieth is as planned until it is done.
            unseen = max(_telling(stage) * planned - of_plan, 0.0)
            own = (took + unseen * stretch) / (of_plan + unseen)
            left = own * planned * (1 - ratio)
            stretch = min(own, *self._stretches) if self._stretches else own
        else:
            left = took * (1 - ratio) / (ratio - ratio_before) if ratio > ratio_before else 0.0
        stages = list(self._seconds)
        later = stages[stages.index(stage) + 1 :] if stage in stages else []
        left += stretch * sum(self._seconds[name] for name in later)
        spent = now - self._start
        self._share = max(self._share, spent / (spent + left) if left > 0 else 1.0)
        return self._share, left

    def _begins_again(self, stage: str, ratio: float) -> bool:
        """Return whether the work goes back, for another attempt. Stages without a plan come last."""
        order = list(self._seconds)
        new, old = (order.index(name) if name in order else len(order) for name in (stage, self._stage))
        return bool(self._stage) and (new < old or (new == old and ratio < self._ratio))

    def _plan_matching(self, features: int) -> None:
        """Plan for so many features per photo, which are known by now."""
        share = features / max(self._plan.features, 1)
        self._seconds = {name: s * (share if name == "match" else 1.0) for name, s in self._seconds.items()}

    def _plan_enlarging(self, photos: int) -> None:
        """Put the second search for features after the first."""
        extract = self._plan.seconds.get("extract", 0.0)
        enlarge = _ENLARGED_FACTOR * extract * photos / max(self._plan.photos, 1)
        later = {stage: seconds for stage, seconds in self._plan.seconds.items() if stage != "extract"}
        self._seconds = {"extract": extract, "enlarge": enlarge, **later}

    def _plan_before_checks(self, stage: str, seconds: float) -> None:
        """Put a stage that no plan foresees before the checks."""
        before = {name: planned for name, planned in self._seconds.items() if name not in (stage, "check")}
        self._seconds = {**before, stage: seconds, "check": self._plan.seconds.get("check", 0.0)}


def _share_done(stage: str, done: int, total: int) -> float:
    """Return the share of a stage's time that is over."""
    if stage == "check" and total == len(_CHECK_SHARES) - 1:
        return _CHECK_SHARES[done]
    return (done / total) ** _GROWTH.get(stage, 1.0) if total else 1.0


def _telling(stage: str) -> float:
    return _TELLING_OF.get(stage, _TELLING)


def duration(seconds: float) -> str:
    """8 s, 3 min, 1.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
