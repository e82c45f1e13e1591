"""Estimate of metric scale, and a capture in metres."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from nerfcli.cameras.rigid import Similarity


@dataclass(frozen=True)
class ScaleEstimate:
    """Estimate of metres per scene unit.

    Args:
        metres_per_unit: above 0.
        standard_error: of metres_per_unit, in the same unit; None where nothing tells it (a single distance).
        residuals: what is left of each measurement, by its name, in `residual_unit`.
        residual_unit: "percent" of a known length (measured minus known), or "metre".
        source: what it comes from, for people.
        details: what else is to be known of it, for people; "" if nothing.
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
        """The root of the mean square of the residuals, in `residual_unit`."""
        return float(np.sqrt(np.mean([value**2 for _, value in self.residuals])))

    def to_json(self) -> dict[str, Any]:
        """{"metres_per_unit", "standard_error", "residuals", "residual_unit", "rms_residual", "source", "details"}."""
        return {
            "metres_per_unit": self.metres_per_unit,
            "standard_error": self.standard_error,
            "residuals": dict(self.residuals),
            "residual_unit": self.residual_unit,
            "rms_residual": self.rms_residual,
            "source": self.source,
            "details": self.details,
        }
