"""Estimate of metric scale."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from nerfcli.cameras.alignment import align
from nerfcli.cameras.rigid import Similarity

# Least ratio of the places' spread to their noise; pure noise, part of which a similarity fits, reaches 1.7 with 6
# places and 1.1 with 20.
SPREAD_PER_NOISE = 3.0

# Most groups of neighbouring photos, whose errors are correlated, that the jackknife leaves out in turn.
_JACKKNIFE_GROUPS = 20


@dataclass(frozen=True)
class ScaleEstimate:
    """Estimate of metres per scene unit.

    Args:
        metres_per_unit: above 0.
        standard_error: of metres_per_unit, in the same unit; None if it is unknown (a single distance).
        residuals: (name, residual) of each measurement, in `residual_unit`.
        residual_unit: "percent" of a known length (measured minus known), or "metre".
        source: origin of the estimate, as text for people.
        details: further remarks on it, as text for people; "" if none.
    """

    metres_per_unit: float
    standard_error: float | None
    residuals: tuple[tuple[str, float], ...]
    residual_unit: str
    source: str
    details: str = ""

    @property
    def similarity(self) -> Similarity:
        """The scaling metres_from_world."""
        return Similarity(self.metres_per_unit, np.eye(3), np.zeros(3))

    @property
    def rms_residual(self) -> float:
        """Root mean square of the residuals, in `residual_unit`."""
        return float(np.sqrt(np.mean([value**2 for _, value in self.residuals])))

    def to_json(self) -> dict[str, Any]:
        """Return the fields and "rms_residual" as a JSON object, with the residuals as an object by name."""
        return {
            "metres_per_unit": self.metres_per_unit,
            "standard_error": self.standard_error,
            "residuals": dict(self.residuals),
            "residual_unit": self.residual_unit,
            "rms_residual": self.rms_residual,
            "source": self.source,
            "details": self.details,
        }


def jackknife(x: np.ndarray, y: np.ndarray) -> float:
    """Return the standard error of the scale: sqrt((g - 1) / g sum (s_i - mean)^2), s_i without the i-th of g groups.

    Groups are neighbouring photos, whose errors are correlated. The result is 0 for fewer than 4 points, which are too
    few to leave one out.

    Source: Kuensch 1989, The jackknife and the bootstrap for general stationary observations, for the groups.
    """
    if len(x) < 4:
        return 0.0
    groups = np.array_split(np.arange(len(x)), min(len(x), _JACKKNIFE_GROUPS))
    left = [(np.delete(x, group, axis=0), np.delete(y, group, axis=0)) for group in groups]
    scales = np.array([align(*pair).scale for pair in left if np.ptp(pair[0], axis=0).max() > 0])
    return float(np.sqrt((len(groups) - 1) / len(groups) * np.sum((scales - scales.mean()) ** 2)))
