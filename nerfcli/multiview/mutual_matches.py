"""Features of two photos that choose each other, without a solver: for the few pairs of a quick look."""

import numpy as np

# A match is kept if the second-best feature is this much farther away. Source: Lowe 2004, section 7.1.
_RATIO = 0.8


def mutual_matches(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of features that are each other's nearest and nearer by `_RATIO` than the second-nearest."""
    if min(len(one), len(other)) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    a, b = (descriptors.astype(np.float32) for descriptors in (one, other))
    distances = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2 * (a @ b.T)  # squared; (one, other)
    back = distances.argmin(axis=0)
    rows = np.arange(len(a))
    nearest = distances.argmin(axis=1)
    best = distances[rows, nearest].copy()
    distances[rows, nearest] = np.inf
    clear = best < _RATIO**2 * distances.min(axis=1)
    kept = clear & (back[nearest] == rows)
    return rows[kept], nearest[kept]
