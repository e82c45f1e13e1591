"""Photos as a graph: groups that are connected by joins."""

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def connected_groups(photos: Sequence[int], joins: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Return the groups of photos that joins connect, the largest first, each in the order of `photos`.

    Example:
        >>> connected_groups([7, 8, 9], [(9, 7)])
        [[7, 9], [8]]
    """
    index = {photo: place for place, photo in enumerate(photos)}
    ends = np.array([(index[one], index[other]) for one, other in joins], dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends), dtype=bool), ends.T), shape=(len(photos), len(photos)))
    groups: dict[int, list[int]] = {}
    for photo, label in zip(photos, connected_components(graph, directed=False)[1].tolist(), strict=True):
        groups.setdefault(label, []).append(photo)
    return sorted(groups.values(), key=lambda group: (-len(group), index[group[0]]))
