"""Every model against COLMAP's own C++, and FOV against its closed form."""

import numpy as np
import pycolmap
from examples import examples
from hypothesis import assume, given
from hypothesis import strategies as st
from lenses import HEIGHT, MODELS, WIDTH, random_camera, random_directions

from nerfcli.cameras.camera import Camera

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
    size = np.abs(expected)
    allowed = 1e-8 + 1e-11 * size + 100 * np.finfo(float).eps * size * size.max(axis=-1, keepdims=True) / WIDTH
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
