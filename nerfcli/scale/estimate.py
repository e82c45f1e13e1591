"""Estimate of metric scale."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from nerfcli.cameras.rigid import Similarity


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
