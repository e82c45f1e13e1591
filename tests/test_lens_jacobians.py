"""Derivatives of pixels and bearings against differences of sixth order and against what geometry demands."""

from collections.abc import Callable

import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from lenses import HEIGHT, MODELS, WIDTH, random_camera, random_directions, random_pixels

from nerfcli.cameras.camera import Camera

seeds = st.integers(0, 2**32 - 1)
models = st.sampled_from(MODELS)
many = examples(60)

# Central differences of sixth order: f'(0) = sum of weight * f(offset * step) / step.
STENCIL = {-3: -1 / 60, -2: 3 / 20, -1: -3 / 4, 1: 3 / 4, 2: -3 / 20, 3: 1 / 60}


def difference(evaluate: Callable[[float], tuple[np.ndarray, np.ndarray]], step: float) -> np.ndarray:
    """Return the derivative at 0 of a function that also says where it is valid; NaN where some step is not."""
    values = {offset: evaluate(offset * step) for offset in STENCIL}
    derivative = sum(weight * values[offset][0] for offset, weight in STENCIL.items()) / step
    return np.where(np.all([valid for _, valid in values.values()], axis=0)[:, None], derivative, np.nan)


def assert_is_derivative(
    answer: np.ndarray, evaluate: Callable[[float], tuple[np.ndarray, np.ndarray]], *, step: float, noise: float
) -> None:
    """Assert the answer (N, columns) to 1e-8 of its largest entry, wherever halving the step confirms the difference.

    `noise` is the rounding error of `evaluate`.
    """
    coarse, fine = difference(evaluate, step), difference(evaluate, step / 2)
    tolerance = 1e-8 * max(np.nanmax(np.abs(fine), initial=0), 1e-3) + 4 * noise / step
    trusted = np.abs(fine - coarse) < tolerance
    assert trusted.mean() > 0.8
    assert np.abs(answer - fine)[trusted].max(initial=0) <= tolerance


def well_inside(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return the points that are not close to where the model turns or goes to infinity."""
    _, valid = camera.project(points)
    singular = np.linalg.svd(camera.project_jacobian(points)[0], compute_uv=False)
    singular *= np.linalg.norm(points, axis=1)[:, None]
    return points[valid & (singular[:, 1] > 0.3 * camera.focal_px) & (singular[:, 0] < 3 * camera.focal_px)]


@given(model=models, seed=seeds, strength=st.sampled_from([0.0, 1.0, 5.0]))
@many
def test_pixels_move_with_points_as_differences_say(model, seed, strength):
    rng = np.random.default_rng(seed)
    camera = random_camera(model, rng, strength=strength)
    points = well_inside(camera, random_directions(rng))
    if model == "EQUIRECTANGULAR":  # away from its seam, where x jumps by the width
        points = points[np.abs(points[:, 0]) > 0.05]
    by_point, _, valid = camera.project_jacobian(points)
    assert valid.all()
    for index, axis in enumerate(np.eye(3)):
        assert_is_derivative(
            by_point[:, :, index], lambda h, axis=axis: camera.project(points + h * axis), step=4e-3, noise=1e-12
        )


@given(model=models, seed=seeds, strength=st.sampled_from([0.0, 1.0, 5.0]))
@many
def test_pixels_move_with_parameters_as_differences_say(model, seed, strength):
    rng = np.random.default_rng(seed)
    camera = random_camera(model, rng, strength=strength)
    points = well_inside(camera, random_directions(rng))
    by_parameters = camera.project_jacobian(points)[1]
    for index, value in enumerate(camera.params):
        step = 2e-3 * max(abs(value), 0.02)
        if model == "EUCM" and index == 4:
            step = min(step, value / 4, (1 - value) / 4)

        def changed(h: float, index: int = index, value: float = value) -> tuple[np.ndarray, np.ndarray]:
            params = (*camera.params[:index], value + h, *camera.params[index + 1 :])
            return Camera(model, WIDTH, HEIGHT, params).project(points)

        assert_is_derivative(by_parameters[:, :, index], changed, step=step, noise=1e-12)


@given(model=models, seed=seeds, exponent=st.integers(-120, 120))
@many
def test_a_pixel_does_not_move_along_its_ray_and_the_scale_of_the_scene_divides_out(model, seed, exponent):
    """Euler: J(point) point = 0, and J(s point) = J(point) / s, across magnitudes."""
    rng = np.random.default_rng(seed)
    camera, scale = random_camera(model, rng), 10.0**exponent
    points = well_inside(camera, random_directions(rng))
    by_point, by_parameters, _ = camera.project_jacobian(points)
    size = np.abs(by_point).max(axis=(1, 2), keepdims=True)
    assert (np.abs(by_point @ points[:, :, None]) <= 1e-13 * size).all()
    scaled, same, valid = camera.project_jacobian(scale * points)
    assert valid.all()
    assert (np.abs(scaled * scale - by_point) <= 1e-13 * size).all()
    assert (np.abs(same - by_parameters) <= 1e-12 * np.abs(by_parameters).max(axis=(0, 1))).all()


@given(model=models, seed=seeds)
@many
def test_bearings_turn_as_pixels_move(model, seed):
    """J_project J_bearing = 1 on the plane normal to the direction, and differences of the bearings themselves."""
    rng = np.random.default_rng(seed)
    camera = random_camera(model, rng)
    pixels = random_pixels(rng, 200, margin=0.0)
    by_pixel, valid = camera.bearing_jacobian(pixels)
    directions, _ = camera.bearings(pixels)
    singular = np.linalg.svd(by_pixel, compute_uv=False) * camera.focal_px
    kept = valid & (singular[:, 0] < 3) & (singular[:, 1] > 0.1)
    by_pixel, directions, pixels = by_pixel[kept], directions[kept], pixels[kept]
    product = camera.project_jacobian(directions)[0] @ by_pixel
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(2), product.shape), rtol=0, atol=1e-13)
    assert np.abs(directions[:, None] @ by_pixel).max() < 1e-15
    for index, axis in enumerate(np.eye(2)):
        assert_is_derivative(
            camera.focal_px * by_pixel[:, :, index],
            lambda h, axis=axis: camera.bearings(pixels + camera.focal_px * h * axis),
            step=2e-3,
            noise=1e-15,
        )


@pytest.mark.parametrize("model", MODELS)
def test_answers_are_finite_and_derivatives_zero_where_nothing_is_seen(model):
    camera = random_camera(model, np.random.default_rng(1))
    nowhere = [[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1]]
    points = np.array([*nowhere, [0, 0, 1], [0, 1, 0], [0, 0, -1], [1, 0, 0], [1e-200, 0, 1e-200], [1e150, 0, 1e150]])
    by_point, by_parameters, valid = camera.project_jacobian(points)
    assert np.isfinite(camera.project(points)[0]).all()
    assert not valid[:3].any()
    assert valid[3]
    pixels = np.array([[np.nan, 1], [np.inf, 1], [600, 450], [1e300, 0], [1e12, -1e12], [0, 0], [WIDTH, HEIGHT]])
    by_pixel, found = camera.bearing_jacobian(pixels)
    assert np.isfinite(camera.bearings(pixels)[0]).all()
    assert not found[:2].any()
    assert found[2]
    for derivatives, known in ((by_point, valid), (by_parameters, valid), (by_pixel, found)):
        assert np.isfinite(derivatives).all()
        np.testing.assert_array_equal(derivatives[~known], 0)
    nothing = np.zeros((0, 3))
    assert [x.shape for x in camera.project_jacobian(nothing)] == [(0, 2, 3), (0, 2, len(camera.params)), (0,)]
    assert [x.shape for x in camera.bearing_jacobian(nothing[:, :2])] == [(0, 3, 2), (0,)]
    assert camera.project(nothing)[0].shape == (0, 2)
    assert camera.bearings(nothing[:, :2])[0].shape == (0, 3)
