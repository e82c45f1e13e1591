"""A world frame of metres east, north and up: from GPS positions, or from surveyed control points."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras.alignment import Alignment, align, align_robustly
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.cameras.world import Origin
from nerfcli.errors import UserError
from nerfcli.media.geodesy import Position
from nerfcli.scale.control_points import ControlPoints
from nerfcli.scale.corners import triangulate
from nerfcli.scale.estimate import SPREAD_PER_NOISE, ScaleEstimate, jackknife, spans_a_plane
from nerfcli.scale.gps import scale_from_gps

# Points in a strip thinner than this fraction of its length do not say which way is up.
_THINNEST = 0.02
# From this number on, each point can be predicted from the others.
_ENOUGH_TO_CHECK = 4


@dataclass(frozen=True)
class Georeference:
    """A world of metres, x east, y north and z up.

    Args:
        estimate: of the scale. For control points, residuals are the distances in metres to where the other points
            predict each one, or to where the fit puts it if there are only three.
    """

    estimate: ScaleEstimate
    metres_from_world: Similarity
    origin: Origin


def georeference_by_gps(frames: Sequence[Frame], positions: Mapping[str, Position]) -> Georeference:
    """Return the world of the photos' GPS positions; see `scale_from_gps`. The first position is its origin.

    Raises:
        UserError: the positions do not determine the scale, or the photos are along a line.
    """
    fit = scale_from_gps(frames, positions)
    if fit.enu_from_world is None:
        raise UserError(
            "the photos are along a line: their GPS positions do not say which way is up",
            "use --scale gps for metres and --world-up for the direction, or give control points",
        )
    return Georeference(fit.estimate, fit.enu_from_world, Origin("WGS 84", fit.reference, in_degrees=True))


def georeference_by_points(frames: Sequence[Frame], control: ControlPoints, source: str) -> Georeference:
    """Return the world of control points, by a similarity from the places triangulated from the photos.

    The fit is by least squares, without outliers from five points on (`align_robustly`). The standard error of the
    scale is the jackknife's over the points.

    Args:
        frames: with the size of the photos that pixels were measured in.

    Raises:
        UserError: fewer than three points can be triangulated, they are on a line, or they contradict each other.
    """
    seen, reasons = triangulate(frames, control.sightings(frames))
    unused = {
        name: reasons.get(name, "no photo that shows it has a pose") for name in control.places if name not in seen
    }
    if len(seen) < 3:
        why = "; ".join(f"{name}: {reason}" for name, reason in list(unused.items())[:4])
        count = f"only {len(seen)}" if seen else "none"
        raise UserError(
            f"{count} of {len(control.places)} control points can be used" + (f" ({why})" if why else ""),
            "at least 3 are needed, each in two photos or more that show it from different directions",
        )
    names = list(seen)
    x, y = np.stack([seen[name] for name in names]), np.stack([control.places[name] for name in names])
    if min(_thinness(x), _thinness(y)) < _THINNEST:
        raise UserError(
            f"the {len(names)} control points are on a line or in one place",
            "they must span an area, or nothing says which way is up",
        )
    fit = align_robustly(x, y)
    keep, offsets = fit.follows, _offsets(x, y, fit)
    misses = dict(zip(names, np.linalg.norm(offsets, axis=1).tolist(), strict=True))
    spread = _rms(y[keep] - y[keep].mean(axis=0))
    noise = _noise(x[keep], y[keep], fit)
    if spread < SPREAD_PER_NOISE * np.sqrt(3) * noise or not spans_a_plane(y[keep], noise):
        worst = max(misses, key=lambda name: misses[name])
        raise UserError(
            f"the control points contradict each other: they are spread over {spread:.2g} m, and the noise is "
            f"{np.sqrt(3) * noise:.2g} m; {worst} misses by {misses[worst]:.2g} m",
            "check their names, the order of coordinates, and that pixels refer to the photos at full size",
        )
    checked = int(keep.sum()) >= _ENOUGH_TO_CHECK
    used = {name: misses[name] for name, kept in zip(names, keep, strict=True) if kept}
    outliers = {name: miss for name, miss in misses.items() if name not in used}
    details = f"spread over {spread:.3g} m; {_errors_in_words(offsets[keep], used)}"
    estimate = ScaleEstimate(
        metres_per_unit=fit.b_from_a.scale,
        standard_error=jackknife(x[keep], y[keep]) if checked else None,
        residuals=tuple(misses.items()),
        residual_unit="metre",
        source=f"{len(used)} control points ({source})",
        details=details + _left_out_in_words(outliers, unused),
    )
    return Georeference(estimate, fit.b_from_a, control.origin)


def _errors_in_words(offsets: np.ndarray, misses: Mapping[str, float]) -> str:
    """Describe the offsets (N, 3) of the used points, which miss by `misses`."""
    checked = len(misses) >= _ENOUGH_TO_CHECK
    how = "each predicted from the others, they miss by" if checked else "the fit, which nothing checks, misses by"
    worst = max(misses, key=lambda name: misses[name])
    return (
        f"{how} {_rms(offsets[:, :2]):.2g} m horizontally and {_rms(offsets[:, 2:]):.2g} m vertically (RMS), at most "
        f"{misses[worst]:.2g} m ({worst})"
    )


def _left_out_in_words(outliers: Mapping[str, float], unused: Mapping[str, str]) -> str:
    words = ""
    if outliers:
        words += f"; outliers ignored: {', '.join(f'{name} (by {miss:.2g} m)' for name, miss in outliers.items())}"
    if unused:
        words += f"; not used: {', '.join(f'{name} ({reason})' for name, reason in unused.items())}"
    return words


def _rms(offsets: np.ndarray) -> float:
    """Return the root mean square length of offsets (N, D)."""
    return float(np.sqrt(np.mean(np.sum(offsets**2, axis=1))))


def _offsets(x: np.ndarray, y: np.ndarray, fit: Alignment) -> np.ndarray:
    """Return where each point (N, 3) lies relative to its known place, in metres.

    A point that was used in a fit of four or more is predicted from the other ones.
    """
    offsets = fit.b_from_a.apply(x) - y
    used = np.flatnonzero(fit.follows)
    if len(used) >= _ENOUGH_TO_CHECK:
        for i in used:
            others = used[used != i]
            offsets[i] = align(x[others], y[others]).apply(x[i]) - y[i]
    return offsets


def _noise(x: np.ndarray, y: np.ndarray, fit: Alignment) -> float:
    """Return the noise per coordinate in metres; of three points from the two degrees of freedom that are left."""
    return fit.sigma if np.isfinite(fit.sigma) else float(np.sqrt(np.sum((fit.b_from_a.apply(x) - y) ** 2) / 2))


def _thinness(points: np.ndarray) -> float:
    """Return the width of points (N, 3) across their best line, relative to their length along it."""
    along, across, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(across / along) if along > 0 else 0.0
