"""Splats: projection, compositing and depth against closed forms, definitions and autograd; Adam against torch's."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.rigid import from_parts, rotation_from_vector
from nerfcli.kernels.interface import BEYOND, LARGEST_ALPHA, LOW_PASS, Splats, SplatView
from nerfcli.kernels.numba_cpu.splat_projection import project_point
from nerfcli.kernels.numba_cpu.splats import SplatAdam, SplatPicture, render_splats, splat_depths, step_splats
from nerfcli.kernels.reference.splats import composite_splats, project_splats
from nerfcli.splats.render import lens_table

WIDTH, HEIGHT = 70, 50
BACKGROUND = np.array([0.2, 0.5, 0.7])
PINHOLE = Camera("PINHOLE", WIDTH, HEIGHT, (60.0, 58.0, 34.0, 26.0))
OPENCV = Camera("OPENCV", WIDTH, HEIGHT, (60.0, 58.0, 34.0, 26.0, 0.1, -0.05, 0.01, -0.02))
FISHEYE = Camera("OPENCV_FISHEYE", WIDTH, HEIGHT, (22.0, 22.0, 35.0, 25.0, 0.02, -0.01, 0.002, 0.0))
# Error of sums in float32, of the table of the lens, and of what is left out behind a transmittance of 1e-4.
CLOSE, CLOSE_GRADIENT = 1e-5, 2e-4


def view_of(camera: Camera, *, near: float = 0.0) -> SplatView:
    rotation = rotation_from_vector(np.array([0.05, 0.2, -0.1]))
    return SplatView(rotation, np.array([-0.5, 0.1, 0.3]), WIDTH, HEIGHT, near, *lens_table(camera))


def facing(camera: Camera = PINHOLE) -> SplatView:
    """Return a camera in the origin that looks along +z."""
    return SplatView(np.eye(3), np.zeros(3), WIDTH, HEIGHT, 0.0, *lens_table(camera))


def random_rows(count: int, degree: int, *, seed: int = 0) -> np.ndarray:
    """Return Gaussians in front of, beside, behind and around the camera."""
    rng = np.random.default_rng(seed)
    parts = [
        rng.normal(size=(count, 3)) * [0.8, 0.8, 1.2] + [0, 0, 2.5],
        np.log(rng.uniform(0.02, 0.4, (count, 3))),
        rng.normal(size=(count, 4)),
        1.5 * rng.normal(size=(count, 1)),
        0.3 * rng.normal(size=(count, 3 * (degree + 1) ** 2)),
    ]
    return np.concatenate(parts, axis=1).astype(np.float32)


def gradients_of(picture: SplatPicture, by_image: np.ndarray, by_transmittance: np.ndarray) -> np.ndarray:
    """Return d loss / d rows: the first moment of a step of Adam that forgets all earlier ones, and changes nothing."""
    count = len(picture.rows)
    adam = SplatAdam(np.zeros_like(picture.rows), np.zeros_like(picture.rows), np.zeros(count, np.int32))
    rates, sizes = np.zeros(6, np.float32), np.zeros(count, np.float32)
    step_splats(picture, by_image, by_transmittance, adam, rates=rates, sizes=sizes, betas=(0.0, 0.0))
    return adam.first


def row(mean: tuple[float, ...], size: float, opacity: float, colour: tuple[float, ...]) -> np.ndarray:
    """Return a round Gaussian of one colour."""
    constant = [(value - 0.5) / 0.28209479177387814 for value in colour]
    logit = np.log(opacity / (1 - opacity))
    return np.array([*mean, *[np.log(size)] * 3, 1, 0, 0, 0, logit, *constant], np.float32)


def lens_of(camera: Camera) -> Callable[[Tensor], Tensor]:
    """Return the lens model in torch, with NaN where it does not see."""
    fx, fy, cx, cy, *k = camera.params

    def perspective(p: Tensor) -> Tensor:
        k1, k2, p1, p2 = k or (0.0,) * 4
        x, y = p[0] / p[2], p[1] / p[2]
        s = x * x + y * y
        d = 1 + s * (k1 + s * k2)
        u = x * d + 2 * p1 * x * y + p2 * (s + 2 * x * x)
        v = y * d + 2 * p2 * x * y + p1 * (s + 2 * y * y)
        return torch.where(p[2] > 0, torch.stack([fx * u + cx, fy * v + cy]), torch.nan)

    def equidistant(p: Tensor) -> Tensor:
        rho = (p[0] * p[0] + p[1] * p[1]).sqrt()
        theta = torch.atan2(rho, p[2])
        s = theta * theta
        d = theta * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))) / rho
        return torch.stack([fx * p[0] * d + cx, fy * p[1] * d + cy])

    return equidistant if "FISHEYE" in camera.model else perspective


def definition(rows: np.ndarray, view: SplatView, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Splats]:
    """Return colour (H, W, 3), transmittance (H, W), (mean, median) depth, and the leaves of the gradient."""
    columns = torch.from_numpy(rows.astype(np.float64))
    harmonics = columns[:, 11:].reshape(len(rows), -1, 3)
    parts = (*columns[:, :10].split([3, 3, 4], 1), columns[:, 10], harmonics)
    leaves = Splats(*(part.clone().requires_grad_() for part in parts))
    pose = torch.from_numpy(from_parts(view.rotation, view.translation))
    footprints = project_splats(leaves, cam_from_world=pose, lens=lens_of(camera), size=(WIDTH, HEIGHT), near=view.near)
    seen = footprints.opacities > 0
    footprints = type(footprints)(*(values[seen] for values in footprints))
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = torch.from_numpy(np.stack([x, y], axis=-1).reshape(-1, 2))
    colour, transmittance, ends = composite_splats(footprints, pixels, torch.from_numpy(BACKGROUND))
    depths = torch.stack([ends.mean, ends.quantiles[:, 0], ends.spread, ends.peak])
    shape = (HEIGHT, WIDTH)
    return colour.reshape(*shape, 3), transmittance.reshape(shape), depths.reshape(4, *shape), leaves


@pytest.mark.parametrize("camera", [PINHOLE, OPENCV, FISHEYE], ids=lambda camera: camera.model)
@pytest.mark.parametrize(("count", "degree"), [(1, 3), (5, 0), (60, 1), (123, 2)])
def test_compiled_kernels_agree_with_the_definition(camera: Camera, count: int, degree: int) -> None:
    """Colour, transmittance, depth, and the gradient of a random function of the picture, by autograd in float64."""
    rows, view = random_rows(count, degree, seed=count), view_of(camera, near=0.5)
    colour, transmittance, depths, leaves = definition(rows, view, camera)
    picture = render_splats(rows, view, BACKGROUND)
    np.testing.assert_allclose(picture.image, colour.detach(), atol=CLOSE)
    np.testing.assert_allclose(picture.transmittance, transmittance.detach(), atol=CLOSE)
    ends = splat_depths(picture, (0.5,))
    for found, truth in zip((ends.mean, ends.quantiles[:, 0], ends.spread, ends.peak), depths, strict=True):
        np.testing.assert_allclose(found.reshape(HEIGHT, WIDTH), truth.detach(), rtol=1e-3, atol=1e-5)
    rng = np.random.default_rng(1)
    by_image, by_light = rng.normal(size=(HEIGHT, WIDTH, 3)), rng.normal(size=(HEIGHT, WIDTH))
    loss = (colour * torch.from_numpy(by_image)).sum() + (transmittance * torch.from_numpy(by_light)).sum()
    wanted = torch.autograd.grad(loss, list(leaves))
    found = gradients_of(picture, by_image, by_light)
    parts = (found[:, :3], found[:, 3:6], found[:, 6:10], found[:, 10], found[:, 11:].reshape(count, -1, 3))
    for part, truth in zip(parts, wanted, strict=True):
        np.testing.assert_allclose(part, truth, atol=CLOSE_GRADIENT * float(truth.abs().max()) + 1e-12)


def test_definition_has_the_gradient_of_finite_differences() -> None:
    camera, rows = OPENCV, random_rows(4, 2, seed=3)
    pose = torch.from_numpy(from_parts(view_of(camera).rotation, view_of(camera).translation))
    pixels = torch.tensor([[20.5, 30.5], [35.5, 25.5], [50.5, 12.5]], dtype=torch.float64)

    def colours(*parts: Tensor) -> Tensor:
        splats = project_splats(Splats(*parts), cam_from_world=pose, lens=lens_of(camera), size=(WIDTH, HEIGHT))
        return composite_splats(splats, pixels, torch.from_numpy(BACKGROUND))[0]

    *_, leaves = definition(rows, view_of(camera), camera)
    assert torch.autograd.gradcheck(colours, tuple(leaves))


def test_one_gaussian_before_a_pinhole_has_the_closed_form() -> None:
    """On the axis: sigma in pixels is f s / z, and alpha o exp(-d^2 / 2 (sigma^2 + 0.3)); Zwicker et al. 2001."""
    camera = Camera("PINHOLE", WIDTH, HEIGHT, (60.0, 60.0, 35.0, 25.0))
    picture = render_splats(row((0, 0, 3), 0.1, 0.6, (1.0, 0.25, 0.5))[None], facing(camera), BACKGROUND)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - 35, np.arange(HEIGHT) + 0.5 - 25)
    alpha = 0.6 * np.exp(-(x**2 + y**2) / 2 / ((60 * 0.1 / 3) ** 2 + LOW_PASS))
    alpha[alpha < 1 / 255] = 0.0
    expected = alpha[..., None] * [1.0, 0.25, 0.5] + (1 - alpha[..., None]) * BACKGROUND
    np.testing.assert_allclose(picture.image, expected, atol=CLOSE)
    ends = splat_depths(picture, (0.5,))
    inside = alpha > 0
    np.testing.assert_allclose(ends.mean.numpy().reshape(alpha.shape)[inside], 3.0, rtol=1e-6)
    np.testing.assert_array_equal(ends.quantiles[:, 0].isnan().numpy().reshape(alpha.shape), alpha < 0.5)


def test_two_gaussians_are_composited_by_distance_and_leave_the_rest_to_the_background() -> None:
    """In the middle of the nearer: 0.6 of its colour, 0.4 * 0.5 of the other's, 0.4 * 0.5 of the background."""
    camera = Camera("PINHOLE", WIDTH, HEIGHT, (60.0, 60.0, 35.5, 25.5))
    near, far = row((0, 0, 2), 0.5, 0.6, (1, 0, 0)), row((0, 0, 4), 1.0, 0.5, (0, 1, 0))
    for rows in (np.stack([near, far]), np.stack([far, near])):
        picture = render_splats(rows, facing(camera), BACKGROUND)
        expected = 0.6 * np.array([1, 0, 0]) + 0.2 * np.array([0, 1, 0]) + 0.2 * BACKGROUND
        np.testing.assert_allclose(picture.image[25, 35], expected, atol=CLOSE)
        np.testing.assert_allclose(picture.transmittance[25, 35], 0.2, atol=CLOSE)
        ends = splat_depths(picture, (0.5, 0.7))
        at = 25 * WIDTH + 35
        np.testing.assert_allclose(ends.mean[at], (0.6 * 2 + 0.2 * 4) / 0.8, rtol=1e-6)
        np.testing.assert_allclose(ends.quantiles[at], [2.0, 4.0], rtol=1e-6)


def test_opacity_is_limited_and_then_has_no_gradient() -> None:
    opaque = row((0, 0, 2), 0.3, 0.999, (1, 1, 1))[None]
    camera = Camera("PINHOLE", WIDTH, HEIGHT, (60.0, 60.0, 35.5, 25.5))
    picture = render_splats(opaque, facing(camera), BACKGROUND)
    assert picture.transmittance[25, 35] == pytest.approx(1 - LARGEST_ALPHA, abs=1e-6)
    only_there = np.zeros((HEIGHT, WIDTH), np.float32)
    only_there[25, 35] = 1.0
    gradient = gradients_of(picture, np.zeros_like(picture.image), only_there)
    np.testing.assert_array_equal(gradient[0, :11], 0.0)


def test_nothing_to_show_is_the_background() -> None:
    behind, beyond = row((0, 0, -2), 0.5, 0.9, (1, 0, 0)), row((0.5 + BEYOND, 0, 1), 0.001, 0.9, (1, 0, 0))
    faint = row((0, 0, 2), 0.5, 0.9 / 255, (1, 0, 0))
    for rows in (np.zeros((0, 14), np.float32), np.stack([behind, beyond, faint])):
        picture = render_splats(rows, facing(), BACKGROUND)
        np.testing.assert_allclose(picture.image, np.broadcast_to(BACKGROUND, picture.image.shape), rtol=1e-6)
        assert not gradients_of(picture, picture.image, picture.transmittance).any()
        assert splat_depths(picture, (0.5,)).mean.isnan().all()


between = partial(st.floats, width=32)


@examples(60)
@given(st.tuples(*[between(-1e4, 1e4)] * 3), between(-60, 30), between(-90, 90), between(-1e3, 1e3))
def test_extreme_gaussians_give_finite_numbers(mean: tuple, log_size: float, logit: float, colour: float) -> None:
    """Of zero and of astronomic extent, at the camera, across the near plane, of any opacity and colour."""
    extreme = np.array([*mean, log_size, -log_size, 0, 1e-3, 1, 0, 0, logit, colour, 0, 1], np.float32)
    rows = np.concatenate([extreme[None], random_rows(5, 0)])
    picture = render_splats(rows, view_of(PINHOLE), BACKGROUND)
    assert np.isfinite(picture.image).all()
    assert np.isfinite(picture.transmittance).all()
    adam = stepped(rows, picture)
    assert np.isfinite(rows).all()
    assert np.isfinite(adam.first).all()


def stepped(rows: np.ndarray, picture: SplatPicture) -> SplatAdam:
    adam = SplatAdam(np.zeros_like(rows), np.zeros_like(rows), np.zeros(len(rows), np.int32))
    rates, sizes = np.full(6, 0.1, np.float32), np.full(len(rows), 2.0, np.float32)
    step_splats(picture, picture.image, picture.transmittance, adam, rates=rates, sizes=sizes, betas=(0.9, 0.99))
    return adam


def test_steps_are_those_of_adam_on_what_is_seen() -> None:
    """Two steps with torch's Adam on the gradients of `gradients_of`; the rate of means is in their sizes."""
    rows, view = random_rows(60, 1), view_of(OPENCV)
    rates = np.array([0.1, 0.04, 0.02, 0.2, 0.04, 0.01], np.float32)
    sizes = np.linspace(0.5, 2.0, 60, dtype=np.float32)
    adam = SplatAdam(np.zeros_like(rows), np.zeros_like(rows), np.zeros(60, np.int32))
    leaves = [torch.from_numpy(rows[index].copy()).requires_grad_() for index in range(60)]
    optimisers = [torch.optim.Adam([leaf], lr=1.0, betas=(0.9, 0.99), eps=1e-12) for leaf in leaves]
    columns = np.repeat(rates, [3, 3, 4, 1, 3, 9])
    for _ in range(2):
        picture = render_splats(rows, view, BACKGROUND)
        gradients = gradients_of(picture, picture.image, picture.transmittance)
        before = rows.copy()
        step_splats(picture, picture.image, picture.transmittance, adam, rates=rates, sizes=sizes, betas=(0.9, 0.99))
        for index in range(60):
            if index not in picture.order:
                np.testing.assert_array_equal(rows[index], before[index])
                continue
            old = leaves[index].detach().clone()
            leaves[index].grad = torch.from_numpy(gradients[index])
            optimisers[index].step()
            change = (leaves[index].detach() - old).numpy() * columns
            change[:3] *= sizes[index]
            np.testing.assert_allclose(rows[index] - before[index], change, rtol=2e-3, atol=2e-6)
            leaves[index].data = torch.from_numpy(rows[index].copy())


@pytest.mark.parametrize(
    "camera",
    [
        *(PINHOLE, OPENCV, FISHEYE),
        Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, (60.0, 35.0, 25.0, -0.1)),
        Camera("FULL_OPENCV", WIDTH, HEIGHT, (60.0, 58.0, 34.0, 26.0, 0.1, -0.05, 0.01, -0.02, 0.01, 0.02, 0.01, 0.0)),
        Camera("FOV", WIDTH, HEIGHT, (50.0, 50.0, 35.0, 25.0, 0.9)),
        Camera("EUCM", WIDTH, HEIGHT, (30.0, 30.0, 35.0, 25.0, 0.6, 1.1)),
        Camera("DIVISION", WIDTH, HEIGHT, (60.0, 60.0, 35.0, 25.0, -0.1)),
        Camera(
            "THIN_PRISM_FISHEYE", WIDTH, HEIGHT, (22.0, 22.0, 35.0, 25.0, 0.02, -0.01, 0.001, 0.001, 0.0, 0.0, 0, 0)
        ),
    ],
    ids=lambda camera: camera.model,
)
def test_the_table_of_a_lens_is_the_lens(camera: Camera) -> None:
    """Pixels and Jacobians of `Camera` for points that the picture shows and a little beyond."""
    rng = np.random.default_rng(0)
    bearings, valid = camera.bearings(rng.uniform([-7, -5], [WIDTH + 7, HEIGHT + 5], (300, 2)))
    points = bearings[valid] * rng.uniform(0.1, 10, (valid.sum(), 1))
    pixels, _ = camera.project(points)
    jacobians, _, _ = camera.project_jacobian(points)
    lens, g, jacobian = np.empty(12), np.empty(6), np.empty(6)
    for point, pixel, wanted in zip(points, pixels, jacobians, strict=True):
        assert project_point(point, *lens_table(camera), lens, g, jacobian)
        np.testing.assert_allclose(lens[[0, 6]], pixel, atol=2e-4)
        np.testing.assert_allclose(jacobian.reshape(2, 3), wanted, atol=2e-4 * np.abs(wanted).max())
