"""Another world frame: what a similarity changes in a capture and what it keeps; up, origin, smallest rotation."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from captures import put_photos, random_similarity
from examples import examples
from frame_rays import frame_rays
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import up_direction
from nerfcli.cameras.rigid import Similarity
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.orientation import STORED, UPRIGHT, in_pixels
from nerfcli.captures.world import (
    WORLD_AXES,
    WorldFrame,
    in_world_frame,
    moved_to_origin,
    smallest_rotation,
    transformed,
    up_aligned,
)
from nerfcli.errors import UserError

few = examples(30)
seeds = st.integers(0, 2**32 - 1)
LENS = Camera("OPENCV", 64, 48, (50, 52, 33, 23, -0.1, 0.02, 0.001, 0.002))


def capture_of(rng: np.random.Generator, *, count: int = 8, unit: str = "arbitrary") -> Capture:
    """Cameras around (1, 2, 3) that look at it, +y up, and points about it."""
    focus = np.array([1.0, 2.0, 3.0])
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    centres = focus + np.stack([3 * np.cos(angle), np.full(count, 1.0), 3 * np.sin(angle)], axis=1)
    frames = tuple(
        Frame(f"{i}.jpg", LENS, rigid.look_at(c, focus, np.array([0.0, 1, 0]))) for i, c in enumerate(centres)
    )
    points = focus + 0.3 * rng.normal(size=(20, 3))
    seen = Observations(np.zeros(20, dtype=np.int64), np.arange(20), rng.random((20, 2)))
    depths = np.stack([frame.in_camera(points)[:, 2] for frame in frames])
    bounds = np.stack([depths.min(axis=1), depths.max(axis=1)], axis=1)
    colours = rng.integers(0, 256, (20, 3)).astype(np.uint8)
    return Capture(frames, points, ("gone.jpg",), bounds, "test", colours, seen, unit)


def pixels_of(capture: Capture) -> np.ndarray:
    return np.stack([f.camera.project(f.in_camera(capture.points))[0] for f in capture.frames])


@given(seed=seeds, scale=st.sampled_from([1e-3, 0.7, 1.0, 1e3]))
@few
def test_a_similarity_changes_no_pixel_and_scales_depths(seed, scale):
    rng = np.random.default_rng(seed)
    before = capture_of(rng, unit="metre")
    after = transformed(before, random_similarity(rng, scale))
    np.testing.assert_allclose(pixels_of(after), pixels_of(before), rtol=0, atol=1e-9)
    depths = np.stack([f.in_camera(after.points)[:, 2] for f in after.frames])
    assert after.depth_bounds is not None
    np.testing.assert_allclose(after.depth_bounds[:, 0], depths.min(axis=1), rtol=1e-12)
    np.testing.assert_allclose(after.depth_bounds[:, 1], depths.max(axis=1), rtol=1e-12)
    assert after.unit == ("metre" if scale == 1 else "arbitrary")
    assert (after.missing, after.kind, after.colours) == (before.missing, before.kind, before.colours)
    assert after.observations is before.observations
    assert [frame.camera for frame in after.frames] == [frame.camera for frame in before.frames]


@given(seed=seeds, axis=st.sampled_from(sorted(WORLD_AXES)))
@few
def test_up_points_along_the_axis_and_nothing_else_changes_size(seed, axis):
    rng = np.random.default_rng(seed)
    capture = transformed(capture_of(rng), random_similarity(rng, 2.0))
    turn = up_aligned(capture.frames, axis)
    assert turn.scale == 1
    np.testing.assert_array_equal(turn.translation, 0)
    np.testing.assert_allclose(up_direction(transformed(capture, turn).frames), WORLD_AXES[axis], rtol=0, atol=1e-9)


def test_up_is_that_of_upright_photos_where_the_cameras_are_for_stored_pixels(tmp_path):
    """Regression: a capture of portrait photos was tipped by 90 degrees."""
    put_photos(tmp_path, "portrait.jpg", orientation=6)
    frames = [
        replace(frame, camera=Camera.pinhole(48, 64, 50.0), image=tmp_path / "portrait.jpg")
        for frame in capture_of(np.random.default_rng(0)).frames
    ]
    stored = in_pixels(Capture(tuple(frames), pixels=UPRIGHT), STORED).capture
    assert stored.frames[0].camera.size == (64, 48)
    moved = in_world_frame(stored, WorldFrame(up="z")).capture
    upright = in_pixels(moved, UPRIGHT).capture.frames
    np.testing.assert_allclose(up_direction(upright), WORLD_AXES["z"], rtol=0, atol=1e-9)


def test_axes_by_hand():
    np.testing.assert_array_equal(WORLD_AXES["-y"], [0, -1, 0])
    np.testing.assert_array_equal(WORLD_AXES["z"], [0, 0, 1])
    # y up becomes z up by a quarter turn about x: z goes to -y.
    turn = smallest_rotation(WORLD_AXES["y"], WORLD_AXES["z"])
    np.testing.assert_allclose(turn @ [0, 0, 1], [0, -1, 0], atol=1e-15)


@given(
    seed=seeds, angle=st.sampled_from([0.0, 1e-12, 1e-6, 1.0, 2.2, np.pi - 1e-6, np.pi - 1e-9, np.pi - 1e-15, np.pi])
)
@few
def test_the_smallest_rotation_at_every_angle(seed, angle):
    """Against the definition: it turns a into b, by the angle between them; scipy measures the angle."""
    rng = np.random.default_rng(seed)
    a, other = rng.normal(size=(2, 3))
    a /= np.linalg.norm(a)
    across = np.cross(a, other)
    b = np.cos(angle) * a + np.sin(angle) * across / np.linalg.norm(across)
    b /= np.linalg.norm(b)
    rotation = smallest_rotation(a, b)
    # Five products of matrices, each of which rounds by a few 1e-16.
    np.testing.assert_allclose(rotation @ a, b, rtol=0, atol=5e-15)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=5e-15)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(Rotation.from_matrix(rotation).magnitude(), angle, rtol=0, atol=3e-8)


def test_origins():
    capture = capture_of(np.random.default_rng(0))
    for origin, expected in (("focus", [1, 2, 3]), ("centre-of-cameras", [1, 3, 3]), ("0.5,-1e1, 2", [0.5, -10, 2])):
        moved = moved_to_origin(capture.frames, origin)
        np.testing.assert_allclose(moved.apply(np.array(expected)), 0, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(moved.rotation, np.eye(3))
        assert moved.scale == 1


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda: up_aligned([], "up"), "unknown axis 'up'"),
        (lambda: moved_to_origin([], "middle"), "'middle' is not a point"),
        (lambda: moved_to_origin([], "1,2"), "not a point of three finite numbers"),
        (lambda: moved_to_origin([], "1,2,inf"), "not a point of three finite numbers"),
    ],
)
def test_what_is_no_direction_or_place_is_refused(make, what):
    with pytest.raises(UserError, match=what):
        make()


def test_rays_a_million_units_from_the_origin_keep_their_digits():
    """The similarity to the training frame is applied in float64: steps are right to 8 roundings of a place."""
    centre, offset = np.array([1e6, -1e6, 1e6]), np.array([0.25, 0.125, -0.5])
    frame = Frame("a", Camera.pinhole(8, 6, 8.0), rigid.from_parts(np.eye(3), centre + offset))
    rays = frame_rays(frame, Similarity(1.0, np.eye(3), -centre), torch.device("cpu"))
    distances = torch.arange(1, 1025) * (3**0.5 / 1024)
    steps = (rays.origin + rays.directions[0] * distances[:, None]).double().diff(dim=0).norm(dim=1)
    exact = rays.directions[0].double() * distances.double()[:, None]
    wanted = (torch.from_numpy(offset) + exact).diff(dim=0).norm(dim=1)
    torch.testing.assert_close(steps, wanted, rtol=0, atol=8 * 2.0**-24 * 2.5)
