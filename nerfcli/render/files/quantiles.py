"""Exact quantiles of more numbers than fit in memory, by counting in two passes."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

_HALF = 2**16


def quantiles(maps: Callable[[], Iterable[np.ndarray]], fractions: Sequence[float]) -> list[float]:
    """Return exact quantiles of all finite values of many arrays, in memory that does not depend on their number.

    Floats are ordered by their bits. The first pass counts all values by their upper 16 bits; the second pass counts
    the values in the bins that contain a quantile by their lower 16 bits.

    Args:
        maps: returns the arrays, float32 of any shape; called twice, and must return the same both times.
        fractions: in [0, 1].

    Returns:
        For each fraction, the smallest value that at least this fraction of all values does not exceed; an empty list
        if there is no finite value.
    """
    upper_counts = np.zeros(_HALF, dtype=np.int64)
    for values in maps():
        upper_counts += np.bincount(_ordered(values) >> 16, minlength=_HALF)
    total = int(upper_counts.sum())
    if total == 0:
        return []
    ranks = [min(max(int(np.ceil(fraction * total)) - 1, 0), total - 1) for fraction in fractions]
    below = np.cumsum(upper_counts)
    uppers = [int(np.searchsorted(below, rank, side="right")) for rank in ranks]
    lower_counts = {upper: np.zeros(_HALF, dtype=np.int64) for upper in uppers}
    for values in maps():
        keys = _ordered(values)
        for upper, counts in lower_counts.items():
            counts += np.bincount(keys[keys >> 16 == upper] & (_HALF - 1), minlength=_HALF)
    found = []
    for rank, upper in zip(ranks, uppers, strict=True):
        within = rank - int(below[upper] - upper_counts[upper])
        lower = int(np.searchsorted(np.cumsum(lower_counts[upper]), within, side="right"))
        found.append(_value(upper * _HALF + lower))
    return found


def _ordered(values: np.ndarray) -> np.ndarray:
    """Return the finite values as uint32 in the same order; the bits of negative floats are inverted."""
    bits = np.ascontiguousarray(values[np.isfinite(values)], dtype=np.float32).view(np.uint32)
    return np.where(bits >> 31 == 1, ~bits, bits | np.uint32(1 << 31))


def _value(key: int) -> float:
    bits = key ^ (1 << 31) if key >> 31 else ~key & 0xFFFFFFFF
    return float(np.array(bits, dtype=np.uint32).view(np.float32))
