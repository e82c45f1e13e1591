"""Inverse depths of pairs of cameras that moved forward, on the walls of `test_stereo`."""

from dataclasses import replace

import numpy as np
import pytest
from test_stereo import NORMALS, PINHOLE, photo, truth

from nerfcli.matching import pair_stereo
from nerfcli.matching.pair_stereo import forward_depths
from nerfcli.matching.stereo_view import view_of
from nerfcli.photos.loading import LoadedPhoto


def walls(count: int = 400) -> np.ndarray:
    """Points (N, 3) of the walls."""
    x, y = np.random.default_rng(1).uniform(-1.5, 1.5, (2, count))
    return np.stack([x, y, ((3.0 - x[:, None] * NORMALS[:, 0]) / NORMALS[:, 2]).min(-1)], axis=-1)


def matched(one: LoadedPhoto, other: LoadedPhoto) -> tuple[np.ndarray, np.ndarray]:
    found = forward_depths(view_of(one, 200), view_of(other, 200), walls())
    assert found is not None
    return found


@pytest.mark.parametrize("z", [0.5, -0.5], ids=["ahead", "behind"])
@pytest.mark.parametrize("x", [0.0, 0.7], ids=["in view", "epipole outside"])
def test_inverse_depths_of_a_pair_are_unbiased(x, z):
    one, other = photo(0.0), photo(x * z, z=z)
    rho, errors = matched(one, other)
    distances, _ = truth(PINHOLE, one.frame.world_from_cam)
    bearings = PINHOLE.pixel_bearings()[0].reshape(150, 200, 3)
    off = rho * distances * bearings[..., 2] - 1.0
    known = np.isfinite(off)
    assert known.mean() > 0.4
    assert abs(np.median(off[known])) < 0.01  # 0.1 columns
    assert np.percentile(np.abs(off[known]) / (errors * distances * bearings[..., 2])[known], 68) < 1.0
    assert np.isfinite(errors).all()


def test_the_centre_towards_which_the_camera_moves_has_no_depth():
    rho, _ = matched(photo(0.0), photo(0.0, z=0.4))
    assert np.isnan(rho[70:80, 95:105]).all()  # less than 0.05 * 180 px from the epipole


NOTHING = {
    "the same place": (0.0, 0.0, 400),
    "beside": (0.5, 0.1, 400),
    "too few points": (0.0, 0.5, 11),
    "beyond the points": (0.0, 9.0, 400),
}


@pytest.mark.parametrize("case", NOTHING)
def test_pairs_without_forward_motion_or_points_are_left_alone(case):
    x, z, count = NOTHING[case]
    assert forward_depths(view_of(photo(0.0), 200), view_of(photo(x, z=z), 200), walls(count)) is None


def test_views_in_opposite_directions_are_left_alone():
    one, other = photo(0.0), photo(0.0, z=0.5, turned=np.pi)
    assert forward_depths(view_of(one, 200), view_of(other, 200), walls()) is None


def test_points_at_twice_the_distance_of_the_second_camera_are_shifted_by_the_logarithm_of_two():
    points = np.array([[0.5, 0.3, 2.0]] * 20)
    assert pair_stereo._range(points, 1.0) == pytest.approx((0.85 * np.log(2.0), 1.15 * np.log(2.0)))
    assert pair_stereo._range(points, -2.0) == pytest.approx((0.85 * np.log(2.0), 1.15 * np.log(2.0)))
    assert pair_stereo._range(points, 1.99) is None  # magnified 200 times
    assert pair_stereo._range(points, 3.0) is None  # behind the second camera
    near = np.concatenate([points, np.array([[0.1, 0.1, 1.1]] * 20)])  # magnified 11 times
    assert pair_stereo._range(near, 1.0) == (0.0, pytest.approx(np.log(pair_stereo.MOST_MAGNIFICATION)))


def test_nothing_is_sampled_from_behind_a_view():
    """A view to the right, at 80 degrees from the baseline, shows directions at 75 degrees on the right only."""
    one = photo(0.0, turned=np.radians(80.0))
    view = view_of(replace(one, pixels=np.full_like(one.pixels, 200)), 200)
    phi = np.linspace(-np.pi, np.pi, 90, dtype=np.float32)
    sampled = pair_stereo._sampled(view, np.eye(3), np.log(np.array([3.7], np.float32)), phi)
    assert np.all(sampled[np.abs(phi) < 0.3] == 200)
    assert not sampled[np.abs(phi) > np.pi / 2].any()
