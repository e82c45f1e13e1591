"""Pareto sets under measurement noise, and the recommended settings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

# Times within this factor of each other are the same: a training ends with the step during which its time is over.
SAME_TIME = 1.02
NEAR_BEST_DB = 0.1


@dataclass(frozen=True)
class TimeSpread:
    """Times of repeats, in seconds: their median and the quartiles around it."""

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
        """Return whether even the slower repeats were faster than the other's faster ones."""
        return self.high * SAME_TIME < other.low


@dataclass(frozen=True)
class SettingResult:
    """Cost and error of a setting; the smaller the error, the better, in any unit."""

    name: str
    seconds: TimeSpread
    error: float


def dominators(points: Sequence[SettingResult], *, noise: float) -> dict[str, str | None]:
    """For each point the name of one that makes it pointless, or None for those worth their time: the Pareto set.

    B is dominated by A if A's median time is no longer, and either A is clearly faster and B's error is not smaller by
    more than the noise, or A's error is smaller by more than the noise. Only points of the Pareto set dominate: what
    is within the noise of something that is within the noise of the best need not be within the noise of the best.

    Args:
        points: with different names.
        noise: differences of errors up to this mean nothing, >= 0.
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
    """Return the difference between two single trainings that is significant at 95 %.

    t * s * sqrt(2), with the standard deviation s of repeats that differ in their seed alone, and Student's t for as
    many degrees of freedom.

    Args:
        values: of the repeats.

    Returns:
        None for fewer than two repeats, of which nothing can be said.
    """
    if len(values) < 2:
        return None
    return float(stdtrit(len(values) - 1, 0.975) * np.std(values, ddof=1) * math.sqrt(2.0))


def near_best(points: Sequence[SettingResult]) -> SettingResult:
    """Return the fastest of those whose error, in dB, is within `NEAR_BEST_DB` of the smallest; at least one point."""
    smallest = min(point.error for point in points)
    near = [point for point in points if point.error <= smallest + NEAR_BEST_DB]
    return min(near, key=lambda point: (point.seconds.median, point.error))


def at_most(points: Sequence[SettingResult], seconds: float) -> SettingResult | None:
    """Return the one with the smallest error among those whose median takes at most some time; None where none does."""
    fast = [point for point in points if point.seconds.median <= seconds * SAME_TIME]
    return min(fast, key=lambda point: (point.error, point.seconds.median), default=None)
