"""Metric scale from known distances and from GPS, with its uncertainty.

The GPS of phones is off by metres, and its errors last for minutes: it gives the scale of a street, not of a teapot.
In up to 1 of 100 captures, errors that drift as slowly as the photographer walks are taken for the walk, and no
residual shows that.
"""

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nerfcli.cameras.alignment import align, align_robustly
from nerfcli.cameras.frame import Frame, frames_named
from nerfcli.cameras.layout import centres_of
from nerfcli.errors import UserError
from nerfcli.photos.exif import read_exif
from nerfcli.photos.geodesy import Position, east_north_up

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
    def rms_residual(self) -> float:
        """Root mean square of the residuals, in `residual_unit`."""
        return float(np.sqrt(np.mean([value**2 for _, value in self.residuals])))

    def to_json(self) -> dict[str, Any]:
        """Return the fields and "rms_residual" as a JSON object, with the residuals as an object by name."""
        return asdict(self) | {"residuals": dict(self.residuals), "rms_residual": self.rms_residual}


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
            hint = "give a distance between two other points"
            raise UserError(f"{self.name}: the two points coincide in the scene", hint)
        if not (math.isfinite(self.metres) and self.metres > 0):
            hint = "expected a positive length in metres"
            raise UserError(f"{self.name}: invalid distance of {self.metres:g} m", hint)
        if self.tolerance is not None and not 0 < self.tolerance < self.metres:
            hint = "the standard error must be positive and smaller than the length"
            raise UserError(f"{self.name}: invalid standard error, {self.metres:g} m ± {self.tolerance:g} m", hint)


def known_distance(text: str, frames: Sequence[Frame]) -> KnownDistance:
    """Parse "A B METRES" or "A B METRES+-ERROR"; A and B are names of images or points x,y,z."""
    try:
        first, second, length = shlex.split(text)
        length, stated, tolerance = length.replace("±", "+-").partition("+-")
        metres, standard_error = float(length), float(tolerance) if stated else None
    except ValueError as error:
        raise UserError(f"{text!r} is not a valid distance", EXPECTED, exit_code=2) from error
    a, b = (_place(place, frames) for place in (first, second))
    units = float(np.linalg.norm(a - b))
    return KnownDistance(f"{first} to {second}", units, metres, standard_error)


def scale_from_distances(distances: Sequence[KnownDistance]) -> ScaleEstimate:
    """Estimate metres per unit from one or more distances by weighted least squares of the logarithm.

    log s = sum_i w_i log(metres_i / units_i) / sum_i w_i,  w_i = (metres_i / tolerance_i)^2

    In the logarithm every distance is weighted by its relative error, and estimates of the scale and of its inverse
    agree. If any distance has no tolerance, all weights are 1.

    Returns:
        The estimate. With tolerances, its standard error is s / sqrt(sum w), times sqrt(chi^2 / (n - 1)) if that is
        above 1, when the distances disagree by more than their tolerances. Without tolerances, it is that of the mean,
        from the scatter of the distances, and None for a single distance. It excludes errors that all distances share.
    """
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


# GPS noise per coordinate in metres, assumed if there are too few photos to estimate it. Smartphones under open sky
# are within 4.9 m. Source: gps.gov, "GPS accuracy", after van Diggelen & Enge 2015.
_TYPICAL_NOISE = 3.0
_ENOUGH_TO_TELL = 6


def gps_positions(frames: Sequence[Frame]) -> dict[str, Position]:
    """Read the GPS positions of photos from EXIF, by frame name; photos without a position are omitted."""
    found = {frame.name: read_exif(frame.image).gps for frame in frames if frame.image is not None}
    return {name: gps for name, gps in found.items() if gps is not None}


def scale_from_gps(frames: Sequence[Frame], positions: Mapping[str, Position]) -> ScaleEstimate:
    """Estimate metres per unit from the GPS positions of the photos.

    It fits a similarity from camera centres to ENU metres, by least squares without outliers (`align_robustly`). The
    standard error is the larger of the jackknife's, over up to 20 groups of neighbouring photos, and
    sigma / sqrt(sum |x - mean|^2), where sigma is the GPS noise per coordinate, at least 3 m with fewer than 6 photos.

    Raises:
        UserError: fewer than two positions, all cameras or positions at one place, or a spread of the photos below 3
            times the GPS noise; the error gives the numbers.
    """
    used = sorted((frame for frame in frames if frame.name in positions), key=lambda frame: frame.name)
    if len(used) < 2:
        what = f"{'only 1' if used else 'none'} of {len(frames)} photos with a pose has a GPS position in its EXIF"
        raise UserError(what, "at least 2 are needed; give a known distance instead")
    x = centres_of(used)
    y = east_north_up([positions[frame.name] for frame in used])
    if not (np.ptp(x, axis=0).max() > 0 and np.ptp(y, axis=0).max() > 0):
        which = "GPS positions" if np.ptp(x, axis=0).max() > 0 else "cameras"
        hint = "this gives no scale; give a known distance instead"
        raise UserError(f"the {which} of all {len(used)} photos are identical", hint)
    fit = align_robustly(x, y)
    keep = fit.follows
    enough = int(keep.sum()) >= _ENOUGH_TO_TELL
    sigma = fit.sigma if enough else float(np.fmax(fit.sigma, _TYPICAL_NOISE))
    spread = float(np.sqrt(np.mean(np.sum((y[keep] - y[keep].mean(axis=0)) ** 2, axis=1))))
    noise = float(np.sqrt(3)) * sigma
    if not spread >= SPREAD_PER_NOISE * noise:
        how = "estimated from the fit to the poses" if enough else f"as assumed for {int(keep.sum())} photos"
        raise UserError(
            f"GPS is too inaccurate for a scale: the photos are spread over {spread:.2g} m, and the GPS error is "
            f"{noise:.2g} m ({how})",
            f"a spread of at least {SPREAD_PER_NOISE * noise:.2g} m is needed; give a known distance instead",
        )
    scale = fit.b_from_a.scale
    residuals = np.linalg.norm(fit.b_from_a.apply(x) - y, axis=1)
    left_out = [frame.name for frame, kept in zip(used, keep, strict=True) if not kept]
    off = f"; outliers ignored: {', '.join(left_out)}" if left_out else ""
    return ScaleEstimate(
        metres_per_unit=scale,
        standard_error=max(jackknife(x[keep], y[keep]), scale * sigma / (np.sqrt(keep.sum()) * spread)),
        residuals=tuple((frame.name, float(r)) for frame, r in zip(used, residuals, strict=True)),
        residual_unit="metre",
        source=f"GPS of {int(keep.sum())} photos (EXIF)",
        details=f"the photos are spread over {spread:.3g} m, and the GPS error is {noise:.2g} m{off}",
    )


def point_of(text: str, hint: str) -> np.ndarray:
    """Parse a point (3,) from "x,y,z"; `hint` says what is expected."""
    try:
        point = np.array([float(part) for part in text.split(",")])
    except ValueError as error:
        raise UserError(f"{text!r} is not a point", hint, exit_code=2) from error
    if point.shape != (3,) or not np.isfinite(point).all():
        raise UserError(f"{text!r} is not a point of three finite numbers", hint, exit_code=2)
    return point
