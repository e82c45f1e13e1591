"""Points found in photos with known poses, and how far a scene reaches by them."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import rotation_from_vector
from nerfcli.captures.capture import Capture
from nerfcli.matching.correspondences import chosen_pairs, match
from nerfcli.matching.features import Matches
from nerfcli.matching.tracks import Tracks, indices_by_value, tracks_of_matches, triangulate
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training.extent import Extent, choose_extent, lacks_depth
from nerfcli.training.runs.settings import TrainSettings

CAMERA = Camera.pinhole(320, 240, 300.0)
WALL_Z = 3.0
SETTINGS = TrainSettings(budget_seconds=None, steps=1)


def wall_photo(x: float, turned: float, *, used: np.ndarray | None = None) -> LoadedPhoto:
    """Render a wall with spots at z = 3, seen by a camera at (x, 0, 0) turned about its vertical axis."""
    rng = np.random.default_rng(0)
    spots = cv2.GaussianBlur(rng.uniform(0, 255, (600, 800)).astype(np.float32), (0, 0), 3)
    texture = cv2.normalize(spots, spots, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.0, turned, 0.0]))
    pose[0, 3] = x
    matrix = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    # Wall point (X, Y, 3) is at the texture's pixel (100 X + 400, 100 Y + 300), whose centre is half a pixel further.
    wall_from_texture = np.array([[0.01, 0, -3.995], [0, 0.01, -2.995], [0, 0, WALL_Z]])
    world_to_cam = pose[:3, :3].T @ (wall_from_texture - np.outer(pose[:3, 3], [0, 0, 1]))
    to_index = np.array([[1.0, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    shown = cv2.warpPerspective(texture, to_index @ matrix @ world_to_cam, (320, 240), flags=cv2.INTER_CUBIC)
    name = f"{x:.3f}.png"
    return LoadedPhoto(Frame(name, CAMERA, pose), np.repeat(shown[..., None], 3, axis=2), used)


def scene_of(photos: list[LoadedPhoto]) -> Capture:
    frames = tuple(photo.frame for photo in photos)
    return Capture(frames, np.zeros((0, 3)), kind="transforms", root=Path("walls"))


def found_in(photos: list[LoadedPhoto], *, threads: int = 1) -> np.ndarray:
    """Return the points triangulated from matched features of the photos."""
    tracks = tracks_of_matches(photos, match(photos, threads=threads))
    return triangulate([photo.frame for photo in photos], tracks).found


@pytest.fixture(scope="module")
def photos() -> list[LoadedPhoto]:
    """Five photos of a wall at z = 3, taken 0.3 apart, with axes that meet at z = 1."""
    return [wall_photo(0.3 * i, 0.3 * (2 - i)) for i in range(5)]


def test_points_of_a_wall_lie_on_it(photos):
    points = found_in(photos, threads=2)
    assert len(points) > 200
    z = points[:, 2]
    assert abs(np.median(z) - WALL_Z) < 0.003 * WALL_Z
    assert np.mean(np.abs(z - WALL_Z) < 0.05 * WALL_Z) > 0.95
    assert np.array_equal(points, found_in(photos))


def test_masked_parts_of_photos_give_no_points(photos):
    left = np.zeros((240, 320), dtype=bool)
    left[:, :160] = True
    masked = [replace(photo, used=left) for photo in photos]
    points = found_in(masked)
    assert len(points) > 20
    for photo in photos[:1]:
        pixels, _ = photo.frame.camera.project(points - photo.frame.centre)
        assert np.mean(pixels[:, 0] < 320) == 1


def test_the_unit_ball_follows_what_is_found(photos):
    """The cameras' axes meet 1 in front of them, and the wall is 3 away."""
    scene = scene_of(photos)
    assert lacks_depth(scene, SETTINGS, is_object=False)
    scene = replace(scene, points=found_in(photos))
    assert not lacks_depth(scene, SETTINGS, is_object=False)
    extent = choose_extent(scene, SETTINGS, is_object=False)
    assert 1.8 < 1 / extent.training_from_scene.scale < 4
    assert extent.contraction == "l2"
    near = extent.marching.near / extent.training_from_scene.scale
    assert 0.25 * WALL_Z < near < WALL_Z
    box = choose_extent(scene, replace(SETTINGS, contraction="none"), is_object=False)
    assert box.contraction == "none"
    assert str(Extent.from_json(json.loads(json.dumps(box.to_json())))) == "bounded scene"
    assert Extent.from_json(box.to_json()).marching == box.marching
    on_wall = box.training_from_scene.apply(np.array([[-0.5, 0, 3.0], [1.5, 0, 3.0]]))
    assert np.abs(on_wall).max() < 1


def test_depth_bounds_are_enough_unless_a_box_is_requested(photos):
    bounded = replace(scene_of(photos), depth_bounds=np.array([[1.0, 4.0]] * len(photos)))
    assert not lacks_depth(bounded, SETTINGS, is_object=False)
    assert lacks_depth(bounded, replace(SETTINGS, contraction="none"), is_object=False)
    assert not lacks_depth(scene_of(photos), SETTINGS, is_object=True)  # an object in alpha


def test_nothing_is_found_in_photos_without_detail(photos):
    grey = [replace(photo, pixels=np.full_like(photo.pixels, 128)) for photo in photos]
    assert found_in(grey).shape == (0, 3)
    extent = choose_extent(scene_of(grey), SETTINGS, is_object=False)
    assert np.isfinite(extent.training_from_scene.scale)


def test_photos_of_one_place_have_no_pairs(photos):
    assert chosen_pairs([photos[0]] * 4) == []
    assert match([photos[0]] * 4, threads=1) == ()
    assert chosen_pairs(photos[:1]) == []


def test_pairs_are_few_and_look_the_same_way():
    many = [wall_photo(0.0, 0.0)] * 300
    many = [
        replace(photo, frame=replace(photo.frame, world_from_cam=_pose(i, np.pi * (i % 2))))
        for i, photo in enumerate(many)
    ]
    pairs = chosen_pairs(many)
    assert 0 < len(pairs) <= 3 * 16
    assert all((a - b) % 2 == 0 for a, b in pairs)


def frames_at(centres: np.ndarray) -> list[Frame]:
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    poses[:, :3, 3] = centres
    return [Frame(f"{i}.png", CAMERA, pose) for i, pose in enumerate(poses)]


def tracks_of(points: np.ndarray, centres: np.ndarray, seen: list[tuple[int, int]]) -> Tracks:
    """Exact rays from cameras to points, for pairs of (photo, point)."""
    photos, of = np.array(seen).T
    rays = points[of] - centres[photos]
    return Tracks(photos, of, rays / np.linalg.norm(rays, axis=1, keepdims=True))


@pytest.mark.parametrize("offset", [0.0, 4e6])
def test_points_of_exact_rays_are_exact_wherever_the_world_begins(offset):
    """To 1e-12 of the distances, plus the rounding of coordinates as large as those of GPS."""
    rng = np.random.default_rng(0)
    centres, points = rng.uniform(-1, 1, (5, 3)) + offset, rng.uniform(-1, 1, (40, 3)) * (2, 2, 1) + (0, 0, 5) + offset
    seen = [(photo, point) for point in range(40) for photo in rng.permutation(5)[: 2 + point % 4]]
    surface = triangulate(frames_at(centres), tracks_of(points, centres, seen))
    is_solved = ~np.isnan(surface.points[:, 0])
    assert is_solved.mean() > 0.9
    np.testing.assert_allclose(surface.points[is_solved], points[is_solved], rtol=0, atol=1e-12 * (1 + 1e3 * offset))
    assert np.nanmax(surface.misses_px) < 1e-3
    assert np.isnan(surface.misses_px).sum() == sum(not is_solved[point] for _, point in seen)


@given(st.lists(st.integers(-1, 6), max_size=30), st.integers(0, 5))
def test_places_of_numbers_are_those_that_are_equal(numbers, count):
    found = indices_by_value(np.array(numbers, dtype=int), count)
    assert [list(places) for places in found] == [
        [place for place, number in enumerate(numbers) if number == wanted] for wanted in range(count)
    ]


def test_photos_that_disagree_give_no_evidence():
    """Rays that meet behind a camera, miss each other, meet at 0.1 degrees, or are of one photo only; and no rays."""
    centres = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    points = np.array(
        [[0.5, 0.1, 2.0], [0.5, 0.1, -2.0], [0.5, 0.5, 2.0], [0.2, 0.0, 500.0], [0.3, 0.3, 3.0], [1, 1, 4.0]]
    )
    tracks = tracks_of(points, centres, [(photo, point) for point in range(6) for photo in (0, 1)])
    rays = tracks.rays.copy()
    rays[2:4] *= -1  # the second
    rays[4] += (0.0, 0.05, 0.0)  # the third: 5 px off in both photos
    rays[8] = np.nan
    surface = triangulate(frames_at(centres), replace(tracks, rays=rays))
    assert np.isfinite(surface.points).all(axis=1).tolist() == [True, False, False, False, False, True]
    assert np.isfinite(surface.misses_px).reshape(6, 2).all(axis=1).tolist() == [True, False, False, False, False, True]
    assert triangulate(frames_at(centres), Tracks(*(column[:0] for column in vars(tracks).values()))).found.shape == (
        0,
        3,
    )


def test_a_point_that_a_single_photo_is_left_to_have_seen_is_none():
    """Two rays miss each other by 0.03, 1 in front of one camera and 10 in front of the other: 4.5 px off in the first
    photo and 0.45 in the second, which alone gives no distance. A third ray, on the other side of the first, hides this
    until it is itself found to be wrong."""
    centres = np.array([[0.3, 0.0, 0.0], [0.0, 0.0, -9.0], [-0.3, 0.0, 0.0]])
    rays = np.array([[0.0, 0.03, 1.0], [0.3, 0.0, 10.0], [0.6, 0.06, 1.0]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for count in (2, 3):
        surface = triangulate(frames_at(centres), Tracks(np.arange(count), np.zeros(count, int), rays[:count]))
        assert np.isnan(surface.points).all()
        assert np.isnan(surface.misses_px).all()


def test_matches_where_a_lens_has_no_direction_have_no_ray():
    lens = SimpleNamespace(bearings=lambda pixels: (np.ones((len(pixels), 3)), pixels[:, 0] < 50))
    photo = SimpleNamespace(frame=SimpleNamespace(camera=lens, world_from_cam=np.eye(4)))
    pixels = np.array([[20.0, 1.0], [90.0, 1.0]])
    tracks = tracks_of_matches([photo, photo], [Matches((0, 1), (pixels, pixels))])  # type: ignore[list-item]
    assert np.isfinite(tracks.rays).all(axis=1).tolist() == [True, False] * 2
    assert tracks.points.tolist() == [0, 1, 0, 1]


def test_a_wrong_sighting_among_right_ones_is_left_out():
    """Six photos agree, and one is off by 20 px: the point is where the six have it."""
    centres = np.array([[x, y, 0.0] for x in (0.0, 1.0, 2.0) for y in (0.0, 1.0)] + [[1.0, 0.5, 0.3]])
    points = np.array([[0.8, 0.6, 4.0]])
    tracks = tracks_of(points, centres, [(photo, 0) for photo in range(7)])
    rays = tracks.rays.copy()
    rays[6] += (20 / CAMERA.focal_px, 0.0, 0.0)
    surface = triangulate(frames_at(centres), replace(tracks, rays=rays / np.linalg.norm(rays, axis=1, keepdims=True)))
    np.testing.assert_allclose(surface.points, points, rtol=1e-9)
    assert np.isfinite(surface.misses_px).tolist() == [True] * 6 + [False]


def _pose(place: int, turned: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.0, turned, 0.0]))
    pose[0, 3] = 0.1 * place
    return pose
