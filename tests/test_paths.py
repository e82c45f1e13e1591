"""Camera paths: constant speed, closed orbits, what they look at, and where they stay; on captures of known layout."""

import numpy as np
import pytest
from captures import random_similarity
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import centres_of, focus_point, surrounds, up_direction, views_of
from nerfcli.cameras.paths import ellipse, fly, interpolate, orbit, spiral
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError

UP = np.array([0.0, 0.0, 1.0])
LENS = Camera("OPENCV", 64, 48, (50, 52, 33, 23, -0.1, 0.02, 0.001, 0.002))
few = examples(20)
seeds = st.integers(0, 2**32 - 1)


def frames_at(centres: np.ndarray, targets: np.ndarray, *, up: np.ndarray = UP) -> list[Frame]:
    targets = np.broadcast_to(targets, centres.shape)
    poses = [rigid.look_at(c, t, up) for c, t in zip(centres, targets, strict=True)]
    return [Frame(f"{i:03d}.jpg", LENS, pose) for i, pose in enumerate(poses)]


def ring(
    focus: np.ndarray, *, radius: float = 2.0, height: float = 1.0, turns: float = 1.0, count: int = 30
) -> list[Frame]:
    angle = np.linspace(0, 2 * np.pi * turns, count, endpoint=False)
    centres = focus + np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)
    return frames_at(centres, focus)


def facing(focus_depth: float = 20.0) -> list[Frame]:
    """A grid of 5 x 4 cameras in the plane y = 0 that look along +y, at a point far in front of it."""
    x, z = np.meshgrid(np.linspace(-2, 2, 5), np.linspace(-1, 1, 4))
    centres = np.stack([x.ravel(), np.zeros(20), z.ravel()], axis=1)
    return frames_at(centres, np.array([0, focus_depth, 0]))


def moved(frames: list[Frame], similarity: Similarity) -> list[Frame]:
    return [Frame(f.name, f.camera, similarity.apply_pose(f.world_from_cam)) for f in frames]


def steps_of(path, *, closed: bool) -> np.ndarray:
    centres = centres_of(path)
    ends = np.roll(centres, -1, axis=0) if closed else centres[1:]
    return np.linalg.norm(ends - (centres if closed else centres[:-1]), axis=1)


@given(seed=seeds)
@few
def test_focus_is_where_all_axes_meet(seed):
    rng = np.random.default_rng(seed)
    focus = rng.normal(size=3)
    frames = frames_at(focus + rng.normal(size=(12, 3)), focus)
    np.testing.assert_allclose(focus_point(frames), focus, rtol=0, atol=1e-9)
    # Three of fifteen cameras that look elsewhere move it by only a small fraction of their own offset.
    strays = frames_at(focus + rng.normal(size=(3, 3)), focus + rng.normal(size=(3, 3)) + 3.0)
    assert np.linalg.norm(focus_point([*frames, *strays]) - focus) < 1e-3


def test_focus_of_parallel_axes_is_as_deep_as_the_hint():
    x = np.linspace(-2, 2, 5)
    centres = np.stack([x, np.zeros(5), np.zeros(5)], axis=1)
    frames = frames_at(centres, centres + np.array([0, 1.0, 0]))
    np.testing.assert_allclose(focus_point(frames, depth_hint=7.0), [0, 7, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(focus_point(frames), [0, 5 * np.abs(x).mean(), 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(focus_point(frames[:1], depth_hint=3.0), [-2, 3, 0], rtol=0, atol=1e-12)


def test_focus_of_cameras_that_look_outwards_is_not_behind_them():
    around = ring(np.zeros(3), height=0.0)
    outwards = frames_at(centres_of(around), 3 * centres_of(around))
    np.testing.assert_allclose(focus_point(outwards), 0, rtol=0, atol=1e-12)
    along_a_wall = outwards[:6]
    assert ((focus_point(along_a_wall) - centres_of(along_a_wall)) * views_of(along_a_wall)).sum(1).min() > 0
    with pytest.raises(ValueError, match="at least one frame"):
        focus_point([])


@pytest.mark.parametrize("fraction", [0.4, 1.0, 1.5])
def test_up_is_exact_for_level_cameras_however_they_tilt(fraction):
    """Part of a ring looking down steeply: the mean of the pictures' up leans over, their level axes do not."""
    frames = ring(np.zeros(3), height=3.0, turns=fraction)
    similarity = Similarity(3.0, Rotation.from_euler("xyz", [1, 2, 3]).as_matrix(), np.ones(3))
    np.testing.assert_allclose(up_direction(moved(frames, similarity)), similarity.rotation @ UP, rtol=0, atol=1e-9)


def test_up_of_cameras_that_look_one_way_is_the_pictures_up_without_the_sideways_ones():
    frames = facing()
    on_its_side = frames_at(np.array([[0.0, 0, 0]]), np.array([0, 20.0, 0]), up=np.array([1.0, 0, 0]))
    np.testing.assert_allclose(up_direction([*frames, *on_its_side]), UP, rtol=0, atol=1e-3)


def test_what_surrounds():
    assert surrounds(ring(np.zeros(3)), UP)
    assert surrounds(ring(np.zeros(3), count=3), UP)
    assert not surrounds(ring(np.zeros(3), turns=0.5), UP)
    assert not surrounds(facing(), UP)
    above = np.array([[x, y, 5.0] for x in range(3) for y in range(3)])
    assert not surrounds(frames_at(above, np.array([1.0, 1, -500]), up=np.array([0, 1.0, 0])), UP)  # straight down


@given(seed=seeds, turns=st.sampled_from([1.0, 1.5]), height=st.floats(-1.0, 4.0))
@few
def test_orbit_of_a_ring_is_that_ring(seed, turns, height):
    """In any frame of the world: at the cameras' own distance and elevation, closed, constant in speed, looking in."""
    rng = np.random.default_rng(seed)
    focus = rng.normal(size=3)
    similarity = random_similarity(rng)
    frames = moved(ring(focus, height=height, turns=turns), similarity)
    path = orbit(frames, count=40)
    size, focus = similarity.scale, similarity.apply(focus)
    offsets = (centres_of(path) - focus) @ similarity.rotation / size
    np.testing.assert_allclose(offsets[:, 2], height, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(offsets[:, :2], axis=1), 2.0, rtol=0, atol=1e-6)
    steps = steps_of(path, closed=True)
    np.testing.assert_allclose(steps, 2 * 2 * size * np.sin(np.pi / 40), rtol=1e-5)
    for frame in path:
        pixel, valid = frame.camera.project(frame.in_camera(focus)[None])
        assert valid[0]
        np.testing.assert_allclose(pixel[0], frame.camera.principal_point, rtol=0, atol=1e-4)
        assert -frame.world_from_cam[:3, 1] @ similarity.rotation @ UP > 0


def test_orbit_of_one_and_a_half_rings_is_at_their_mean():
    focus = np.array([1.0, 2, 3])
    low, high = ring(focus, radius=2.0, height=0.5), ring(focus, radius=1.5, height=1.5, turns=0.5, count=15)
    path = orbit([*low, *high], count=24)
    offsets = centres_of([*low, *high]) - focus
    distances = np.linalg.norm(offsets, axis=1)
    elevation = np.arcsin(offsets[:, 2] / distances).mean()
    around = centres_of(path) - focus
    np.testing.assert_allclose(np.arcsin(around[:, 2] / np.linalg.norm(around, axis=1)), elevation, rtol=0, atol=1e-9)
    assert distances.min() - 1e-6 <= np.linalg.norm(around, axis=1).min()
    assert np.linalg.norm(around, axis=1).max() <= distances.max() + 1e-6


def test_orbit_of_an_elongated_ring_is_its_ellipse():
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    centres = np.stack([3 * np.cos(angle), 2 * np.sin(angle), np.zeros(40)], axis=1)
    path = centres_of(orbit(frames_at(centres, np.zeros(3)), count=32))
    np.testing.assert_allclose((path[:, 0] / 3) ** 2 + (path[:, 1] / 2) ** 2, 1.0, rtol=0, atol=1e-9)
    # Chords of an ellipse differ a little at equal arcs.
    steps = steps_of(orbit(frames_at(centres, np.zeros(3)), count=400), closed=True)
    np.testing.assert_allclose(steps.std(), 0, rtol=0, atol=1e-5)


@given(seed=seeds)
@few
def test_an_ellipse_through_cameras_on_an_ellipse_is_that_ellipse(seed):
    """In any frame of the world: the path is the cameras' own ellipse, but for the percentile that sets its axes."""
    rng = np.random.default_rng(seed)
    similarity = random_similarity(rng)
    a, b = 3.0, 2.0
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    # 90 % of |cos| are below cos(0.05 pi): the ellipse is smaller than the cameras' by that.
    inside = np.cos(0.05 * np.pi)
    centres = np.stack([a * np.cos(angle), b * np.sin(angle), np.tile([0.8, 1.2], 200)], axis=1) / [inside, inside, 1]
    path = ellipse(moved(frames_at(centres, np.zeros(3)), similarity), count=50)
    local = (centres_of(path) - similarity.translation) @ similarity.rotation / similarity.scale
    np.testing.assert_allclose((local[:, 0] / a) ** 2 + (local[:, 1] / b) ** 2, 1.0, rtol=0, atol=1e-2)
    np.testing.assert_allclose(local[:, 2], 1.0, rtol=0, atol=1e-6)
    steps = steps_of(path, closed=True)
    assert steps.max() < 1.01 * steps.min()  # chords of equal arcs
    np.testing.assert_allclose(np.cross(views_of(path) @ similarity.rotation, local), 0, rtol=0, atol=1e-4)


def test_an_ellipse_ignores_the_farthest_tenth_and_goes_around_where_the_cameras_stand_on_one_side():
    far = frames_at(np.array([[50.0, 0, 1]]), np.zeros(3))
    path = ellipse([*ring(np.zeros(3), count=60), *far], count=32)
    assert np.linalg.norm(centres_of(path), axis=1).max() < 2.5
    behind = centres_of(ellipse(facing(10.0), count=32))[:, 1]
    np.testing.assert_allclose([behind.min(), behind.max()], [0, 20], rtol=0, atol=1e-6)
    line = np.array([[0.0, -y, 0] for y in (1.0, 2.0, 3.0)])
    with pytest.raises(UserError, match="do not surround what they look at"):
        ellipse(frames_at(line, np.zeros(3)), count=8)


@pytest.mark.parametrize("make", [orbit, spiral])
def test_a_path_before_a_forward_facing_capture_stays_where_the_cameras_were(make):
    frames = facing()
    path = make(frames, count=1000)
    centres = centres_of(path)
    low, high = centres_of(frames).min(axis=0), centres_of(frames).max(axis=0)
    # Across the view: within the grid. Along it an orbit keeps its distance to the focus: 2^2 / (2 * 20) = 0.1.
    assert (centres[:, [0, 2]] > low[[0, 2]]).all()
    assert (centres[:, [0, 2]] < high[[0, 2]]).all()
    assert np.abs(centres[:, 1]).max() < 0.1
    assert np.ptp(centres[:, 0]) > 1.5
    assert np.ptp(centres[:, 2]) > 0.7
    assert (views_of(path) @ [0, 1, 0]).min() > 0.99
    steps = steps_of(path, closed=True)
    assert steps.max() < 1.002 * steps.min()


def test_an_orbit_of_a_walk_past_the_focus_stays_before_it():
    """Ten cameras look at the focus on their way to it; the last three, behind it, look at other things."""
    along = np.concatenate([np.linspace(-8, -2, 10), [1.0, 2.0, 3.0]])
    centres = np.stack([np.sin(3 * along), along, np.zeros(13)], axis=1)
    targets = np.where(along[:, None] < 0, np.zeros(3), [10.0, 50.0, 0.0])
    frames = frames_at(centres, targets)
    np.testing.assert_allclose(focus_point(frames), 0, atol=1e-3)
    path = centres_of(orbit(frames, count=60))
    azimuth = np.arctan2(path[:, 0], -path[:, 1])
    widest = np.arctan2(centres[:10, 0], -centres[:10, 1])
    assert widest.min() < azimuth.min() < azimuth.max() < widest.max()
    # From so few that the angles say nothing, the path is that of all cameras.
    away = frames_at(centres, np.where(along[:, None] < -7.5, np.zeros(3), [10.0, 50.0, 0.0]))
    assert np.ptp(centres_of(orbit(away, count=60)), axis=0).max() > 1


def test_a_sway_over_cameras_that_look_straight_down_stays_above():
    centres = np.array([[x, y, 5.0] for x in range(5) for y in range(5)])
    frames = frames_at(centres, np.array([2.0, 2, -100]), up=np.array([0, 1.0, 0]))
    path = orbit(frames, count=20, depth_hint=105.0)
    assert (np.abs(centres_of(path) - [2, 2, 5]) < 2.1).all()
    assert (views_of(path) @ UP).max() < -0.99


def test_a_spiral_in_a_ring_stays_on_one_side_and_looks_inwards():
    frames = ring(np.zeros(3), count=40)
    path = spiral(frames, count=30)
    middle = frames[20].centre
    assert np.linalg.norm(centres_of(path) - middle, axis=1).max() < 2.0
    assert (views_of(path) * -centres_of(path)).sum(axis=1).min() > 0


@given(seed=seeds, count=st.sampled_from([1, 2, 7, 50]))
@examples(8)
def test_interpolation_is_the_flight_through_all_frames_from_the_first_to_the_last(seed, count):
    rng = np.random.default_rng(seed)
    frames = frames_at(rng.normal(size=(5, 3)), rng.normal(size=(5, 3)) + 10)
    path = interpolate(frames, count=count)
    flight = fly(np.array([frame.world_from_cam for frame in frames]), count)
    np.testing.assert_array_equal([frame.world_from_cam for frame in path], flight)
    np.testing.assert_allclose(path[0].world_from_cam, frames[0].world_from_cam, rtol=0, atol=1e-9)
    if count > 1:
        np.testing.assert_allclose(path[-1].world_from_cam, frames[-1].world_from_cam, rtol=0, atol=1e-9)


def test_interpolation_turns_on_the_spot_and_stands_still():
    """Frames at one place: a turn at constant angular speed. One frame several times: the camera stands still."""
    angle = np.linspace(0, 2, 5)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(5)], axis=1)
    path = interpolate(frames_at(np.zeros((5, 3)), around), count=21)
    np.testing.assert_allclose(centres_of(path), 0, rtol=0, atol=1e-12)
    headings = np.arctan2(*views_of(path)[:, 1::-1].T)
    np.testing.assert_allclose(np.diff(headings), 0.1, rtol=1e-3)
    still = ring(np.zeros(3))[:1] * 3
    for frame in interpolate(still, count=4):
        np.testing.assert_array_equal(frame.world_from_cam, still[0].world_from_cam)


@pytest.mark.parametrize("make", [orbit, spiral, interpolate])
@pytest.mark.parametrize("layout", ["ring", "facing", "one", "two", "along a line"])
def test_every_path_of_every_layout_is_finite_rigid_and_undistorted(make, layout):
    line = np.stack([np.zeros(4), np.zeros(4), np.arange(4.0)], axis=1)
    frames = {
        "ring": ring(np.ones(3)),
        "facing": facing(),
        "one": facing()[:1],
        "two": facing()[:2],
        "along a line": frames_at(line, line + np.array([0, 0, 1.0]), up=np.array([1.0, 0, 0])),
    }[layout]
    path = make(frames, count=9)
    assert len({frame.name for frame in path}) == 9
    for frame in path:
        rotation = frame.world_from_cam[:3, :3]
        assert np.isfinite(frame.world_from_cam).all()
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-12)
        assert frame.camera == Camera("PINHOLE", 64, 48, (51, 51, 32, 24))
        assert frame.image is None


@pytest.mark.parametrize("make", [orbit, ellipse, spiral, interpolate])
def test_a_path_needs_frames_and_views(make):
    with pytest.raises(ValueError, match="got 0 frames and count 5"):
        make([], count=5)
    with pytest.raises(ValueError, match="count 0"):
        make(facing(), count=0)


def test_there_is_nothing_to_orbit_for_a_camera_on_a_tripod_that_looks_around():
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    frames = frames_at(np.zeros((8, 3)), np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=1))
    with pytest.raises(UserError, match="are in one place"):
        orbit(frames, count=5)
