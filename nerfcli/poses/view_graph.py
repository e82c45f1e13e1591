"""Photos as a graph: two are joined as strongly as they have matches in common.

A chain of joins is as strong as its weakest; the bottleneck of two photos is the strongest chain between them.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

Join = tuple[int, int, float]


class Bottlenecks:
    """The strongest chain between any two of some photos, along given joins (photo, photo, strength)."""

    def __init__(self, photos: Sequence[int], joins: Iterable[Join]) -> None:
        self._index = {photo: index for index, photo in enumerate(photos)}
        self._strengths: NDArray[np.float64] = np.zeros((len(photos), len(photos)))
        groups = [[index] for index in range(len(photos))]
        # Kruskal's maximum spanning tree: the join that first brings two groups together is their bottleneck.
        for one, other, strength in sorted(joins, key=lambda join: -join[2]):
            first, second = groups[self._index[one]], groups[self._index[other]]
            if first is second:
                continue
            self._strengths[np.ix_(first, second)] = strength
            self._strengths[np.ix_(second, first)] = strength
            first.extend(second)
            for index in second:
                groups[index] = first

    def between(self, one: int, other: int) -> float:
        """Strength of the strongest chain between two photos, 0 without any."""
        return float(self._strengths[self._index[one], self._index[other]])


def parts(photos: Sequence[int], joins: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Photos that chains of joins hold together, the largest part first, each in the order of `photos`."""
    groups = {photo: [photo] for photo in photos}
    for one, other in joins:
        first, second = groups[one], groups[other]
        if first is second:
            continue
        first.extend(second)
        for photo in second:
            groups[photo] = first
    order = {photo: index for index, photo in enumerate(photos)}
    unique = {id(group): sorted(group, key=order.__getitem__) for group in groups.values()}
    return sorted(unique.values(), key=lambda group: (-len(group), order[group[0]]))
