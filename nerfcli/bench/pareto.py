"""Pareto sets under measurement noise, and the recommended settings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

# Times within this factor of each other count as equal: a training ends after the step in which its time runs out.
SAME_TIME = 1.02
NEAR_BEST_DB = 0.1


@dataclass(frozen=True)
class TimeSpread:
    """Median and quartiles of the times of repeats, in seconds."""

    low: float
    median: float
    high: float
    repeats: int

    @staticmethod
    def of(values: Sequence[float]) -> "TimeSpread":
        """Summarise at least one value."""
        low, median, high = np.percentile(values, (25, 50, 75))
        return TimeSpread(float(low), float(median), float(high), len(values))

    def clearly_below(self, other: "TimeSpread") -> bool:
        """Return whether the upper quartile is below the other's lower quartile, by more than `SAME_TIME`."""
        return self.high * SAME_TIME < other.low


@dataclass(frozen=True)
class SettingResult:
    """Time and error of a setting; the error may have any unit, and smaller is better."""

    name: str
    seconds: TimeSpread
    error: float


def dominators(points: Sequence[SettingResult], *, noise: float) -> dict[str, str | None]:
    """Return for each point the name of a point that dominates it, or None for points of the Pareto set.

    B is dominated by A if A's median time is no longer, and either A is clearly faster and B's error is not smaller by
    more than the noise, or A's error is smaller by more than the noise. Only points of the Pareto set dominate others,
    because being equal within the noise is not transitive.

    Args:
        points: with different names.
        noise: largest difference of errors that is not significant, >= 0.
    """
    worth: list[SettingResult] = []
    found: dict[str, str | None] = {}
    for point in sorted(points, key=lambda point: (point.seconds.median, point.error)):
        above = [
            other
            for other in worth
            if point.error - other.error > noise
            or (other.seconds.clearly_below(point.seconds) and other.error - point.error <= noise)
        ]
        found[point.name] = min(above, key=lambda other: other.error).name if above else None
        if not above:
            worth.append(point)
    return {point.name: found[point.name] for point in points}


def least_difference(values: Sequence[float]) -> float | None:
    """Return the smallest difference between two single trainings that is significant at 95 %.

    Formula: t * s * sqrt(2), with the standard deviation s of n repeats that differ only in their seed, and Student's t
    for n - 1 degrees of freedom.

    Args:
        values: results of the repeats.

    Returns:
        The difference; None for fewer than two repeats.
    """
    if len(values) < 2:
        return None
    return float(stdtrit(len(values) - 1, 0.975) * np.std(values, ddof=1) * math.sqrt(2.0))


def near_best(points: Sequence[SettingResult]) -> SettingResult:
    """Return the fastest point whose error, in dB, is within `NEAR_BEST_DB` of the smallest; needs at least one."""
    smallest = min(point.error for point in points)
    near = [point for point in points if point.error <= smallest + NEAR_BEST_DB]
    return min(near, key=lambda point: (point.seconds.median, point.error))


def at_most(points: Sequence[SettingResult], seconds: float) -> SettingResult | None:
    """Return the point with the smallest error among those with a median time of at most `seconds`, or None."""
    fast = [point for point in points if point.seconds.median <= seconds * SAME_TIME]
    return min(fast, key=lambda point: (point.error, point.seconds.median), default=None)
