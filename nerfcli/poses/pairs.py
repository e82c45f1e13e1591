"""Which photos to compare with which.

Matching is quadratic in the photos, and with a hundred of them the longest step.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

# What may be asked for. "auto" is one of the others, by the number of photos and what is known of them.
PAIRINGS = ("auto", "exhaustive", "sequential", "retrieval", "spatial")

# Up to here every photo is compared with every other one, whatever the names say.
EXHAUSTIVE_UP_TO = 60
# In an ordered capture, so many followers...
_FOLLOWERS = 10
# ...and so many that look alike though they are not near in the order, which closes loops.
_LOOP_NEIGHBOURS = 8
# In an unordered one.
_NEIGHBOURS = 25


@dataclass(frozen=True)
class Pairing:
    """The rule, one of `PAIRINGS` but "auto", or "file"; pairs (i, j), i < j, of photo numbers; and with how many more
    that look alike each photo is compared, which is known once their features are.
    """

    rule: str
    pairs: tuple[tuple[int, int], ...]
    neighbours: int


def choose_pairs(names: Sequence[str], *, rule: str = "auto") -> Pairing:
    """Which photos to compare: see the rules below. A small capture is compared exhaustively, a larger one as its
    photos allow: in their order if their names have one, else by how alike they look.

    Raises:
        ValueError: no such rule.
    """
    if rule == "auto":
        rule = (
            "exhaustive"
            if len(names) <= EXHAUSTIVE_UP_TO
            else "retrieval"
            if not capture_order(names)
            else "sequential"
        )
    if rule == "exhaustive":
        return Pairing("exhaustive", all_pairs(len(names)), 0)
    if rule == "sequential":
        order = capture_order(names) or list(range(len(names)))
        return Pairing("sequential", sequential_pairs(order), _LOOP_NEIGHBOURS)
    if rule == "retrieval":
        return Pairing("retrieval", (), _NEIGHBOURS)
    raise ValueError(f"pairing must be one of {', '.join(PAIRINGS)}, got {rule}")


def sequential_pairs(order: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """Each photo with the next 10 in the order, and with those 16, 32, 64... further on."""
    count = len(order)
    steps = [*range(1, _FOLLOWERS + 1), *(2**k for k in range(4, count.bit_length()))]
    near = {(i, i + step) for step in steps for i in range(count - step)}
    return in_blocks({_rising(order[i], order[j]) for i, j in near})


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


def _rising(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)
