"""Every model against COLMAP's own C++, OpenCV's projection functions and the closed forms of the papers."""

import cv2
import numpy as np
import pycolmap
import pytest
from examples import examples
from hypothesis import assume, given
from hypothesis import strategies as st
from lenses import HEIGHT, MODELS, WIDTH, random_camera, random_directions

from nerfcli.cameras.camera import Camera, parameter_names

seeds = st.integers(0, 2**32 - 1)
many = examples(100)
few = examples(40)

# COLMAP projects points on all sides with these models; with the others it mirrors points behind the camera.
ALL_AROUND_IN_COLMAP = ("EUCM", "SIMPLE_DIVISION", "DIVISION", "EQUIRECTANGULAR")


def colmap_of(camera: Camera) -> pycolmap.Camera:
    return pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=list(camera.params))


def assert_same_pixels(pixels: np.ndarray, expected: np.ndarray) -> None:
    """Assert equality to 1e-8 px within the size of a picture, and to as many digits far outside of it.

    Pixels beyond 1e6 px are beside a pole of the model, where digits cancel in its denominator: the relative error of
    rounding is multiplied by how much farther out they are than a picture is wide.
    """
    allowed = 1e-8 + 1e-11 * np.abs(expected) + 100 * np.finfo(float).eps * np.square(expected) / WIDTH
    np.testing.assert_array_less(np.abs(pixels - expected), allowed)


def has_colmaps_wrong_series(camera: Camera) -> bool:
    """Return whether COLMAP projects by the series of its own inverse (omega to 0.01): 0.1 px off the closed form."""
    return camera.model == "FOV" and abs(camera.params[4]) <= 0.01


@given(model=st.sampled_from(MODELS), seed=seeds, strength=st.sampled_from([0.0, 1.0, 5.0]))
@many
def test_projection_agrees_with_colmap(model, seed, strength):
    rng = np.random.default_rng(seed)
    camera, points = random_camera(model, rng, strength=strength), random_directions(rng) * rng.uniform(0.1, 100)
    assume(not has_colmaps_wrong_series(camera))
    pixels, valid = camera.project(points)
    shared = valid if model in ALL_AROUND_IN_COLMAP else valid & (points[:, 2] > 0)
    if model == "FOV":  # within 0.01 of the axis COLMAP takes a series, good to 1e-6 px
        shared &= np.hypot(points[:, 0], points[:, 1]) > 0.0101 * points[:, 2]
    assert shared.sum() > 30
    expected = np.asarray(colmap_of(camera).img_from_cam(points, check_cheirality=False))
    assert_same_pixels(pixels[shared], expected[shared])


@given(model=st.sampled_from(MODELS), seed=seeds)
@many
def test_bearings_agree_with_colmap(model, seed):
    """COLMAP's undistortion stops after a step of 1e-5, which leaves an error of 1e-10 rad or, near the turn, 1e-8."""
    rng = np.random.default_rng(seed)
    camera = random_camera(model, rng)
    assume(not has_colmaps_wrong_series(camera))
    points = random_directions(rng)
    points = points[points[:, 2] > 0.3]
    pixels, seen = camera.project(points)
    seen &= (pixels > 0).all(axis=1) & (pixels < (WIDTH, HEIGHT)).all(axis=1)
    weakest = np.linalg.svd(camera.project_jacobian(points)[0], compute_uv=False)[:, 1]
    seen &= weakest > 0.1 * camera.focal_px
    directions, valid = camera.bearings(pixels[seen])
    assert valid.all()
    expected = np.asarray(colmap_of(camera).cam_ray_from_img(pixels[seen]))
    np.testing.assert_allclose(directions, expected, rtol=0, atol=1e-7 if model == "FOV" else 1e-8)


@given(seed=seeds, model=st.sampled_from(["PINHOLE", "OPENCV", "FULL_OPENCV"]))
@few
def test_perspective_models_and_their_derivatives_agree_with_opencv(seed, model):
    """cv2.projectPoints also gives derivatives by translation, focal length, centre and distortion, in closed form."""
    rng = np.random.default_rng(seed)
    camera = random_camera(model, rng)
    directions = random_directions(rng)
    points = directions[directions[:, 2] > 0.4] * rng.uniform(0.5, 5)
    fx, fy, cx, cy, *distortion = camera.params
    matrix, terms = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(distortion or [0.0] * 4)
    expected, derivatives = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, terms)
    derivatives = np.asarray(derivatives).reshape(-1, 2, derivatives.shape[1])
    pixels, valid = camera.project(points)
    by_point, by_parameters, _ = camera.project_jacobian(points)
    assert_same_pixels(pixels[valid], np.reshape(expected, (-1, 2))[valid])
    np.testing.assert_allclose(by_point[valid], derivatives[valid, :, 3:6], rtol=1e-10, atol=1e-9)
    columns = derivatives[valid, :, 6 : 6 + len(camera.params)]
    np.testing.assert_allclose(by_parameters[valid], columns, rtol=1e-10, atol=1e-9)


@given(seed=seeds)
@few
def test_the_fisheye_and_its_derivatives_agree_with_opencv(seed):
    rng = np.random.default_rng(seed)
    camera = random_camera("OPENCV_FISHEYE", rng)
    directions = random_directions(rng)
    points = directions[directions[:, 2] > 0.1] * rng.uniform(0.5, 5)
    fx, fy, cx, cy, *terms = camera.params
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    expected, derivatives = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(terms)
    )
    derivatives = np.asarray(derivatives).reshape(-1, 2, 15)  # f, c, k, rotation, translation, skew
    pixels, valid = camera.project(points)
    by_point, by_parameters, _ = camera.project_jacobian(points)
    assert_same_pixels(pixels[valid], np.reshape(expected, (-1, 2))[valid])
    # OpenCV treats a point within 1e-8 of the axis as being on it.
    off_axis = valid & (np.hypot(points[:, 0], points[:, 1]) > 1e-5 * points[:, 2])
    np.testing.assert_allclose(by_point[off_axis], derivatives[off_axis, :, 11:14], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(by_parameters[off_axis], derivatives[off_axis, :, :8], rtol=1e-9, atol=1e-9)


@given(seed=seeds, xi=st.floats(0.0, 1.0))
@few
def test_eucm_with_beta_1_is_opencvs_omnidirectional_model(seed, xi):
    """Mei's x / (z + xi |d|) is EUCM's with alpha = xi / (1 + xi), f = (1 + xi) f_eucm; behind the camera too."""
    rng = np.random.default_rng(seed)
    camera = Camera("EUCM", WIDTH, HEIGHT, (300.0, 310.0, 590.0, 460.0, xi / (1 + xi), 1.0))
    points = random_directions(rng) * rng.uniform(0.5, 5)
    matrix = np.array([[300.0 * (1 + xi), 0, 590], [0, 310.0 * (1 + xi), 460], [0, 0, 1]])
    expected, _ = cv2.omnidir.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, xi, np.zeros(4))
    pixels, valid = camera.project(points)
    near = valid & (np.abs(pixels) < 1e5).all(axis=1)
    assert (points[near, 2] < 0).any() or xi < 0.05
    assert_same_pixels(pixels[near], np.reshape(expected, (-1, 2))[near])


@given(seed=seeds, omega=st.one_of(st.floats(1e-12, 3.0), st.just(0.0)), sign=st.sampled_from([-1, 1]))
@few
def test_the_fov_model_is_its_closed_form_down_to_omega_0(seed, omega, sign):
    camera = Camera("FOV", WIDTH, HEIGHT, (300.0, 310.0, 590.0, 460.0, sign * omega))
    points = random_directions(np.random.default_rng(seed))
    points = points[points[:, 2] > 0.2]
    ratio = points[:, :2] / points[:, 2:]
    radius = np.linalg.norm(ratio, axis=1, keepdims=True)
    bend = np.arctan(2 * np.tan(omega / 2) * radius) / (omega * radius) if omega else 1.0
    pixels, valid = camera.project(points)
    assert valid.all()
    assert_same_pixels(pixels, ratio * bend * (300, 310) + (590, 460))
    directions, valid = camera.bearings(pixels)
    assert valid.all()
    np.testing.assert_allclose(directions, points, rtol=0, atol=1e-12)


@given(seed=seeds, k=st.floats(-2, 2))
@few
def test_the_division_model_is_its_closed_form(seed, k):
    """A pixel at q sees along (q, 1 + k |q|^2)."""
    camera = Camera("DIVISION", WIDTH, HEIGHT, (300.0, 310.0, 590.0, 460.0, k))
    plane = np.random.default_rng(seed).normal(size=(200, 2))
    expected = np.concatenate([plane, 1 + k * (plane**2).sum(axis=1, keepdims=True)], axis=1)
    directions, valid = camera.bearings(plane * (300, 310) + (590, 460))
    np.testing.assert_array_equal(valid, k * (plane**2).sum(axis=1) < 1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(directions[valid], expected[valid], rtol=0, atol=1e-12)
    pixels, seen = camera.project(1e3 * expected[valid])
    inner = k * (plane[valid] ** 2).sum(axis=1) < 0.999  # at the turn the radius has no slope
    assert seen[inner].all()
    assert_same_pixels(pixels[inner], (plane * (300, 310) + (590, 460))[valid][inner])


def test_a_panorama_is_longitude_and_latitude():
    camera = Camera("EQUIRECTANGULAR", 3600, 1800, (3600.0, 1800.0))
    longitude, latitude = np.meshgrid(np.radians(np.arange(-179.0, 180.0, 7)), np.radians(np.arange(-89.0, 90.0, 6)))
    points = np.stack(
        [np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)], axis=-1
    )
    pixels, valid = camera.project(points.reshape(-1, 3))
    assert valid.all()
    expected = np.stack([1800 + 10 * np.degrees(longitude), 900 - 10 * np.degrees(latitude)], axis=-1)
    np.testing.assert_allclose(pixels, expected.reshape(-1, 2), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("simple", "full"), [("SIMPLE_RADIAL", "FULL_OPENCV"), ("RADIAL_FISHEYE", "OPENCV_FISHEYE")])
def test_a_model_with_zeros_is_the_smaller_model(simple, full):
    values = {"f": 300.0, "fx": 300.0, "fy": 300.0, "cx": 610.0, "cy": 440.0, "k": -0.1, "k1": -0.1}
    if simple == "RADIAL_FISHEYE":
        values["k2"] = 0.02
    one, other = (
        Camera(model, WIDTH, HEIGHT, tuple(values.get(name, 0.0) for name in parameter_names(model)))
        for model in (simple, full)
    )
    points = random_directions(np.random.default_rng(0))
    for answer, expected in zip(one.project(points), other.project(points), strict=True):
        np.testing.assert_allclose(answer, expected, rtol=0, atol=1e-9)
