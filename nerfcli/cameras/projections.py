"""Projections of directions onto the plane before distortion: one class per projection of COLMAP's models.

A projection maps directions d = (x, y, z) in camera axes to a plane q with unit focal length; rho = |(x, y)| and theta
is the angle between d and the optical axis. Coordinates come first: directions are (3, N), points of the plane (2, N).
Each class says which directions it `sees`; `plane` and the two Jacobians are defined only for those.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

# Below this ratio of rho to z, differences of nearly equal terms are replaced by their series, whose first omitted term
# is below 1e-13 of the sum.
SERIES_BELOW = 0.05


class Projection(Protocol):
    """A map from directions to the plane, one to one on the directions that it sees."""

    def sees(self, directions: np.ndarray) -> np.ndarray:
        """Return whether directions (3, N) of any length are in the domain; (N,) bool."""

    def plane(self, directions: np.ndarray) -> np.ndarray:
        """Project unit directions (3, N) onto the plane, (2, N)."""

    def directions(self, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Invert `plane`: return unit directions (3, N), and whether each exists, (N,) bool."""

    def jacobian(self, directions: np.ndarray) -> np.ndarray:
        """Return d plane / d direction at unit directions, (2, 3, N)."""

    def parameter_jacobian(self, directions: np.ndarray) -> np.ndarray:
        """Return d plane / d parameters in the order of the class's fields, (2, parameters, N)."""
        return np.zeros((2, 0, directions.shape[1]))


@dataclass(frozen=True)
class Perspective(Projection):
    """q = (x, y) / z, in front of the camera."""

    def sees(self, directions: np.ndarray) -> np.ndarray:
        return directions[2] > 0

    def plane(self, directions: np.ndarray) -> np.ndarray:
        return directions[:2] / directions[2]

    def directions(self, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _unit(plane, np.ones(plane.shape[1]))

    def jacobian(self, directions: np.ndarray) -> np.ndarray:
        z = directions[2]
        return _jacobian(1 / z, np.zeros_like(z), directions[:2], by_z=-1 / (z * z))


@dataclass(frozen=True)
class Equidistant(Projection):
    """q = theta (x, y) / rho: the radius in the plane is the angle, for all directions except straight behind.

    Source: Kannala and Brandt 2006, A generic camera model for wide-angle lenses, eq. 6, which OpenCV's fisheye
    module follows.
    """

    def sees(self, directions: np.ndarray) -> np.ndarray:
        return (directions[2] > 0) | (directions[0] != 0) | (directions[1] != 0)

    def plane(self, directions: np.ndarray) -> np.ndarray:
        return _angle_over_rho(directions) * directions[:2]

    def directions(self, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = np.sqrt(plane[0] ** 2 + plane[1] ** 2)
        return np.stack([*(_sine_over(angle) * plane), np.cos(angle)]), angle < np.pi

    def jacobian(self, directions: np.ndarray) -> np.ndarray:
        square = (directions**2).sum(axis=0)
        return _jacobian(_angle_over_rho(directions), _angle_bend(directions), directions[:2], by_z=-1 / square)


@dataclass(frozen=True)
class FieldOfView(Projection):
    """q = atan(t rho / z) / omega * (x, y) / rho with t = 2 tan(omega / 2), in front of the camera.

    It is the equidistant projection of the direction (t x, t y, z), divided by omega; at omega = 0 it is the
    perspective one. The model is published for perspective radii, so it ends at 90 degrees, where |q| = pi / (2 omega).
    COLMAP's own formula uses a series with two wrong signs at |omega| < 0.01 and differs there by up to 1e-4 of q.

    Args:
        omega: in radians, between -pi and pi; its sign has no effect.

    Source: Devernay and Faugeras 2001, Straight lines have to be straight, eq. 13.
    """

    omega: float

    def sees(self, directions: np.ndarray) -> np.ndarray:
        return directions[2] > 0

    def plane(self, directions: np.ndarray) -> np.ndarray:
        return self._growth() * _angle_over_rho(self._stretched(directions)) * directions[:2]

    def directions(self, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = np.sqrt(plane[0] ** 2 + plane[1] ** 2) * abs(self.omega)
        directions, _ = _unit(_sine_over(angle) / self._growth() * plane, np.cos(angle))
        return directions, angle < np.pi / 2

    def jacobian(self, directions: np.ndarray) -> np.ndarray:
        stretched, stretch = self._stretched(directions), self._stretch()
        square = (stretched**2).sum(axis=0)
        return self._growth() * _jacobian(
            _angle_over_rho(stretched), stretch**2 * _angle_bend(stretched), directions[:2], by_z=-1 / square
        )

    def parameter_jacobian(self, directions: np.ndarray) -> np.ndarray:
        stretched, stretch, omega = self._stretched(directions), self._stretch(), self.omega
        stretch_slope = 1 + stretch**2 / 4
        if abs(omega) < SERIES_BELOW:
            growth_slope = omega / 6 + omega**3 / 30 + 17 * omega**5 / 3360
        else:
            growth_slope = (stretch_slope - stretch / omega) / omega
        rho_square = directions[0] ** 2 + directions[1] ** 2
        bend = _angle_bend(stretched) * rho_square * stretch * stretch_slope * self._growth()
        return ((_angle_over_rho(stretched) * growth_slope + bend) * directions[:2])[:, None]

    def _stretch(self) -> float:
        return 2 * float(np.tan(self.omega / 2))

    def _growth(self) -> float:
        """Return t / omega, 1 at omega = 0: the scale at the centre relative to the perspective projection."""
        return self._stretch() / self.omega if self.omega else 1.0

    def _stretched(self, directions: np.ndarray) -> np.ndarray:
        return directions * np.array([self._stretch(), self._stretch(), 1.0])[:, None]


@dataclass(frozen=True)
class EnhancedUnified(Projection):
    """q = (x, y) / (alpha d + (1 - alpha) z) with d = sqrt(beta rho^2 + z^2).

    It sees z > -w d. The limit is w = alpha / (1 - alpha), where the denominator becomes 0, or, for alpha > 1/2,
    w = (1 - alpha) / alpha, where the radius turns back.

    Args:
        alpha: in [0, 1]; 0 is the perspective projection.
        beta: above 0.

    Source: Khomutenko, Garcia and Martinet 2016, An enhanced unified camera model, eqs. 7 to 13.
    """

    alpha: float
    beta: float

    def sees(self, directions: np.ndarray) -> np.ndarray:
        limit = min(self.alpha, 1 - self.alpha) / max(self.alpha, 1 - self.alpha)
        return directions[2] > -limit * self._depth(directions)

    def plane(self, directions: np.ndarray) -> np.ndarray:
        return directions[:2] / self._denominator(directions)

    def directions(self, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        alpha, square = self.alpha, self.beta * (plane[0] ** 2 + plane[1] ** 2)
        radicand = 1 - (2 * alpha - 1) * square
        root = np.sqrt(np.maximum(radicand, 0.0))
        directions, valid = _unit(plane, (1 - alpha**2 * square) / (alpha * root + 1 - alpha))
        return directions, valid & (radicand > 0)

    def jacobian(self, directions: np.ndarray) -> np.ndarray:
        alpha, depth = self.alpha, self._depth(directions)
        inverse = 1 / self._denominator(directions)
        across = -(inverse**2) * alpha * self.beta / depth
        by_z = -(inverse**2) * (alpha * directions[2] / depth + 1 - alpha)
        return _jacobian(inverse, across, directions[:2], by_z=by_z)

    def parameter_jacobian(self, directions: np.ndarray) -> np.ndarray:
        depth, rho_square = self._depth(directions), directions[0] ** 2 + directions[1] ** 2
        slopes = np.stack([depth - directions[2], self.alpha * rho_square / (2 * depth)])
        return -directions[:2, None] * slopes / self._denominator(directions) ** 2

    def _depth(self, directions: np.ndarray) -> np.ndarray:
        return np.sqrt(self.beta * (directions[0] ** 2 + directions[1] ** 2) + directions[2] ** 2)

    def _denominator(self, directions: np.ndarray) -> np.ndarray:
        # For z < 0 the two terms cancel; the difference of squares gives d - |z| without cancellation.
        z, depth = directions[2], self._depth(directions)
        rest = self.beta * (directions[0] ** 2 + directions[1] ** 2) / (depth + np.abs(z))  # d - |z|
        return np.where(z > 0, self.alpha * depth + (1 - self.alpha) * z, self.alpha * rest - (1 - 2 * self.alpha) * -z)


@dataclass(frozen=True)
class Division(Projection):
    """q with (q, 1 + k |q|^2) along the direction: q = 2 (x, y) / (z + S) with S = sqrt(z^2 - 4 k rho^2).

    With k < 0 (a barrel) the third component falls below zero at |q| = (-k)^-1/2, and the model goes on behind the
    camera; with k > 0 the radius turns back at |q| = k^-1/2.

    Source: Fitzgibbon 2001, Simultaneous linear estimation of multiple view geometry and lens distortion, eq. 2,
    extended to omnidirectional cameras as in Micusik and Pajdla 2003.
    """

    k: float

    def sees(self, directions: np.ndarray) -> np.ndarray:
        x, y, z = directions
        if self.k < 0:
            return (z > 0) | (x != 0) | (y != 0)
        return (z > 0) & (z * z > 4 * self.k * (x * x + y * y))

    def plane(self, directions: np.ndarray) -> np.ndarray:
        return self._factor(directions) * directions[:2]

    def directions(self, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stretch = self.k * (plane[0] ** 2 + plane[1] ** 2)
        directions, valid = _unit(plane, 1 + stretch)
        return directions, valid & (stretch < 1)

    def jacobian(self, directions: np.ndarray) -> np.ndarray:
        factor, root = self._factor(directions), self._root(directions)
        return _jacobian(factor, 2 * self.k * factor**2 / root, directions[:2], by_z=-factor / root)

    def parameter_jacobian(self, directions: np.ndarray) -> np.ndarray:
        rho_square = directions[0] ** 2 + directions[1] ** 2
        return (self._factor(directions) ** 2 * rho_square / self._root(directions) * directions[:2])[:, None]

    def _root(self, directions: np.ndarray) -> np.ndarray:
        return np.sqrt(directions[2] ** 2 - 4 * self.k * (directions[0] ** 2 + directions[1] ** 2))

    def _factor(self, directions: np.ndarray) -> np.ndarray:
        z, root = directions[2], self._root(directions)
        if self.k >= 0:
            return 2 / (z + root)
        # Behind the camera z + S cancels; the other form of the quadratic's root does not.
        behind = (root - z) / (-2 * self.k * np.where(z < 0, directions[0] ** 2 + directions[1] ** 2, 1.0))
        return np.where(z < 0, behind, 2 / np.where(z < 0, 1.0, z + root))


@dataclass(frozen=True)
class Equirectangular(Projection):
    """q = (atan2(x, z) / 2 pi, atan2(y, |(x, z)|) / pi): the whole sphere except its two poles, on [-1/2, 1/2]^2."""

    def sees(self, directions: np.ndarray) -> np.ndarray:
        return (directions[0] != 0) | (directions[2] != 0)

    def plane(self, directions: np.ndarray) -> np.ndarray:
        x, y, z = directions
        return np.stack([np.arctan2(x, z) / (2 * np.pi), np.arctan2(y, np.hypot(x, z)) / np.pi])

    def directions(self, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        azimuth, elevation = 2 * np.pi * plane[0], np.pi * plane[1]
        level = np.cos(elevation)
        directions = np.stack([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])
        return directions, np.asarray((np.abs(plane) <= 0.5).all(axis=0))

    def jacobian(self, directions: np.ndarray) -> np.ndarray:
        x, y, z = directions
        level = np.hypot(x, z)
        by_azimuth = np.stack([z, np.zeros_like(z), -x]) / (2 * np.pi * level**2)
        by_elevation = np.stack([-x * y / level, level, -z * y / level]) / (np.pi * (level**2 + y**2))
        return np.stack([by_azimuth, by_elevation])


def _unit(plane: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit directions along (plane, z), and whether the length of (plane, z) is finite."""
    length = np.sqrt(plane[0] ** 2 + plane[1] ** 2 + z * z)
    return np.stack([*(plane / length), z / length]), np.asarray(np.isfinite(length))


def _jacobian(factor: np.ndarray, bend: np.ndarray, xy: np.ndarray, *, by_z: np.ndarray) -> np.ndarray:
    """Return d q / d direction of q = factor (x, y), where d factor = bend (x dx + y dy) + by_z dz; (2, 3, N)."""
    x, y = xy
    skew = bend * x * y
    return np.stack(
        [np.stack([factor + bend * x * x, skew, by_z * x]), np.stack([skew, factor + bend * y * y, by_z * y])]
    )


def _sine_over(angle: np.ndarray) -> np.ndarray:
    """Return sin(angle) / angle, 1 at 0."""
    safe = np.where(angle > 0, angle, 1.0)
    return np.where(angle > 0, np.sin(safe) / safe, 1.0)


def _angle_over_rho(directions: np.ndarray) -> np.ndarray:
    """Return theta / rho of directions of any length; 1 / z on the optical axis."""
    rho = np.sqrt(directions[0] ** 2 + directions[1] ** 2)
    on_axis = rho == 0
    if not on_axis.any():
        return np.arctan2(rho, directions[2]) / rho
    angle = np.where(on_axis, 1.0, np.arctan2(rho, directions[2]))
    return angle / np.where(on_axis, directions[2], rho)


def _angle_bend(directions: np.ndarray) -> np.ndarray:
    """Return (d (theta / rho) / d rho) / rho = (z / (rho^2 + z^2) - theta / rho) / rho^2."""
    z, rho_square = directions[2], directions[0] ** 2 + directions[1] ** 2
    near = (z > 0) & (rho_square < (SERIES_BELOW * z) ** 2)
    safe_z = np.where(near, z, 1.0)
    square = np.where(near, rho_square, 0.0) / safe_z**2
    series = (-2 / 3 + square * (4 / 5 - square * (6 / 7 - square * (8 / 9 - square * 10 / 11)))) / safe_z**3
    exact = (z / (rho_square + z * z) - _angle_over_rho(directions)) / np.where(near, 1.0, rho_square)
    return np.where(near, series, exact)
