"""The phantom itself: its chords beside quadrature, and beside the closed form of a sphere."""

import numpy as np
import pytest
from ellipsoids import Ellipsoid, attenuation_at, attenuation_of_voxels, bean, line_integrals, sphere


@pytest.mark.parametrize("distance", [0.0, 1.0, 1.999999, 2.0, 2.5])
def test_chord_of_a_sphere(distance: float) -> None:
    """Closed form: 2 sqrt(r^2 - d^2), for a direction of any length."""
    origin, direction = np.array([[1 + distance, -50.0, 3.0]]), np.array([[0, 7.0, 0]])
    expected = 2 * np.sqrt(max(4 - distance**2, 0))
    assert sphere((1, 2, 3), 2, 1.0).chords(origin, direction) == pytest.approx(expected, abs=1e-7)


def test_line_integrals_are_those_of_quadrature() -> None:
    """Independent: a sum of the attenuation at 200,000 points of each line."""
    rng = np.random.default_rng(3)
    origins = rng.normal(0, 3, (6, 3))
    directions = rng.normal(0, 1, (6, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    t = (np.arange(200_000) + 0.5) / 200_000 * 60 - 30
    along = origins[:, None] + t[:, None] * directions[:, None]
    expected = attenuation_at(bean(), along).sum(1) * 60 / len(t)
    assert line_integrals(bean(), origins, directions) == pytest.approx(expected, abs=2e-4)


def test_mass_of_voxels_is_the_volume_of_the_ellipsoid() -> None:
    """Closed form: 4/3 pi abc times the attenuation, in a tilted ellipsoid; 1 % for voxels of 1/8 of an axis."""
    solid = Ellipsoid((0.3, -0.2, 0.1), (3, 2, 2.5), 0.7, turn=0.4, tilt=1.1)
    axis = (np.arange(28) - 13.5) * 0.25
    voxels = attenuation_of_voxels([solid], x=axis, y=axis, z=axis, samples=2)
    assert voxels.sum() * 0.25**3 == pytest.approx(0.7 * 4 / 3 * np.pi * 3 * 2 * 2.5, rel=0.01)
