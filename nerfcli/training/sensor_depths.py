"""Depths that sensors measured, as known distances: registered to the photos, scaled and checked by what photos see.

The sensor's unit may differ from the scene's, and its view from the photo's: many captures hold the maps of a second
camera beside the photo's. Both follow from points whose distance is known from photos, by tracks and stereo matching.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from nerfcli.cameras.camera import Camera
from nerfcli.errors import UserError, listed, several
from nerfcli.matching.stereo import DenseDepth
from nerfcli.matching.tracks import indices_by_value
from nerfcli.photos.sensor_depth import DepthReadings, read_sensor_depth
from nerfcli.training.pool import PixelPool, PointDepths

# The depths of a sensor and of a point agree within the first fraction. A point with the second one as its error counts
# half for a registration.
AGREES, HALF_SCORE = 0.1, 0.03
# With fewer points, or if a smaller part of them agrees, the depths of a capture are not used; nor those of a photo
# that has so many points.
FEWEST_POINTS, FEWEST_OF_PHOTO, LEAST_AGREEING = 100, 20, 0.5
# The scale and the registration are from at most so many photos and points.
MOST_PHOTOS, MOST_POINTS = 60, 20_000
# Searches for a registration begin at these zooms. One is used if it raises the score by this factor: for a Kinect,
# whose depth camera sees 0.9 of what its colour camera sees, by 1.3; for depths in the photo's view, by 1.01.
ZOOMS, LEAST_RISE = (1.0, 0.85, 1.2), 1.05
# Pixels are left out in squares of this part of the photo's longer side in which more points disagree than agree.
SQUARE = 1 / 32
# More pixels, of all photos together, take memory and tell no more.
MOST_PIXELS = 4_000_000
# Standard deviation of a normal distribution, relative to the median of absolute values.
SIGMA_PER_MEDIAN = 1.4826


@dataclass(frozen=True)
class Registration:
    """Where a sensor sees what a photo sees: q - 1/2 = zoom (p - 1/2) + shift + parallax / z.

    p and q are positions in the photo and in the map, as fractions of width and height, z is in the sensor's unit. This
    is exact for two pinhole cameras that look in the same direction.
    """

    zoom: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    parallax: tuple[float, float] = (0.0, 0.0)

    def in_map(self, positions: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return where the map shows what is at positions (N, 2) of the photo and at z (N,)."""
        return self.zoom * (positions - 0.5) + 0.5 + self._moved(z)

    def in_photo(self, positions: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return where the photo shows what is at positions (N, 2) of the map and at z (N,)."""
        return (positions - 0.5 - self._moved(z)) / self.zoom + 0.5

    def _moved(self, z: np.ndarray) -> np.ndarray:
        return np.array(self.shift) + np.array(self.parallax) / z[:, None]


@dataclass(frozen=True)
class SeenPoints:
    """Points of a photo, as fractions (N, 2) of width and height, whose z (N,), scene units, is known from photos."""

    positions: np.ndarray
    z: np.ndarray


@dataclass(frozen=True)
class Fit:
    """How the depths of a sensor fit the points of photos.

    Args:
        scale: scene units per unit of the sensor.
        score: mean over compared points of 1 / (1 + (relative error / 3 %)^2).
        compared: number of points where the sensor has a depth.
        agreeing: fraction of these that agree within 10 %.
        spread: standard deviation of the relative errors, from their median.
        typical_z: median depth of the points, in the sensor's unit.
    """

    registration: Registration
    scale: float
    score: float
    compared: int
    agreeing: float
    spread: float
    typical_z: float

    def errors(self, points: SeenPoints, z: np.ndarray) -> np.ndarray:
        """Return the logarithm of a map's depth relative to that of points, (N,); NaN where it has none."""
        return _log_ratios(points, z, self.registration, self.scale) + math.log(self.scale)


def sensor_depths(known: PointDepths, pool: PixelPool, *, notify: Callable[[str], None]) -> list[DenseDepth]:
    """Return the pixels of each photo whose depth a sensor has measured; none if the photos do not confirm it.

    error = spread max(1, z / median z) / confidence

    Args:
        known: pixels whose distance is known from photos.
        notify: receives what is used, the agreement, and what is left out.
    """
    points, unreadable = seen_points(known, pool), dict[str, str]()
    measured = [i for i, frame in enumerate(pool.frames) if frame.depth is not None and not frame.camera.is_spherical]
    sample = [measured[i] for i in np.unique(np.linspace(0, len(measured) - 1, MOST_PHOTOS).round().astype(int))]
    fit = fitted([(points[i], readings.z) for i, readings in _read(pool, sample, unreadable)])
    depths = [DenseDepth(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0)) for _ in pool.frames]
    if fit is None or fit.agreeing < LEAST_AGREEING:
        why = "too few points that photos see have one" if fit is None else f"only {_agreement(fit)}"
        notify("; ".join((f"the depths of the sensor are not used: {why}", *_unread(unreadable))))
        return depths
    differing, off, total = list[str](), 0, 0
    for i, readings in _read(pool, measured, unreadable):
        camera, errors = pool.cameras[i], fit.errors(points[i], readings.z)
        compared, differs = np.isfinite(errors), np.abs(errors) > AGREES
        if compared.sum() >= FEWEST_OF_PHOTO and differs.sum() > (1.0 - LEAST_AGREEING) * compared.sum():
            differing.append(pool.frames[i].name)
            continue
        places, z, confidence = pixels_in_photo(readings, camera, fit.registration, most=MOST_PIXELS // len(measured))
        votes = np.where(compared, np.where(differs, 1, -1), 0)
        kept = ~_outvoted(places, points[i].positions * camera.size, votes, camera)
        off, total = off + int((~kept).sum()), total + len(kept)
        cosines = _cosines(camera, places + 0.5)
        kept &= cosines > 0
        distances = z[kept] * fit.scale / cosines[kept]
        expected = fit.spread * np.maximum(1.0, z[kept] / fit.typical_z) / confidence[kept]
        depths[i] = DenseDepth(places[kept], distances, expected)
    parts = [
        f"depths of the sensor: {total - off:,} pixels, {fit.scale:.4g} scene units per metre, {_agreement(fit)}",
        *(
            [f"its view differs from the photos': it is {1 / fit.registration.zoom:.2f} times as wide"]
            if fit.registration != Registration()
            else []
        ),
        f"left out where points disagree: {100 * off / max(1, total):.1f} % of the pixels"
        + (f", and all of {several(len(differing), 'photo')}: {listed(differing)}" if differing else ""),
        *_unread(unreadable),
    ]
    notify("; ".join(parts))
    return depths


def _agreement(fit: Fit) -> str:
    return f"{100 * fit.agreeing:.0f} % of {fit.compared:,} points that photos see agree within {100 * AGREES:.0f} %"


def _unread(unreadable: dict[str, str]) -> list[str]:
    """Describe the maps that could not be read, by the names of their photos, with the first reason."""
    if not unreadable:
        return []
    return [f"{several(len(unreadable), 'map')} left out: {next(iter(unreadable.values()))}"]


def _read(pool: PixelPool, chosen: Sequence[int], unreadable: dict[str, str]) -> Iterator[tuple[int, DepthReadings]]:
    """Yield the maps of photos, each with its photo's number; note those that cannot be read."""
    for i in chosen:
        frame = pool.frames[i]
        assert frame.depth is not None
        assert frame.image is not None
        try:
            yield i, read_sensor_depth(frame.depth, frame.image)
        except UserError as error:
            unreadable[frame.name] = error.message


def seen_points(known: PointDepths, pool: PixelPool) -> list[SeenPoints]:
    """Return known distances as the points of each photo."""
    numbers, distances = known.numbers.cpu().numpy(), known.distances.cpu().numpy().astype(np.float64)
    by_photo = indices_by_value(pool.photo_of(known.numbers).cpu().numpy(), len(pool.cameras))
    found = []
    for camera, first, own in zip(pool.cameras, pool.first_pixel.tolist(), by_photo, strict=True):
        row, column = np.divmod(numbers[own] - first, camera.width)
        pixels = np.stack([column, row], axis=-1) + 0.5
        z = distances[own] * _cosines(camera, pixels) / pool.training_from_scene.scale
        found.append(SeenPoints((pixels / camera.size)[z > 0], z[z > 0]))
    return found


def fitted(seen: Sequence[tuple[SeenPoints, np.ndarray]]) -> Fit | None:
    """Fit the scale of a sensor's maps and, if their view is not that of the photos, their registration.

    Args:
        seen: the points of photos, each with the photo's map of z, (H, W), NaN where it has none.

    Returns:
        None if fewer than `FEWEST_POINTS` points have a depth.
    """
    every = 1 + sum(len(points.z) for points, _ in seen) // MOST_POINTS
    seen = [(SeenPoints(points.positions[::every], points.z[::every]), z) for points, z in seen]
    plain = _fit(seen, Registration(), 1.0)
    if plain is None:
        return None

    def registration(x: np.ndarray) -> Registration:
        zoom, *moved = x.tolist()
        return Registration(zoom, (moved[0], moved[1]), (moved[2] * plain.typical_z, moved[3] * plain.typical_z))

    def negative_score(x: np.ndarray) -> float:
        fit = _fit(seen, registration(x), plain.scale)
        return 0.0 if fit is None or fit.compared < plain.compared / 2 else -fit.score

    best = plain
    for zoom in ZOOMS:
        start = np.array([zoom, 0.0, 0.0, 0.0, 0.0])
        simplex = np.concatenate([start[None], start + np.diag([0.05, 0.02, 0.02, 0.01, 0.01])])
        found = minimize(
            negative_score, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 300}
        )
        fit = _fit(seen, registration(found.x), plain.scale)
        if fit is not None and fit.score > max(LEAST_RISE * plain.score, best.score):
            best = fit
    return best


def _fit(seen: Sequence[tuple[SeenPoints, np.ndarray]], registration: Registration, scale: float) -> Fit | None:
    """Return the fit of a registration, with `scale` as an estimate of its scale."""
    ratios = np.concatenate([_log_ratios(points, z, registration, scale) for points, z in seen] or [np.zeros(0)])
    there = ratios[np.isfinite(ratios)]
    if len(there) < FEWEST_POINTS:
        return None
    middle = np.median(there)
    for _ in range(3):  # the mode of the errors: what differs does not shift it
        weights = 1.0 / (1.0 + np.square((there - middle) / HALF_SCORE))
        middle = (weights * there).sum() / weights.sum()
    errors = np.abs(there - middle)
    fitted_scale = math.exp(-middle)
    return Fit(
        registration,
        scale=fitted_scale,
        score=float((1.0 / (1.0 + np.square(errors / HALF_SCORE))).mean()),
        compared=len(there),
        agreeing=float((errors < AGREES).mean()),
        spread=float(SIGMA_PER_MEDIAN * np.median(errors)),
        typical_z=float(np.median(np.concatenate([points.z for points, _ in seen]))) / fitted_scale,
    )


def _log_ratios(points: SeenPoints, z: np.ndarray, registration: Registration, scale: float) -> np.ndarray:
    """Return the logarithm of a map's nearest depth, in its unit, over that of points, (N,); NaN where it has none."""
    height, width = z.shape
    column, row = np.floor(registration.in_map(points.positions, points.z / scale) * (width, height)).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    depths = z[row.clip(0, height - 1), column.clip(0, width - 1)].astype(np.float64)
    return np.log(np.where(inside, depths, np.nan) / points.z)


def pixels_in_photo(
    readings: DepthReadings, camera: Camera, registration: Registration, *, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels (N, 2) of a photo that show what a map has measured, with its z (N,) and confidence (N,).

    Each depth goes to one pixel, the nearest; between sparse ones, nothing is filled in. Of several depths in a pixel,
    the smallest hides the others.

    Args:
        camera: of the photo, at the size of the training.
        most: number of pixels of the map that are used, evenly chosen.
    """
    height, width = readings.z.shape
    stride = math.ceil(math.sqrt(height * width / most)) if height * width > most else 1
    chosen = np.zeros((height, width), bool)
    chosen[stride // 2 :: stride, stride // 2 :: stride] = True
    row, column = np.nonzero(chosen & np.isfinite(readings.z))
    z, confidence = readings.z[row, column].astype(np.float64), readings.confidence[row, column]
    positions = (np.stack([column, row], axis=-1) + 0.5) / (width, height)
    places = np.floor(registration.in_photo(positions, z) * camera.size).astype(np.int64)
    inside = ((places >= 0) & (places < camera.size)).all(axis=1)
    order = np.flatnonzero(inside)[np.argsort(z[inside], kind="stable")]
    _, nearest = np.unique(places[order] @ (1, camera.width), return_index=True)
    kept = order[nearest]
    return places[kept], z[kept], confidence[kept]


def _outvoted(places: np.ndarray, pixels: np.ndarray, votes: np.ndarray, camera: Camera) -> np.ndarray:
    """Return which places (N, 2) lie in squares where the sum of the votes (M,) at pixels (M, 2) is positive."""
    side = SQUARE * max(camera.size)
    across = math.ceil(camera.width / side) + 1

    def squares(at: np.ndarray) -> np.ndarray:
        return (at // side).astype(np.int64) @ (1, across)

    count = across * (math.ceil(camera.height / side) + 1)
    return np.bincount(squares(pixels), votes, count)[squares(places)] > 0


def _cosines(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return z of the unit directions of pixels (N, 2); 0 where there is none."""
    directions, valid = camera.bearings(pixels)
    return np.where(valid, directions[:, 2], 0.0)
