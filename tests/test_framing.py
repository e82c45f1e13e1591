"""Pictures of another size, crop or lens: against projections of points, which move with the picture."""

import numpy as np
import pytest
from captures import CAMERAS
from hypothesis import given
from hypothesis import strategies as st

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.framing import cropped, sized, with_lens
from nerfcli.errors import UserError

PERSPECTIVE = [camera for camera in CAMERAS.values() if not camera.is_spherical]


@given(camera=st.sampled_from(PERSPECTIVE), width=st.integers(1, 3000), height=st.integers(1, 3000))
def test_another_size_scales_and_cuts_and_never_stretches(camera, width, height):
    """Pixel p moves to s (p - old middle) + new middle, with the same s for both axes that covers the new size."""
    new = sized(camera, width, height)
    assert (new.width, new.height) == (width, height)
    scale = max(width / camera.width, height / camera.height)
    points = np.random.default_rng(0).normal((0, 0, 3), (0.5, 0.5, 0.3), (20, 3))
    before, valid = camera.project(points)
    after, still = new.project(points)
    np.testing.assert_array_equal(still, valid)
    middle = np.array([camera.width, camera.height]) / 2
    expected = scale * (before - middle) + np.array([width, height]) / 2
    np.testing.assert_allclose(after[valid], expected[valid], rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize(("width", "height", "size"), [(320, None, (320, 240)), (None, 96, (128, 96))])
def test_with_one_of_width_and_height_the_other_follows(width, height, size):
    new = sized(Camera("PINHOLE", 640, 480, (500.0, 505.0, 321.25, 238.5)), width, height)
    assert (new.width, new.height) == size
    assert new.params == tuple(size[0] / 640 * value for value in (500.0, 505.0, 321.25, 238.5))


@given(camera=st.sampled_from(PERSPECTIVE), data=st.data())
def test_pixels_of_a_part_see_what_they_saw(camera, data):
    x = data.draw(st.integers(0, camera.width - 1))
    y = data.draw(st.integers(0, camera.height - 1))
    size = data.draw(st.integers(1, camera.width - x)), data.draw(st.integers(1, camera.height - y))
    part = cropped(camera, x, y, *size)
    assert part.size == size
    corners = np.array([(0.5, 0.5), np.subtract(size, 0.5)])
    seen, valid = part.bearings(corners)
    whole, also = camera.bearings(corners + np.array([x, y]))
    np.testing.assert_array_equal(valid, also)
    np.testing.assert_allclose(seen[valid], whole[valid], rtol=0, atol=1e-9)


@pytest.mark.parametrize("window", [(0, 0, 0, 5), (-1, 0, 5, 5), (630, 0, 11, 5), (0, 476, 5, 5)])
def test_a_part_outside_of_the_picture_is_refused(window):
    with pytest.raises(UserError, match="is not inside a picture of 640x480") as caught:
        cropped(Camera.pinhole(640, 480, 500.0), *window)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("lens", "fov"), [("pinhole", 90.0), ("pinhole", 170.0), ("fisheye", 180.0), ("fisheye", 300.0)]
)
def test_the_angle_of_view_is_that_between_the_edges(lens, fov):
    """Closed form: half the angle off the axis at the middle of the left and the right edge."""
    camera = with_lens(Camera("OPENCV", 640, 480, (500.0, 505.0, 300, 250, 0.1, 0.01, 0, 0)), lens, fov)
    seen, valid = camera.bearings(np.array([[0.0, 240.0], [640.0, 240.0], [320.0, 240.0]]))
    assert valid.all()
    half = np.radians(fov) / 2
    expected = [[-np.sin(half), 0, np.cos(half)], [np.sin(half), 0, np.cos(half)], [0, 0, 1]]
    np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-12)


def test_what_a_fisheye_of_a_full_turn_does_not_see_is_no_ray():
    """Radius = w / 2 at 180 degrees off the axis: the corners of a square picture lie beyond."""
    camera = with_lens(Camera.pinhole(64, 64, 50.0), "fisheye", 360.0)
    _, valid = camera.pixel_bearings()
    x, y = np.meshgrid(np.arange(64) + 0.5 - 32, np.arange(64) + 0.5 - 32)
    np.testing.assert_array_equal(valid.reshape(64, 64), np.hypot(x, y) < 32)


def test_a_picture_of_all_directions():
    camera = with_lens(Camera.pinhole(640, 480, 500.0), "equirectangular", None)
    assert (camera.width, camera.height) == (960, 480)
    # Left of the middle by a quarter of the width is 90 degrees to the left, and the upper edge is straight up.
    seen, _ = camera.bearings(np.array([[480.0, 240.0], [240.0, 240.0], [480.0, 0.0]]))
    np.testing.assert_allclose(seen, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], rtol=0, atol=1e-12)
    with pytest.raises(UserError, match="500x300"):
        sized(camera, 500, 300)
    with pytest.raises(UserError, match="cannot be cropped"):
        cropped(camera, 0, 0, 10, 10)


@pytest.mark.parametrize(
    ("lens", "fov"),
    [("pinhole", 180.0), ("pinhole", 0.0), ("fisheye", 361.0), ("fisheye", np.nan), ("equirectangular", 90.0)],
)
def test_an_angle_that_a_lens_cannot_have(lens, fov):
    with pytest.raises(UserError, match="--fov") as caught:
        with_lens(Camera.pinhole(640, 480, 500.0), lens, fov)
    assert caught.value.exit_code == 2
