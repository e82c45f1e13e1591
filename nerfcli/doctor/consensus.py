"""Estimate one number per photo from differences between pairs, as heights are found in a levelling survey."""

from collections.abc import Sequence

import numpy as np

from nerfcli.multiview.graph import connected_groups

_ROUNDS = 10
# Differences between photos are off by about this much; larger residuals weigh less.
_TYPICAL_ERROR = 0.1


def potentials(
    count: int, pairs: Sequence[tuple[int, int]], differences: np.ndarray, *, trust: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate a number v per photo such that v_j - v_i fits the differences (weighted least absolute deviations).

    In each connected group of photos v is determined up to a constant, which makes its median 0.

    Args:
        count: number of photos.
        pairs: (i, j) of each difference.
        differences: (len(pairs),) second minus first; NaN where unknown.
        trust: (len(pairs),) positive weights.

    Returns:
        v (count,), NaN for photos without a known difference; and the number of known differences of each photo.
    """
    measured = ~np.isnan(differences)
    i, j = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)[measured].T
    differences, trust = differences[measured], trust[measured]
    backing = np.bincount(np.concatenate([i, j]), minlength=count)
    values = np.zeros(count)
    weights = trust / max(trust.mean(), 1e-9) if len(trust) else trust
    for _ in range(_ROUNDS):
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
        weights = trust / trust.mean() / np.maximum(residuals, _TYPICAL_ERROR) if len(trust) else trust
    values[backing == 0] = np.nan
    for members in connected_groups(range(count), zip(i.tolist(), j.tolist(), strict=True)):
        backed = [member for member in members if backing[member]]
        if backed:
            values[backed] -= np.median(values[backed])
    return values, backing
