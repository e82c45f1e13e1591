"""Which photos to compare with which.

Matching is quadratic in the photos, and with a hundred of them the longest step.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

# Up to here every photo is compared with every other one, whatever the names say.
EXHAUSTIVE_UP_TO = 60
_NEIGHBOURS = 10
_LANDMARKS = 40

# Measured on one core of a 2-core server at 4096 features; within a factor of two on other CPUs.
_SECONDS_PER_PAIR = 0.12
_FEATURES_PER_PAIR = 4096


@dataclass(frozen=True)
class Pairing:
    """Pairs (i, j), i < j, of photo numbers, and the rule they follow: "exhaustive" or "sequential"."""

    rule: str
    pairs: tuple[tuple[int, int], ...]


def choose_pairs(names: Sequence[str]) -> Pairing:
    """Every pair for a small or unordered capture; for a large one that is numbered in order, neighbours and landmarks.

    In a numbered capture each photo is compared with the next 10 and with those 16, 32, 64... further on, and every
    n-th photo (40 in all) with every other such one, which closes loops at any distance.

    """
    order = capture_order(names)
    count = len(names)
    if count <= EXHAUSTIVE_UP_TO or order is None:
        return Pairing("exhaustive", all_pairs(count))
    steps = [*range(1, _NEIGHBOURS + 1), *(2**k for k in range(4, count.bit_length()))]
    near = {(i, i + step) for step in steps for i in range(count - step)}
    landmarks = [round(k * (count - 1) / (_LANDMARKS - 1)) for k in range(_LANDMARKS)]
    places = near | set(combinations(landmarks, 2))
    return Pairing("sequential", in_blocks({_rising(order[i], order[j]) for i, j in places}))


def all_pairs(count: int) -> tuple[tuple[int, int], ...]:
    """Every (i, j) with i < j < count, block by block."""
    return in_blocks(combinations(range(count), 2))


def in_blocks(pairs: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """The pairs in an order in which few photos are in use at a time, since the matcher keeps what it used last."""
    block = 16
    return tuple(sorted(pairs, key=lambda pair: (pair[0] // block, pair[1] // block, pair)))


def capture_order(names: Sequence[str]) -> list[int] | None:
    """Indices of the names by their number, if they differ in one number and nothing else; None otherwise.

    So they do when a camera or a video tool wrote them: IMG_0412.JPG, frame_9.png, frame_10.png.
    """
    parts = [re.fullmatch(r"(.*?)(\d+)(\D*)", name) for name in names]
    matches = [match for match in parts if match]
    if len(matches) < len(names) or len({(match[1], match[3].lower()) for match in matches}) > 1:
        return None
    numbers = [int(match[2]) for match in matches]
    if len(set(numbers)) < len(numbers):
        return None
    return sorted(range(len(numbers)), key=numbers.__getitem__)


def estimated_seconds(pair_count: int, *, max_features: int, threads: int) -> float:
    """About how long the matching takes, to be said before it starts."""
    return pair_count * _SECONDS_PER_PAIR * max_features / _FEATURES_PER_PAIR / threads


def _rising(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)
