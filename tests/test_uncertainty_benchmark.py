"""benchmarks/uncertainty.py: its statistics against closed forms and loops."""

import numpy as np
import pytest
import uncertainty

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.render.coverage import small_frame


@pytest.mark.parametrize("count", [2, 5, 8])
def test_seeds_of_the_distribution_of_the_truth_hold_it_as_stated(count):
    """The positive control: truth and seeds are drawn from the same Gaussian, a different one per pixel."""
    rng, pixels = np.random.default_rng(count), 40_000
    middle, deviation = rng.normal(size=pixels), rng.exponential(size=pixels)
    drawn = middle + deviation * rng.normal(size=(count + 1, pixels))
    for level in (0.5, 0.9):
        assert uncertainty.held_by_interval(drawn[1:], drawn[0], level=level) == pytest.approx(level, abs=0.01)
    # The truth is off by ten times the deviation of the seeds.
    assert uncertainty.held_by_interval(drawn[1:], drawn[0] + 10 * deviation, level=0.5) < 0.1


def test_the_area_under_the_roc_is_the_fraction_of_pairs_in_order():
    rng = np.random.default_rng(0)
    values, positive = rng.integers(0, 5, 300).astype(float), rng.random(300) < 0.4
    pairs = [(one > other) + 0.5 * (one == other) for one in values[positive] for other in values[~positive]]
    assert uncertainty.area_under_roc(values, positive) == pytest.approx(np.mean(pairs))
    assert np.isnan(uncertainty.area_under_roc(values[:40], positive[:40]))


def test_a_spread_that_is_the_error_marks_all_that_is_wrong_and_coverage_that_is_unrelated_marks_none():
    rng, pixels = np.random.default_rng(0), 20_000
    true, size = rng.uniform(1, 3, pixels), rng.exponential(0.1, pixels)
    # Of two other seeds, one is as far above the truth as the deployed one, and one as far below.
    seeds = np.stack([true + size, true + size, true - size])
    seeds[0, :100] = np.nan
    found = uncertainty.summary(seeds, true, rng.integers(0, 3, pixels).astype(float))
    assert found["all"]["pixels"] == pixels - 100 == sum(found[name]["pixels"] for name in list(found)[1:])
    assert found["all"]["correlation"] == pytest.approx(1.0)
    assert found["all"]["interval holds"] == 1.0
    assert found["all"]["ROC spread"] > 0.95
    assert found["all"]["ROC coverage"] == pytest.approx(0.5, abs=0.02)


def test_true_distances_of_a_wall_are_those_along_the_rays():
    """A plane at z = 2: the distance is 2 / cosine, in pixels of a tenth of the resolution."""
    photo = Frame("a", Camera.pinhole(640, 480, 500.0), np.eye(4))
    view = small_frame(photo, 64)
    bearings, _ = view.camera.pixel_bearings()
    found = uncertainty.true_distances([view], [np.full((480, 640), 2.0)])
    np.testing.assert_allclose(found * bearings[:, 2], 2.0)
