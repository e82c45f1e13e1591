"""Scale from measured distances: between two cameras, or between two points of the scene."""

import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras.frame import Frame, frames_named
from nerfcli.captures.scale.estimate import ScaleEstimate
from nerfcli.captures.world import point_of
from nerfcli.errors import UserError

EXPECTED = (
    'expected "A B METRES", where A and B are names of images or points x,y,z, such as "a.jpg b.jpg 1.25" or '
    '"0,0,0 1,0,0 0.3+-0.002"; quote names with spaces'
)
_POINT = re.compile(r"[^,]+,[^,]+,[^,]+")


@dataclass(frozen=True)
class KnownDistance:
    """A distance in scene units and in metres, between the ends that `name` says for people.

    Args:
        tolerance: standard error of `metres` in metres, or None where unknown.
    """

    name: str
    units: float
    metres: float
    tolerance: float | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.units) and self.units > 0):
            raise UserError(
                f"{self.name}: the two points coincide in the scene", "give a distance between two other points"
            )
        if not (math.isfinite(self.metres) and self.metres > 0):
            raise UserError(
                f"{self.name}: invalid distance of {self.metres:g} m", "expected a positive length in metres"
            )
        if self.tolerance is not None and not 0 < self.tolerance < self.metres:
            raise UserError(
                f"{self.name}: invalid standard error, {self.metres:g} m ± {self.tolerance:g} m",
                "the standard error must be positive and smaller than the length",
            )


def known_distance(text: str, frames: Sequence[Frame]) -> KnownDistance:
    """Parse "A B METRES" or "A B METRES+-ERROR"; A and B are names of images or points x,y,z.

    Raises:
        UserError: the text has another form, an image is unknown, or the length is invalid.
    """
    try:
        first, second, length = shlex.split(text)
        metres, *tolerance = (float(part) for part in length.replace("±", "+-").split("+-"))
    except ValueError as error:
        raise UserError(f"{text!r} is not a valid distance", EXPECTED, exit_code=2) from error
    if len(tolerance) > 1:
        raise UserError(f"{text!r} is not a valid distance", EXPECTED, exit_code=2)
    a, b = (_place(place, frames) for place in (first, second))
    units = float(np.linalg.norm(a - b))
    return KnownDistance(f"{first} to {second}", units, metres, tolerance[0] if tolerance else None)


def scale_from_distances(distances: Sequence[KnownDistance]) -> ScaleEstimate:
    """Estimate metres per unit by weighted least squares of the logarithm.

    log s = sum_i w_i log(metres_i / units_i) / sum_i w_i,  w_i = (metres_i / tolerance_i)^2

    In the logarithm every distance is weighted by its relative error, and estimates of the scale and of its inverse
    agree. If any distance has no tolerance, all weights are 1.

    Returns:
        The estimate. With tolerances, its standard error is s / sqrt(sum w), times sqrt(chi^2 / (n - 1)) if that is
        above 1, when the distances disagree by more than their tolerances. Without tolerances, it is that of the mean,
        from the scatter of the distances, and None for a single distance. It excludes errors that all distances share.

    Raises:
        ValueError: no distance.
    """
    if not distances:
        raise ValueError("scale_from_distances needs at least one distance")
    logs = np.log([distance.metres / distance.units for distance in distances])
    tolerances = [distance.tolerance for distance in distances]
    relative = np.array([t / d.metres for t, d in zip(tolerances, distances, strict=True) if t is not None])
    weighted = len(relative) == len(distances)
    weights = relative**-2.0 if weighted else np.ones(len(distances))
    log_scale = float(weights @ logs / weights.sum())
    scale = math.exp(log_scale)
    free = len(distances) - 1
    chi_squared = float(weights @ (logs - log_scale) ** 2)
    scatter = math.sqrt(chi_squared / free / weights.sum()) if free else None
    error = max(1 / math.sqrt(weights.sum()), scatter or 0.0) if weighted else scatter
    count = f"{len(distances)} known distance{'s' if free else ''}"
    return ScaleEstimate(
        metres_per_unit=scale,
        standard_error=None if error is None else scale * error,
        residuals=tuple((d.name, 100 * (scale * d.units / d.metres - 1)) for d in distances),
        residual_unit="percent",
        source=count,
    )


def _place(text: str, frames: Sequence[Frame]) -> np.ndarray:
    """Return the point x,y,z, or the centre of the camera with this name; a matching name takes precedence."""
    if _POINT.fullmatch(text) and all(frame.name != text for frame in frames):
        return point_of(text, EXPECTED)
    return frames_named(frames, [text])[0].centre
