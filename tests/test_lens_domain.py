"""Every model against COLMAP's own C++; round trips over its whole domain, whose end is found by brute force, too."""

import numpy as np
import pycolmap
import pytest
from examples import examples
from hypothesis import assume, given
from hypothesis import strategies as st
from lenses import HEIGHT, MODELS, WIDTH, random_camera, random_directions, random_pixels

from nerfcli.cameras.camera import Camera, parameter_names
from nerfcli.cameras.distortion import Distortion
from nerfcli.cameras.lens import DISTORTIONS, lens_of

seeds = st.integers(0, 2**32 - 1)
strengths = st.sampled_from([0.0, 1.0, 5.0, 20.0])
models = st.sampled_from(MODELS)
many = examples(100)
few = examples(40)

POLYNOMIAL = [model for model in MODELS if DISTORTIONS[model]]


def distortion_of(camera: Camera) -> tuple[Distortion, ...]:
    return lens_of(camera.model, camera.values).distortions


def assert_seen_at(camera: Camera, directions: np.ndarray, pixels: np.ndarray) -> None:
    """Assert that all directions are seen, to 1e-9 px at their pixels."""
    again, seen = camera.project(directions)
    assert seen.all()
    # float64 directions are too coarse only far outside of the picture, where a pixel spans less than 4e-6 rad.
    px_per_rad = np.linalg.svd(camera.project_jacobian(directions)[0], compute_uv=False)[:, 0]
    assert (np.abs(again - pixels).max(axis=1) <= np.maximum(1e-9, 4e-15 * px_per_rad)).all()


def test_every_model_of_colmap_has_its_lens():
    assert set(MODELS) == set(pycolmap.CameraModelId.__members__) - {"INVALID"}
    for model in MODELS:
        used = {name for group in DISTORTIONS[model] for names in group.values() for name in names}
        other = {"f", "fx", "fy", "cx", "cy", "w", "h", "omega", "alpha", "beta"} | ({"k"} if not used else set())
        assert used <= set(parameter_names(model)) <= used | other


@given(model=models, seed=seeds, strength=strengths)
@many
def test_projecting_a_bearing_gives_the_pixel_in_and_around_the_picture(model, seed, strength):
    rng = np.random.default_rng(seed)
    camera, pixels = random_camera(model, rng, strength=strength), random_pixels(rng)
    directions, valid = camera.bearings(pixels)
    assert_seen_at(camera, directions[valid], pixels[valid])
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=0, atol=4e-16)
    np.testing.assert_array_equal(directions[~valid], np.broadcast_to([0, 0, 1], ((~valid).sum(), 3)))


@given(model=models, seed=seeds, strength=strengths)
@many
def test_the_direction_that_made_a_pixel_is_the_one_found(model, seed, strength):
    """Over the whole domain: the bearing of a pixel is the direction that made it, never another root."""
    rng = np.random.default_rng(seed)
    camera, directions = random_camera(model, rng, strength=strength), random_directions(rng)
    pixels, seen = camera.project(directions)
    # Beyond 1e5 px, and closer to the turn than this, rounding of the pixel alone moves the direction.
    weakest = np.linalg.svd(camera.project_jacobian(directions)[0], compute_uv=False)[:, 1]
    sharp = seen & (np.abs(pixels) < 1e5).all(axis=1) & (weakest > 1e-3 * camera.focal_px)
    found, valid = camera.bearings(pixels[sharp])
    assert valid.all()
    np.testing.assert_allclose(found, directions[sharp], rtol=0, atol=1e-9)


def test_a_direction_next_to_the_pole_of_a_rational_model_is_found():
    """At 0.3 % from the pole, F magnifies the rounding of its argument beyond the rounding of its value."""
    radial, divisor = (0.2131718564, 0.0704780748, -0.0059814991), (0.0065467647, 0.0167121516, -0.0015507858)
    tangential = (-0.0090150200, 0.0149705343)
    params = (735.6, 707.0, 600.0, 450.0, *radial[:2], *tangential, radial[2], *divisor)
    camera = Camera("FULL_OPENCV", WIDTH, HEIGHT, params)
    directions = np.array([[0.17, 0.95, 0.257], [0.1696319, 0.95144373, 0.25686544], [-0.2, 0.94, 0.257]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pixels, seen = camera.project(directions)
    found, valid = camera.bearings(pixels)
    assert seen.all()
    assert valid.all()
    np.testing.assert_allclose(found, directions, rtol=0, atol=1e-14)


@given(model=st.sampled_from(POLYNOMIAL), seed=seeds, strength=strengths)
@many
def test_the_jacobian_keeps_its_sign_up_to_the_reach(model, seed, strength):
    """Brute force: on 400 circles up to the reach the symmetric part of dF/dq is positive definite."""
    camera = random_camera(model, np.random.default_rng(seed), strength=strength)
    for distortion in distortion_of(camera):
        radii = np.linspace(0, min(distortion.reach, 50.0), 400)[:, None] * (1 - 1e-9)
        azimuths = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        plane = np.stack([(radii * np.cos(azimuths)).ravel(), (radii * np.sin(azimuths)).ravel()])
        jacobian = np.moveaxis(distortion.jacobian(plane), -1, 0)
        smallest = np.linalg.eigvalsh((jacobian + np.swapaxes(jacobian, 1, 2)) / 2)[:, 0]
        assert smallest.min() > -1e-6


@given(model=st.sampled_from(POLYNOMIAL), seed=seeds, strength=strengths)
@many
def test_a_radial_distortion_reaches_exactly_to_where_its_radius_stops_growing(model, seed, strength):
    """Against the first decrease of g on a fine grid, or its pole, where the sign of g changes."""
    camera = random_camera(model, np.random.default_rng(seed), strength=strength)
    radial = Distortion(radial=distortion_of(camera)[0].radial, divisor=distortion_of(camera)[0].divisor)
    step = 1e-4
    radii = np.arange(0, 10, step)
    heights = radial.apply(np.stack([radii, np.zeros_like(radii)]))[0]
    falls = np.flatnonzero(np.diff(heights) <= 0)
    if len(falls) and falls[0] > 0:
        assert abs(radial.reach - radii[falls[0]]) <= 2 * step
    else:
        assert radial.reach > 10 - 2 * step


@given(seed=seeds, strength=st.sampled_from([1.0, 5.0]))
@few
def test_tangential_terms_cost_little_of_the_domain(seed, strength):
    """The proof of uniqueness costs at most 2 % of the radius within which the determinant is positive."""
    distortion = distortion_of(random_camera("OPENCV", np.random.default_rng(seed), strength=strength))[0]
    radii = np.linspace(0, 3, 3000)[:, None]
    azimuths = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    plane = np.stack([(radii * np.cos(azimuths)).ravel(), (radii * np.sin(azimuths)).ravel()])
    (a, b), (c, d) = distortion.jacobian(plane).reshape(2, 2, *np.broadcast_shapes(radii.shape, azimuths.shape))
    folded = np.flatnonzero((a * d - b * c <= 0).any(axis=1))
    first = radii[folded[0], 0] if len(folded) else 3.0
    assert distortion.reach > 0.98 * first - 1e-3


def test_what_only_points_beyond_the_reach_are_moved_to_is_not_found():
    # A barrel distortion that turns back at a radius of 1.0541, which it moves to 0.7027.
    _, found = Distortion(radial=(-0.3,)).invert(np.array([[0.7026, 0.7028, 0.9, 30.0], [0.0] * 4]))
    assert found.tolist() == [True, False, False, False]
    # A distortion that grows again farther out, where Newton's method also finds points for some of these targets.
    distortion = Distortion(radial=(-0.3, 0.026), tangential=(1e-2, 0.0))
    angles, radii = 37 * np.linspace(0, 6.28, 4000), np.linspace(0.0, 5.0, 4000)
    points, found = distortion.invert(distortion.apply(radii * np.array([np.cos(angles), np.sin(angles)])))
    assert found[radii < distortion.reach].all()
    assert (np.hypot(*points)[found] < distortion.reach).all()


@pytest.mark.parametrize("model", ["SIMPLE_FISHEYE", "FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"])
def test_a_fisheye_of_200_degrees_sees_behind_its_image_plane(model):
    """radius = f (theta + k1 theta^3 + ...), also at 100 degrees, where x / z has changed its sign."""
    values = {"f": 300.0, "fx": 300.0, "fy": 300.0, "cx": 600.0, "cy": 450.0, "k1": 0.01, "k2": -0.001}
    camera = Camera(model, WIDTH, HEIGHT, tuple(values.get(name, 0.0) for name in parameter_names(model)))
    angle = np.radians([89.0, 90.0, 91.0, 100.0])
    bend = (0.01, -0.001) if "k1" in parameter_names(model) else (0.0, 0.0)
    radius = 300 * angle * (1 + bend[0] * angle**2 + bend[1] * angle**4)
    points = np.stack([-np.sin(angle) * 0.6, np.sin(angle) * 0.8, np.cos(angle)], axis=-1) * 7
    pixels, valid = camera.project(points)
    assert valid.all()
    np.testing.assert_allclose(pixels, np.stack([600 - 0.6 * radius, 450 + 0.8 * radius], axis=1), rtol=0, atol=1e-10)
    bearings, valid = camera.bearings(pixels)
    assert valid.all()
    np.testing.assert_allclose(bearings, points / 7, rtol=0, atol=1e-13)


def test_a_plain_fisheye_ends_straight_behind():
    camera = Camera("SIMPLE_FISHEYE", 1000, 1000, (100.0, 500.0, 500.0))
    inside, outside = 500 + 100 * (np.pi - 1e-9), 500 + 100 * (np.pi + 1e-9)
    directions, valid = camera.bearings(np.array([[inside, 500.0], [outside, 500.0]]))
    np.testing.assert_array_equal(valid, [True, False])
    np.testing.assert_allclose(directions[0], [1e-9, 0, -1], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("alpha", "beta"), [(0.0, 1.0), (0.3, 1.3), (0.5, 1.0), (0.7, 0.8), (1.0, 1.0)])
def test_eucm_ends_where_its_source_says(alpha, beta):
    """z > -w d: from the meridian's angle in closed form, tan^2 = (1 - w^2) / (w^2 beta)."""
    camera = Camera("EUCM", WIDTH, HEIGHT, (200.0, 200.0, 600.0, 450.0, alpha, beta))
    w = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    end = np.pi - np.arctan2(np.sqrt(1 - w * w), w * np.sqrt(beta))
    angle = np.array([end - 1e-6, end + 1e-6])[: 1 if end > np.pi - 1e-6 else 2]
    _, valid = camera.project(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1))
    np.testing.assert_array_equal(valid, [True, False][: len(angle)])
    if alpha > 0.5:  # the picture of the whole domain is a disc of this radius
        rim = 200 / np.sqrt((2 * alpha - 1) * beta)
        _, valid = camera.bearings(np.array([[600 + rim * (1 - 1e-9), 450], [600 + rim * (1 + 1e-9), 450]]))
        np.testing.assert_array_equal(valid, [True, False])


@pytest.mark.parametrize(("k", "rim"), [(-0.2, np.inf), (0.25, 2.0)])
def test_the_division_model_ends_where_its_radius_turns(k, rim):
    camera = Camera("SIMPLE_DIVISION", WIDTH, HEIGHT, (200.0, 600.0, 450.0, k))
    radius = np.array([0.5, 1.9, 2.1, 5.0, 1e3])
    directions, valid = camera.bearings(np.stack([600 + 200 * radius, np.full(5, 450)], axis=1))
    np.testing.assert_array_equal(valid, radius < rim)
    expected = np.stack([radius, 0 * radius, 1 + k * radius**2], axis=1)[valid]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(directions[valid], expected, rtol=0, atol=1e-14)
    assert (directions[valid, 2] < 0).any() == (k < 0)


def test_the_fov_model_ends_at_90_degrees():
    camera = Camera("FOV", WIDTH, HEIGHT, (300.0, 300.0, 600.0, 450.0, 0.9))
    rim = 300 * np.pi / 2 / 0.9
    directions, valid = camera.bearings(np.array([[600 + rim - 1e-6, 450.0], [600 + rim + 1e-6, 450.0]]))
    np.testing.assert_array_equal(valid, [True, False])
    assert 0 < directions[0, 2] < 1e-6


def test_a_panorama_holds_every_direction_once():
    camera = Camera("EQUIRECTANGULAR", 360, 180, (360.0, 180.0))
    points = np.array([[0, 0, 1.0], [1, 0, 0], [-1, 0, 0], [0, 1, 1], [1e-9, 0, -1], [-1e-9, 0, -1]])
    pixels, valid = camera.project(points)
    assert valid.all()
    expected = [[180, 90], [270, 90], [90, 90], [180, 135], [360, 90], [0, 90]]
    np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-6)
    _, valid = camera.bearings(np.array([[-0.1, 90], [360.1, 90], [10, -0.1], [10, 180.1], [0, 0], [360, 180]]))
    np.testing.assert_array_equal(valid, [False, False, False, False, True, True])


@given(
    model=models,
    seed=seeds,
    wild=st.lists(st.floats(-1e29, 1e29, allow_subnormal=True), min_size=16, max_size=16),
    mix=st.integers(0, 2**16 - 1),
)
@many
def test_whatever_the_parameters_answers_are_finite_and_true(model, seed, wild, mix):
    """Parameters up to 1e29, drawn one by one in place of sensible ones: nothing is raised, nothing is NaN."""
    rng = np.random.default_rng(seed)
    camera = random_camera(model, rng)
    names = parameter_names(model)
    params = [wild[i] if mix >> i & 1 and names[i][0] in "kps" else camera.params[i] for i in range(len(names))]
    camera = Camera(model, WIDTH, HEIGHT, tuple(params))
    pixels = random_pixels(rng, 50)
    directions, valid = camera.bearings(pixels)
    assert np.isfinite(directions).all()
    assert_seen_at(camera, directions[valid], pixels[valid])
    assert np.isfinite(camera.project(random_directions(rng))[0]).all()


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
