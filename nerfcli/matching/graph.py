"""Photos as a graph: groups that are connected by joins, the strength of their connections, numbers from differences.

The strength of the join of two photos is the number of their matches. A chain of joins is as strong as its weakest
join; the bottleneck of two photos is the strongest chain between them.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Join = tuple[int, int, float]


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


def spanning_tree(photos: Sequence[int], joins: Iterable[Join]) -> Iterator[tuple[Join, list[int], list[int]]]:
    """Yield the joins of the maximum spanning tree, the strongest first, each with the two groups that it connects.

    Source: Kruskal 1956, On the shortest spanning subtree of a graph.
    """
    groups = {photo: [photo] for photo in photos}
    for join in sorted(joins, key=lambda join: -join[2]):
        first, second = groups[join[0]], groups[join[1]]
        if first is not second:
            yield join, first, second
            first.extend(second)
            groups.update(dict.fromkeys(second, first))


def bottlenecks(photos: Sequence[int], joins: Iterable[Join]) -> Callable[[int, int], float]:
    """Return a function of two photos: the strength of the strongest chain of joins between them, 0 without any."""
    index = {photo: place for place, photo in enumerate(photos)}
    strengths = np.zeros((len(photos), len(photos)))
    # The join that first brings two groups together is their bottleneck.
    for (_, _, strength), *groups in spanning_tree(photos, joins):
        first, second = ([index[photo] for photo in group] for group in groups)
        strengths[np.ix_(first, second)] = strength
        strengths[np.ix_(second, first)] = strength
    return lambda one, other: float(strengths[index[one], index[other]])


def consistent_groups(photos: Sequence[int], joins: Iterable[Join]) -> list[list[int]]:
    """Divide photos into groups that are consistent with the strongest evidence.

    Joins with a strength above 0 put photos in one group, those below 0 keep them apart. The stronger join wins: in the
    order of absolute strength, a positive join merges two groups unless a stronger negative one keeps them apart. The
    largest group is the first, and each is in the order of `photos`.

    Example:
        >>> consistent_groups([1, 2, 3, 4], [(1, 2, 9.0), (3, 4, 9.0), (2, 3, 5.0), (1, 4, -6.0)])
        [[1, 2], [3, 4]]

    Source: mutex watershed, Wolf et al. 2019, The Mutex Watershed and its Objective, arXiv:1904.12654, algorithm 1.
    """
    group_of = {photo: photo for photo in photos}
    members = {photo: [photo] for photo in photos}
    apart: dict[int, set[int]] = {photo: set() for photo in photos}
    for one, other, strength in sorted(joins, key=lambda join: -abs(join[2])):
        first, second = group_of[one], group_of[other]
        if first == second or strength == 0:
            continue
        if strength < 0:
            apart[first].add(second)
            apart[second].add(first)
        elif second not in apart[first]:
            for photo in members[second]:
                group_of[photo] = first
            members[first].extend(members.pop(second))
            for third in apart.pop(second):
                apart[third].remove(second)
                apart[third].add(first)
                apart[first].add(third)
    order = {photo: index for index, photo in enumerate(photos)}
    groups = [sorted(group, key=order.__getitem__) for group in members.values()]
    return sorted(groups, key=lambda group: (-len(group), order[group[0]]))


def potentials(
    count: int,
    pairs: np.ndarray | Sequence[tuple[int, int]],
    differences: np.ndarray,
    *,
    trust: np.ndarray,
    usual_error: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate a number v per photo such that v_j - v_i fits the differences, as heights in a levelling survey.

    Weighted least absolute deviations; a constant of each connected group of photos makes its median 0.

    Args:
        pairs: (i, j) of each difference.
        differences: (len(pairs),) second minus first; NaN where unknown.
        trust: (len(pairs),) positive weights.
        usual_error: of a difference; larger residuals weigh less.

    Returns:
        v (count,), NaN for photos without a known difference; and the number of known differences of each photo.
    """
    measured = ~np.isnan(differences)
    i, j = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)[measured].T
    differences, trust = differences[measured], trust[measured]
    backing = np.bincount(np.concatenate([i, j]), minlength=count)
    values = np.zeros(count)
    weights = trust / max(trust.mean(), 1e-9) if len(trust) else trust
    for _ in range(10):
        laplacian = np.zeros((count, count))
        np.add.at(laplacian, (i, i), weights)
        np.add.at(laplacian, (j, j), weights)
        np.add.at(laplacian, (i, j), -weights)
        np.add.at(laplacian, (j, i), -weights)
        right = np.bincount(j, weights * differences, minlength=count)
        right -= np.bincount(i, weights * differences, minlength=count)
        # A slight pull to 0 fixes the constant of each connected group.
        values = np.linalg.solve(laplacian + 1e-6 * np.eye(count), right)
        residuals = np.abs(values[j] - values[i] - differences)
        weights = trust / trust.mean() / np.maximum(residuals, usual_error) if len(trust) else trust
    values[backing == 0] = np.nan
    for members in connected_groups(range(count), zip(i.tolist(), j.tolist(), strict=True)):
        backed = [member for member in members if backing[member]]
        if backed:
            values[backed] -= np.median(values[backed])
    return values, backing
