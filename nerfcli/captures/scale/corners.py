"""Corners of printed patterns: triangulate them from the photos and compute the scale from known distances.

Notation: a corner p is seen from camera centres c_i in unit directions d_i, where a pixel is 1 / f_i radians wide.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import nearest_to_rays
from nerfcli.captures.scale.estimate import ScaleEstimate
from nerfcli.errors import UserError, several

# A corner is used if two of its directions differ by at least this; with less, its depth is hardly known.
_LEAST_PARALLAX = np.radians(1.0)

# Corners whose rays miss each other by more than this are wrong: the pattern was moved, or there are two of it.
_MOST_MISSED_PX = 5.0

# For normal errors: standard deviation / median absolute deviation, and standard error of the median / of the mean.
_SIGMA_PER_MAD = 1.4826
_MEDIAN_PER_MEAN = 1.2533


@dataclass(frozen=True)
class Side:
    """Two corners of a printed pattern and their true distance in metres; `name` is for people."""

    name: str
    first: Hashable
    second: Hashable
    metres: float


# Sightings of each corner, by any key: the frame's index, and the pixel (x, y) with pixel centres at 0.5.
Sightings = Mapping[Any, Sequence[tuple[int, np.ndarray]]]


def scale_from_corners(
    frames: Sequence[Frame], sightings: Sightings, sides: Sequence[Side], *, pattern: str
) -> ScaleEstimate:
    """Estimate metres per unit: the median over all sides of their known length divided by their triangulated length.

    The standard error is that of the median of as many independent errors as there are sides, with their spread from
    the median absolute deviation: a corner's error along one side of a square does not affect the adjacent side. It
    excludes errors that all sides share, such as from a wrong focal length. Residuals are means over sides of one name.

    Args:
        pattern: its description for messages and the source, such as "ArUco markers of 0.05 m".

    Raises:
        UserError: no side has two corners seen in two photos, in directions that differ enough, whose rays meet.
    """
    points, reasons = triangulate(frames, sightings)
    measured_sides = [side for side in sides if side.first in points and side.second in points]
    lengths = np.array([np.linalg.norm(points[side.first] - points[side.second]) for side in measured_sides])
    if not len(lengths) or not lengths.min() > 0:
        raise _no_scale(pattern, sightings, list(reasons.values()))
    metres = np.array([side.metres for side in measured_sides])
    scale = float(np.median(metres / lengths))
    deviation = _SIGMA_PER_MAD * float(np.median(np.abs(metres / lengths - scale)))
    named: dict[str, list[float]] = {}
    for side, ratio in zip(measured_sides, scale * lengths / metres, strict=True):
        named.setdefault(side.name, []).append(100 * (float(ratio) - 1))
    return ScaleEstimate(
        metres_per_unit=scale,
        standard_error=_MEDIAN_PER_MEAN * deviation / math.sqrt(len(measured_sides)),
        residuals=tuple((name, float(np.mean(values))) for name, values in named.items()),
        residual_unit="percent",
        source=f"{pattern}, {len(measured_sides)} sides",
    )


def triangulate(frames: Sequence[Frame], sightings: Sightings) -> tuple[dict[Any, np.ndarray], dict[Any, str]]:
    """Return the points (3,) that photos show in several places, and why the others cannot be triangulated."""
    points: dict[Any, np.ndarray] = {}
    reasons: dict[Any, str] = {}
    for corner, rays in _rays(frames, sightings).items():
        point = _triangulated(rays)
        if isinstance(point, str):
            reasons[corner] = point
        else:
            points[corner] = point
    return points, reasons


def _rays(frames: Sequence[Frame], sightings: Sightings) -> dict[Any, list[tuple[Frame, np.ndarray]]]:
    """Return, for each corner, the frames that see it and the unit directions (3,) in which their cameras do."""
    pixels: dict[int, list[tuple[Any, np.ndarray]]] = {}
    for corner, seen in sightings.items():
        for index, pixel in seen:
            pixels.setdefault(index, []).append((corner, pixel))
    rays: dict[Any, list[tuple[Frame, np.ndarray]]] = {corner: [] for corner in sightings}
    for index, found in pixels.items():
        # All pixels of a lens at once: one by one takes twenty times as long.
        directions, valid = frames[index].camera.bearings(np.array([pixel for _, pixel in found]))
        for (corner, _), direction, there in zip(found, directions, valid, strict=True):
            if there:
                rays[corner].append((frames[index], direction))
    return rays


def _triangulated(rays: Sequence[tuple[Frame, np.ndarray]]) -> np.ndarray | str:
    """Return the point (3,) where the rays meet, or the reason why there is none."""
    if len({frame.name for frame, _ in rays}) < 2:
        return "visible in only one photo"
    c = np.stack([frame.centre for frame, _ in rays])
    d = np.stack([frame.world_from_cam[:3, :3] @ direction for frame, direction in rays])
    f = np.array([frame.camera.focal_px for frame, _ in rays])
    if (d @ d.T).min() > np.cos(_LEAST_PARALLAX):
        return "visible only from nearly the same direction"
    point, missed = nearest_in_pixels(c, d, f)
    if np.median(missed) > _MOST_MISSED_PX:
        return f"its rays miss each other by {np.median(missed):.1f} px"
    if np.median(np.sum((point - c) * d, axis=1)) <= 0:
        return "its rays intersect behind the cameras"
    return point


def nearest_in_pixels(c: np.ndarray, d: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the point (3,) nearest to rays in terms of pixels, and by how many pixels each ray misses it, (n,).

    p = argmin sum_i log(1 + e_i^2),  e_i = f_i |(1 - d_i d_i^T) (p - c_i)| / |p - c_i|

    The errors e_i are in pixels; the logarithm (Cauchy) limits the effect of a wrong ray.

    Args:
        c, d: (n, 3) origins and unit directions, n >= 2, not all parallel.
        f: (n,) pixels per radian.
    """

    def pixels_per_length(offsets: np.ndarray) -> np.ndarray:
        return f / np.maximum(np.linalg.norm(offsets, axis=1), 1e-150)

    def weigh(off: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        squared = pixels_per_length(offsets) ** 2
        return squared / (1 + squared * off**2)

    point = nearest_to_rays(c, d, weigh)
    off = np.linalg.norm(np.cross(d, point - c), axis=1)
    return point, pixels_per_length(point - c) * off


def _no_scale(pattern: str, sightings: Sightings, reasons: Sequence[str]) -> UserError:
    if not sightings:
        return UserError(
            f"no photo shows the {pattern}",
            "check the dictionary and the size, and that the pattern is large enough in the photos",
        )
    photos = len({index for seen in sightings.values() for index, _ in seen})
    most = max(set(reasons), key=reasons.count) if reasons else "no side has two triangulated corners"
    return UserError(
        f"no scale from the {pattern} in {several(photos, 'photo')}: {len(reasons)} of {len(sightings)}"
        f" corners cannot be triangulated, mostly {most}",
        "the pattern must not move, and at least two photos must show it from different directions",
    )
