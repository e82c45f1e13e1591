"""Whole pictures of a fog that fills chosen cells: every pixel has a closed form, in colour, opacity and each depth."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from fog import SIDE, STEP, fog, foggy_cells
from frame_rays import frame_rays
from present import present

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts, look_at, rotation_from_quaternion
from nerfcli.render.depth import CONVENTIONS
from nerfcli.render.model import Model
from nerfcli.render.pictures import DepthRequest, RenderedPicture, rays_per_tile, render_picture

# From a scene that is turned, moved and four times as large as the training frame.
SIMILARITY = Similarity(0.25, rotation_from_quaternion(np.array([0.8, 0.2, -0.4, 0.4])), np.array([0.3, -0.2, 0.1]))
SIGMA = SIMILARITY.scale  # density of the fog in 1 / scene unit
CAMERA = Camera.pinhole(16, 12, 14.0)
BACKGROUND = (1.0, 0.5, 0.25)
# Half a step at each border of the fog, in scene units.
BORDER = STEP / SIMILARITY.scale


def scene_frame(pose: np.ndarray, camera: Camera = CAMERA) -> Frame:
    """A frame in the scene whose pose in the training frame is `pose`."""
    return Frame("view", camera, SIMILARITY.inverse().apply_pose(pose))


def towards_slab(centre_z: float = -1.9) -> Frame:
    """A camera that looks along +z of the training frame, at right angles to the slab."""
    return scene_frame(from_parts(np.eye(3), np.array([0.01, -0.02, centre_z])))


# The slab fills the cube in x and y and lies at 0 <= z <= 1/2 in the training frame.
SLAB = foggy_cells((-1, -1, 0.0), (1, 1, 0.5))
NEAR, FAR = 1.9 / SIMILARITY.scale, 2.4 / SIMILARITY.scale  # z of its sides, scene units


def cosines() -> np.ndarray:
    """Return the cosines (H, W) between the rays of `CAMERA` and the optical axis, by hand."""
    x, y = np.meshgrid(np.arange(16) + 0.5 - 8, np.arange(12) + 0.5 - 6)
    return 14.0 / np.sqrt(x**2 + y**2 + 14.0**2)


def inside_slab(far: float = 2.4) -> np.ndarray:
    """Return which pixels (H, W) have a ray that stays within the sides of the cube up to z = `far` from the camera.

    `far` is in the training frame, by default the far side of the slab.
    """
    x, y = np.meshgrid(np.arange(16) + 0.5 - 8, np.arange(12) + 0.5 - 6)
    return (np.abs(0.01 + far * x / 14) < 0.99) & (np.abs(-0.02 + far * y / 14) < 0.99)


def picture_of(model: Model, frame: Frame, depth: DepthRequest | None = None) -> RenderedPicture:
    return render_picture(model, frame, background=BACKGROUND, depth=depth)


def z_and_distance(model: Model, **request: Any) -> list[np.ndarray]:
    """Return the depth (H, W) of what `towards_slab` sees along both axes."""
    requests = (DepthRequest(axis=axis, **request) for axis in ("z", "ray"))
    return [present(picture_of(model, towards_slab(), wanted).depth) for wanted in requests]


def chords(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Lengths (N,) of rays inside the cube [-1, 1]^3, float64."""
    with np.errstate(divide="ignore"):
        a, b = (-1 - origin) / directions, (1 - origin) / directions
    return np.maximum(np.maximum(a, b).min(-1) - np.minimum(a, b).max(-1), 0.0)


def test_colour_and_opacity_of_a_cube_of_fog_by_beer_and_lambert():
    model = fog(foggy_cells((-1, -1, -1), (1, 1, 1)), SIMILARITY)
    pose = look_at(np.array([1.5, -2.0, 1.1]), np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    picture = picture_of(model, scene_frame(pose))
    directions = CAMERA.pixel_bearings()[0] @ pose[:3, :3].T
    passed = np.exp(-chords(pose[:3, 3], directions)).reshape(12, 16)
    assert passed.min() < 0.2
    assert passed.max() == 1  # rays through the cube and past it
    np.testing.assert_allclose(picture.opacity, 1 - passed, atol=STEP)
    np.testing.assert_allclose(picture.rgb, (1 - passed)[..., None] * 0.5 + passed[..., None] * BACKGROUND, atol=STEP)
    assert picture.valid.all()
    assert picture.depth is None


def test_a_finer_step_brings_the_closed_form_nearer():
    # Order of convergence: the only error is where the fog's borders fall among the cuts.
    pose = look_at(np.array([1.5, -2.0, 1.1]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    directions = CAMERA.pixel_bearings()[0] @ pose[:3, :3].T
    expected = 1 - np.exp(-chords(pose[:3, 3], directions)).reshape(12, 16)
    errors = []
    for step in (1 / 32, 1 / 128, 1 / 512):
        model = fog(foggy_cells((-1, -1, -1), (1, 1, 1)), SIMILARITY, step=step)
        errors.append(float(np.abs(picture_of(model, scene_frame(pose)).opacity - expected).mean()))
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.3)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.3)


def expected_z(convention: str, *, background_distance: float) -> np.ndarray:
    """Return z (H, W) of a convention for fog from the slab's near side on, in closed form and scene units."""
    cos = cosines()
    length = (FAR - NEAR) / cos
    tau = SIGMA * length
    opacity = -np.expm1(-tau)
    mean = NEAR / cos + 1 / SIGMA - length / np.expm1(tau)  # mean distance of the light that ends inside
    distance = {
        "conditional": mean,
        "moment": opacity * mean,
        "background": opacity * mean + np.exp(-tau) * background_distance,
        "max-weight": NEAR / cos,  # the first interval is the heaviest: density is constant
        "median": NEAR / cos + math.log(2) / SIGMA,
    }[convention]
    return distance * cos


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_depth_of_a_slab_in_closed_form_along_both_axes(convention):
    if convention == "median":
        # Half of the light must end: the slab of optical depth 1/2 is too thin, the half cube behind z = 0 is not.
        model, pixels = fog(foggy_cells((-1, -1, 0.0), (1, 1, 1)), SIMILARITY), inside_slab(1.9 + math.log(2))
    else:
        model, pixels = fog(SLAB, SIMILARITY), inside_slab()
    z, ray = z_and_distance(model, convention=convention, min_opacity=0.1, background_distance=30.0)
    assert pixels.sum() > 50
    expected = expected_z(convention, background_distance=30.0)
    # Each border is at most half a step off, and the background counts what passes at 30 units.
    tolerance = 2 * BORDER + 30 * STEP * (convention == "background")
    np.testing.assert_allclose(z[pixels], expected[pixels], atol=tolerance)
    np.testing.assert_allclose(ray[pixels], (expected / cosines())[pixels], atol=tolerance / cosines().min())
    np.testing.assert_allclose(z, ray * cosines(), rtol=1e-5)


def test_z_of_a_plane_is_constant_and_its_ray_depth_is_not():
    # A thin wall at right angles to the optical axis.
    wall = foggy_cells((-1, -1, 0.0), (1, 1, 2 / SIDE))
    z, ray = z_and_distance(fog(wall, SIMILARITY), convention="conditional", min_opacity=0.0)
    pixels = inside_slab()
    middle = NEAR + 1 / SIDE / SIMILARITY.scale
    np.testing.assert_allclose(z[pixels], middle, rtol=0.01)
    assert np.ptp(ray[pixels]) > 0.05 * middle
    np.testing.assert_allclose(ray[pixels] * cosines()[pixels], middle, rtol=0.01)


def test_depth_is_undefined_where_too_little_ray_termination():
    # Opacity of the slab is 1 - exp(-0.5 / cos) = 0.39 to 0.44: below one half, above one tenth.
    for convention, floor in (("conditional", 0.5), ("max-weight", 0.5), ("median", 0.0)):
        depth = present(picture_of(fog(SLAB, SIMILARITY), towards_slab(), DepthRequest(convention, "z", floor)).depth)
        assert np.isnan(depth[inside_slab()]).all()
    moment = present(picture_of(fog(SLAB, SIMILARITY), towards_slab(), DepthRequest("moment", "z", 0.5)).depth)
    assert np.isfinite(moment).all()


def test_what_is_behind_the_camera_is_not_seen():
    inside = towards_slab(centre_z=0.75)  # beyond the slab, looking away from it
    picture = picture_of(fog(SLAB, SIMILARITY), inside)
    assert picture.opacity.max() == 0
    np.testing.assert_array_equal(picture.rgb[0, 0], np.array(BACKGROUND, dtype=np.float32))


# A barrel distortion whose radius r (1 - 0.4 r^2) turns back at r = 0.91, before the corners of this picture.
BARREL = Camera("OPENCV", 16, 12, (10.7, 10.7, 8.0, 6.0, -0.4, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("axis", ["ray", "z"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_pixels_without_a_ray_have_no_depth_and_the_background(axis, convention):
    frame = Frame("barrel", BARREL, towards_slab().world_from_cam)
    model = fog(foggy_cells((-1, -1, -1), (1, 1, 1)), SIMILARITY)
    picture = picture_of(model, frame, DepthRequest(convention, axis, 0.0, 30.0))
    invalid = ~picture.valid
    assert 4 <= invalid.sum() < 100
    assert np.isnan(present(picture.depth)[invalid]).all()
    assert (picture.opacity[invalid] == 0).all()
    assert (picture.rgb[invalid] == np.array(BACKGROUND, dtype=np.float32)).all()


def test_rays_have_unit_length_and_start_at_the_camera():
    frame = Frame("barrel", BARREL, towards_slab().world_from_cam)
    rays = frame_rays(frame, SIMILARITY, fog(SLAB, SIMILARITY).device)
    np.testing.assert_allclose(np.linalg.norm(rays.directions.numpy(), axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(rays.origin.numpy(), (0.01, -0.02, -1.9), atol=1e-6)
    # Row by row: the first pixel after a row is the first of the next; the optical axis is +z here.
    bearings, _ = BARREL.bearings(np.array([[0.5, 1.5]]))
    np.testing.assert_allclose(rays.directions[16].numpy(), bearings[0], atol=1e-6)
    np.testing.assert_allclose(rays.cosines.numpy(), rays.directions[:, 2].numpy(), atol=1e-6)


@pytest.mark.parametrize(("gigabytes", "rays"), [(80, 2**16), (8, 2**8 * 142), (1, 2**14)])
def test_tiles_of_a_gpu_fit_into_its_memory(gigabytes, rays, monkeypatch):
    """A tile takes an eighth of it if all 250 steps are in occupied cells, but is never too small to fill a GPU."""
    device = SimpleNamespace(total_memory=gigabytes * 10**9)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda of: device)
    marching = SimpleNamespace(edges=lambda: torch.zeros(250))
    model = SimpleNamespace(device=torch.device("cuda:1"), marching=marching)
    assert rays_per_tile(model) == pytest.approx(rays, rel=0.01)  # type: ignore[arg-type]


def test_unknown_conventions_are_programming_errors():
    with pytest.raises(ValueError, match="unknown depth convention 'mean'"):
        picture_of(fog(SLAB, SIMILARITY), towards_slab(), DepthRequest("mean", "z"))
    with pytest.raises(ValueError, match="needs a background distance"):
        picture_of(fog(SLAB, SIMILARITY), towards_slab(), DepthRequest("background", "z"))
