"""Cameras: bearings by hand and in closed form, sizes, records, and turning with the photo."""

import json

import numpy as np
import pytest
from captures import CAMERAS
from examples import examples
from hypothesis import example, given
from hypothesis import strategies as st

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.orientation import Picture, fit_to_picture, turned
from nerfcli.errors import UserError

WIDTH, HEIGHT = 128, 96
WITH_FOCAL = [model for model in CAMERAS if model != "EQUIRECTANGULAR"]
ENDS_AT_90 = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "FOV")


def camera_of(model: str) -> Camera:
    return CAMERAS[model].resized(WIDTH, HEIGHT if model in WITH_FOCAL else WIDTH // 2)


def pixel_grid(camera: Camera) -> np.ndarray:
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def directions_within(angle_rad: float, *, count: int = 400, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    angle, azimuth = rng.uniform(0, angle_rad, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=-1)


def test_pixel_bearings_go_row_by_row_through_pixel_centres():
    camera = camera_of("OPENCV")
    directions, valid = camera.pixel_bearings()
    expected, expected_valid = camera.bearings(pixel_grid(camera))
    np.testing.assert_array_equal(directions, expected)
    np.testing.assert_array_equal(valid, expected_valid)


@given(k=st.integers(-600, 600).map(lambda thousandth: thousandth / 1000), radius=st.floats(0.01, 1.5))
@example(k=0.1, radius=1.1)  # root 1: the table of radii used to end there, and the pixel to be invalid
@examples(60)
def test_simple_radial_bearing_is_the_smallest_root_of_its_cubic_or_invalid(k, radius):
    """r (1 + k r^2) = radius: closed form through the roots of the cubic, at any strength of the distortion."""
    camera = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, (100.0, 50.0, 40.0, k))
    directions, valid = camera.bearings(np.array([[50 + 100 * radius, 40.0]]))
    roots = np.roots([k, 0.0, 1.0, -radius]) if k else np.array([radius])
    real = np.sort(np.real(roots[np.abs(np.imag(roots)) < 1e-9]))
    real = real[real > 0]
    turn = np.sqrt(-1 / (3 * k)) if k < 0 else np.inf
    inside = real[real < turn * (1 - 1e-3)]
    if len(inside):
        assert valid[0]
        np.testing.assert_allclose(directions[0, 0] / directions[0, 2], inside[0], rtol=1e-8)
    elif not (len(real) and real[0] < turn * (1 + 1e-3)):  # within a thousandth of the turn either answer will do
        assert not valid[0]
        np.testing.assert_array_equal(directions[0], [0, 0, 1])


@pytest.mark.parametrize("model", WITH_FOCAL)
def test_no_model_sees_straight_behind_and_perspective_ones_nothing_behind(model):
    behind = [[0, 0, -1.0], *([[0.1, 0.1, -1.0], [1, 0, 0]] if model in ENDS_AT_90 else [])]
    assert not camera_of(model).project(np.array(behind))[1].any()


@pytest.mark.parametrize("model", CAMERAS)
def test_a_resized_camera_sees_the_same_in_scaled_pixels(model):
    camera = camera_of(model)
    size = (camera.width // 2, camera.height // 2)
    half, pixels = camera.resized(*size), pixel_grid(camera)
    directions, valid = camera.bearings(pixels)
    halved, halved_valid = half.bearings(pixels / 2)
    assert half.size == size
    np.testing.assert_array_equal(halved_valid, valid)
    np.testing.assert_allclose(halved, directions, rtol=0, atol=1e-9)
    assert half.resized(*camera.size).params == pytest.approx(camera.params)


def test_resizing_allows_for_rounding_and_refuses_another_shape():
    camera = Camera.pinhole(1081, 1920, 1000.0)
    assert camera.resized(1081, 1920) is camera
    eighth = camera.resized(135, 240)
    np.testing.assert_allclose(eighth.params, (1000 * 135 / 1081, 125, 67.5, 120))
    with pytest.raises(UserError, match="1920x1081 pixels does not match a camera of 1081x1920"):
        camera.resized(1920, 1081)
    with pytest.raises(UserError, match="500x500 pixels"):
        camera.resized(500, 500)


def test_field_of_view_and_focal_length_by_hand():
    camera = Camera.pinhole(200, 100, 100.0)
    np.testing.assert_allclose(camera.fov_deg, (90.0, np.degrees(2 * np.arctan(0.5))))
    assert camera.focal_px == 100
    assert camera.principal_point == (100, 50)
    fisheye = Camera("SIMPLE_FISHEYE", 200, 100, (100.0, 100.0, 50.0))  # radius = f * angle
    np.testing.assert_allclose(fisheye.fov_deg, np.degrees((2.0, 1.0)))
    assert Camera("PINHOLE", 10, 10, (90.0, 110.0, 5.0, 5.0)).focal_px == 100
    sphere = camera_of("EQUIRECTANGULAR")
    assert sphere.fov_deg == (360, 180)
    beyond_half_a_turn = Camera("SIMPLE_FISHEYE", 400, 100, (100.0, 100.0, 50.0))  # the left edge is 57 degrees off
    np.testing.assert_allclose(beyond_half_a_turn.fov_deg, np.degrees((4.0, 1.0)))
    assert sphere.focal_px == pytest.approx(128 / (2 * np.pi))
    assert sphere.undistorted().model == "PINHOLE"


def test_a_camera_survives_json_and_is_a_key():
    for model in CAMERAS:
        camera = camera_of(model)
        back = Camera.from_json(json.loads(json.dumps(camera.to_json())))
        assert back == camera
        assert hash(back) == hash(camera)


@pytest.mark.parametrize(
    ("model", "size", "params", "what"),
    [
        ("PINHOL", (4, 4), (1, 1, 1, 1), "unknown camera model 'PINHOL'"),
        ("INVALID", (4, 4), (), "unknown camera model"),
        ("PINHOLE", (4, 4), (1, 1, 1), "PINHOLE has 4 parameters, got 3"),
        ("PINHOLE", (0, 4), (1, 1, 1, 1), "0x4 pixels"),
        ("PINHOLE", (4, 4), (1, -1, 1, 1), "invalid parameters"),
        ("SIMPLE_PINHOLE", (4, 4), (float("nan"), 1, 1), "invalid parameters"),
        ("SIMPLE_RADIAL", (4, 4), (1, 1, 1, 1e31), "invalid parameters"),
        ("EUCM", (4, 4), (1, 1, 1, 1, 1.01, 1), "invalid parameters"),
        ("EUCM", (4, 4), (1, 1, 1, 1, 0.5, 0), "invalid parameters"),
        ("FOV", (4, 4), (1, 1, 1, 1, 3.2), "invalid parameters"),
        ("EQUIRECTANGULAR", (4, 4), (4, 0), "invalid parameters"),
    ],
)
def test_what_is_no_camera_is_refused(model, size, params, what):
    with pytest.raises(UserError, match=what):
        Camera(model, size[0], size[1], params)


def test_json_that_is_no_camera_is_refused():
    with pytest.raises(UserError, match="not a valid camera: KeyError: 'params'"):
        Camera.from_json({"model": "PINHOLE", "width": 3, "height": 3})


def upright_pixels(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return where pixels of a stored WIDTH x HEIGHT picture are in the picture turned by its EXIF orientation."""
    u, v = pixels.T
    return {3: np.stack([WIDTH - u, HEIGHT - v], 1), 6: np.stack([HEIGHT - v, u], 1), 8: np.stack([v, WIDTH - u], 1)}[
        orientation
    ]


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("model", WITH_FOCAL)
def test_a_turned_camera_sees_the_world_in_the_upright_picture(model, orientation):
    stored = camera_of(model)
    world_from_stored = rigid.look_at(np.array([1.0, 2, 3]), np.zeros(3), np.array([0, 0, 1.0]))
    upright, world_from_upright = turned(stored, world_from_stored, orientation=orientation)
    assert (upright.width, upright.height) == ((WIDTH, HEIGHT) if orientation == 3 else (HEIGHT, WIDTH))
    in_world = rigid.apply(world_from_stored, directions_within(np.radians(35)))
    before, _ = stored.project(rigid.apply(rigid.inverse(world_from_stored), in_world))
    after, valid = upright.project(rigid.apply(rigid.inverse(world_from_upright), in_world))
    assert valid.all()
    np.testing.assert_allclose(after, upright_pixels(before, orientation), rtol=0, atol=1e-9)


def test_a_calibration_is_fitted_to_the_picture_on_disk(tmp_path):
    camera, pose, path = Camera("PINHOLE", 100, 80, (80, 79, 51, 39)), np.eye(4), tmp_path / "a.jpg"
    # Stored on its side, shown upright; the calibration is for the stored pixels, or already for the upright ones.
    for calibrated in (camera, turned(camera, pose, orientation=6)[0]):
        fitted, _ = fit_to_picture(calibrated, pose, Picture(path, 40, 50, 6))
        assert (fitted.width, fitted.height) == (40, 50)
        np.testing.assert_allclose(fitted.params, (39.5, 40, 20.5, 25.5))
    untouched, same = fit_to_picture(camera, pose, Picture(path, 100, 80, 1))
    assert untouched is camera
    assert same is pose
    with pytest.raises(UserError, match=r"a\.jpg: a picture of 90x90 pixels does not match a camera of 100x80"):
        fit_to_picture(camera, pose, Picture(path, 90, 90, 1))
    with pytest.raises(UserError, match="orientation 5 mirrors"):
        fit_to_picture(camera, pose, Picture(path, 80, 100, 5))
    with pytest.raises(UserError, match=r"a\.jpg: a spherical picture with EXIF orientation 6"):
        fit_to_picture(camera_of("EQUIRECTANGULAR"), pose, Picture(path, 80, 100, 6))


def test_a_picture_contains_its_left_and_upper_edge_but_not_the_others():
    camera = Camera.pinhole(4, 3, 5.0)
    pixels = np.array([[0.0, 0.0], [3.999, 2.999], [4.0, 1.0], [1.0, 3.0], [-0.001, 1.0], [1.0, -0.001], [np.nan, 1.0]])
    assert camera.contains(pixels).tolist() == [True, True, False, False, False, False, False]
