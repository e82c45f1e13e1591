"""A phantom of ellipsoids whose line integrals have a closed form: truth of tomography that no projector is part of."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Ellipsoid:
    """A solid ellipsoid that adds `attenuation` to what is around it; negative values make a cavity.

    Args:
        centre: (x, y, z).
        semi_axes: lengths along its own x, y and z; three equal ones make a sphere.
        attenuation: per unit of length.
        turn: radians about z, counter-clockwise seen from +z.
        tilt: radians about x, before the turn.
    """

    centre: tuple[float, float, float]
    semi_axes: tuple[float, float, float]
    attenuation: float
    turn: float = 0.0
    tilt: float = 0.0

    @property
    def world_from_own(self) -> np.ndarray:
        """(3, 3) rotation."""
        c, s = np.cos(self.turn), np.sin(self.turn)
        cos, sin = np.cos(self.tilt), np.sin(self.tilt)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])

    def chords(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(...) lengths that straight lines have inside; directions (..., 3) of any length but 0.

        Formula: in coordinates where the ellipsoid is the unit ball, 2 sqrt(1 - m^2) |d| / |d'|, with m the distance of
        the line from the centre, d the direction outside and d' the direction there.
        """
        start = ((origins - np.array(self.centre)) @ self.world_from_own) / np.array(self.semi_axes)
        slope = (directions @ self.world_from_own) / np.array(self.semi_axes)
        squared = dot(slope, slope)
        nearest = start - (dot(start, slope) / squared)[..., None] * slope
        inside = np.maximum(1 - dot(nearest, nearest), 0)
        return 2 * np.sqrt(inside) * np.sqrt(dot(directions, directions) / squared)

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(...) whether points (..., 3) are inside."""
        own = ((points - np.array(self.centre)) @ self.world_from_own) / np.array(self.semi_axes)
        return dot(own, own) <= 1


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(...) scalar products of vectors (..., 3); sums along a last axis of three take several times as long."""
    return np.einsum("...i,...i->...", a, b)


Phantom = Sequence[Ellipsoid]


def sphere(centre: tuple[float, float, float], radius: float, attenuation: float) -> Ellipsoid:
    """A solid sphere."""
    return Ellipsoid(centre, (radius, radius, radius), attenuation)


def line_integrals(phantom: Phantom, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(...) integrals of the attenuation along straight lines without end, float64."""
    return sum(
        (solid.attenuation * solid.chords(origins, directions) for solid in phantom), np.zeros(origins.shape[:-1])
    )


def attenuation_at(phantom: Phantom, points: np.ndarray) -> np.ndarray:
    """(...) attenuation at points (..., 3)."""
    return sum((solid.attenuation * solid.holds(points) for solid in phantom), np.zeros(points.shape[:-1]))


def attenuation_of_voxels(
    phantom: Phantom, *, x: np.ndarray, y: np.ndarray, z: np.ndarray, samples: int = 3
) -> np.ndarray:
    """(Z, Y, X) attenuation in cubic voxels with these centres, each averaged over samples^3 points."""
    sides = [np.diff(axis[:2]) for axis in (x, y, z) if len(axis) > 1]
    size = float(sides[0][0]) if sides else 1.0
    offsets = size * ((np.arange(samples) + 0.5) / samples - 0.5)
    total = np.zeros((len(z), len(y), len(x)))
    for dz in offsets:
        for dy in offsets:
            for dx in offsets:
                total += _attenuation_on_grid(phantom, x + dx, y + dy, z + dz)
    return total / samples**3


def _attenuation_on_grid(phantom: Phantom, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(Z, Y, X) attenuation at the points of a grid; a solid is sought only in the box around its largest ball."""
    total = np.zeros((len(z), len(y), len(x)))
    for solid in phantom:
        radius = 1.001 * max(solid.semi_axes)
        near = [np.abs(axis - c) <= radius for axis, c in zip((x, y, z), solid.centre, strict=True)]
        own = [axis[kept] for axis, kept in zip((x, y, z), near, strict=True)]
        points = np.stack(np.meshgrid(*own[::-1], indexing="ij")[::-1], axis=-1)
        total[np.ix_(*near[::-1])] += solid.attenuation * solid.holds(points)
    return total


def bean(scale: float = 1.0) -> list[Ellipsoid]:
    """A body with two inclusions, a cavity and a small dense ball, within 10 * scale of the origin.

    It has no symmetry, so that a wrong direction of rotation, a mirrored or a shifted detector cannot look right.
    Attenuations are chosen for line integrals of about 2 at any scale.
    """
    parts = [
        Ellipsoid((0, 0, 0), (8, 6, 7), 0.12, turn=0.3),
        Ellipsoid((3.5, 1.0, 1.5), (1.5, 2.5, 2.0), 0.10, turn=-0.5, tilt=0.4),
        Ellipsoid((-3.5, -2.0, -1.0), (2.0, 1.2, 2.5), 0.08, turn=0.8),
        sphere((-2.0, 2.5, 2.0), 1.4, -0.12),
        sphere((1.0, -3.5, -2.5), 0.8, 0.5),
    ]
    return [
        Ellipsoid(
            (scale * p.centre[0], scale * p.centre[1], scale * p.centre[2]),
            (scale * p.semi_axes[0], scale * p.semi_axes[1], scale * p.semi_axes[2]),
            p.attenuation / scale,
            p.turn,
            p.tilt,
        )
        for p in parts
    ]
