"""Points found in photos with known poses, and how far a scene reaches by them."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import rotation_from_vector
from nerfcli.scene import Scene
from nerfcli.train.extent import Extent, choose_extent, lacks_depth
from nerfcli.train.matching import MOST_PHOTOS, chosen_pairs, match
from nerfcli.train.photos import Photo
from nerfcli.train.settings import TrainSettings
from nerfcli.train.triangulation import meetings, triangulate

CAMERA = Camera.pinhole(320, 240, 300.0)
WALL_Z = 3.0
SETTINGS = TrainSettings(budget_seconds=None, steps=1)


def wall_photo(x: float, turned: float, *, used: np.ndarray | None = None) -> Photo:
    """What a camera at (x, 0, 0), turned about its vertical axis, sees of a wall with spots at z = 3."""
    rng = np.random.default_rng(0)
    spots = cv2.GaussianBlur(rng.uniform(0, 255, (600, 800)).astype(np.float32), (0, 0), 3)
    texture = cv2.normalize(spots, spots, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.0, turned, 0.0]))
    pose[0, 3] = x
    matrix = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    # The wall point (X, Y, 3) has the texture's pixel (100 X + 400, 100 Y + 300), its centre half a pixel on.
    wall_from_texture = np.array([[0.01, 0, -3.995], [0, 0.01, -2.995], [0, 0, WALL_Z]])
    world_to_cam = pose[:3, :3].T @ (wall_from_texture - np.outer(pose[:3, 3], [0, 0, 1]))
    to_index = np.array([[1.0, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    shown = cv2.warpPerspective(texture, to_index @ matrix @ world_to_cam, (320, 240), flags=cv2.INTER_CUBIC)
    name = f"{x:.3f}.png"
    return Photo(Frame(name, CAMERA, pose), np.repeat(shown[..., None], 3, axis=2), used)


def scene_of(photos: list[Photo]) -> Scene:
    frames = tuple(photo.frame for photo in photos)
    return Scene(Path("walls"), "transforms", frames, frozenset(), np.zeros((0, 3)), ())


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    """Five of a wall at z = 3, from places 0.3 apart, with axes that meet at z = 1."""
    return [wall_photo(0.3 * i, 0.3 * (2 - i)) for i in range(5)]


def test_points_of_a_wall_lie_on_it(photos):
    points = triangulate(photos, match(photos, threads=2))
    assert len(points) > 200
    z = points[:, 2]
    assert abs(np.median(z) - WALL_Z) < 0.003 * WALL_Z
    assert np.mean(np.abs(z - WALL_Z) < 0.05 * WALL_Z) > 0.95
    assert np.array_equal(points, triangulate(photos, match(photos, threads=1)))


def test_masked_parts_of_photos_give_no_points(photos):
    left = np.zeros((240, 320), dtype=bool)
    left[:, :160] = True
    masked = [replace(photo, used=left) for photo in photos]
    points = triangulate(masked, match(masked, threads=1))
    assert len(points) > 20
    for photo in photos[:1]:
        pixels, _ = photo.frame.camera.project(points - photo.frame.centre)
        assert np.mean(pixels[:, 0] < 320) == 1


def test_the_unit_ball_follows_what_is_found(photos):
    """Cameras whose axes meet 1 before them, and a wall 3 away."""
    scene = scene_of(photos)
    assert lacks_depth(scene, SETTINGS, fills_frame=True)
    scene = replace(scene, points=triangulate(photos, match(photos, threads=1)))
    assert not lacks_depth(scene, SETTINGS, fills_frame=True)
    extent = choose_extent(scene, SETTINGS, fills_frame=True)
    assert 1.8 < 1 / extent.training_from_scene.scale < 4
    assert extent.contraction == "l2"
    near = extent.marching.near / extent.training_from_scene.scale
    assert 0.25 * WALL_Z < near < WALL_Z
    box = choose_extent(scene, replace(SETTINGS, contraction="none"), fills_frame=True)
    assert box.contraction == "none"
    assert str(Extent.from_json(json.loads(json.dumps(box.to_json())))) == "bounded scene"
    assert Extent.from_json(box.to_json()).marching == box.marching
    on_wall = box.training_from_scene.apply(np.array([[-0.5, 0, 3.0], [1.5, 0, 3.0]]))
    assert np.abs(on_wall).max() < 1


def test_depth_bounds_tell_enough_but_where_a_box_is_asked_for(photos):
    bounded = replace(scene_of(photos), depth_bounds=np.array([[1.0, 4.0]] * len(photos)))
    assert not lacks_depth(bounded, SETTINGS, fills_frame=True)
    assert lacks_depth(bounded, replace(SETTINGS, contraction="none"), fills_frame=True)
    assert not lacks_depth(scene_of(photos), SETTINGS, fills_frame=False)  # an object in alpha


def test_nothing_is_found_in_photos_without_detail(photos):
    grey = [replace(photo, pixels=np.full_like(photo.pixels, 128)) for photo in photos]
    assert triangulate(grey, match(grey, threads=1)).shape == (0, 3)
    extent = choose_extent(scene_of(grey), SETTINGS, fills_frame=True)
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
    assert 0 < len(pairs) <= 3 * MOST_PHOTOS
    assert all((a - b) % 2 == 0 for a, b in pairs)


def test_meetings_of_exact_rays_are_exact_and_others_are_left_out():
    centres = np.zeros(3), np.array([1.0, 0.0, 0.0])
    points = np.array([[0.5, 0.1, 2.0], [3.0, -1.0, 5.0], [0.2, 0.0, 500.0], [0.5, 0.1, -2.0], [0.5, 0.5, 2.0]])
    one, other = (points - centre for centre in centres)
    one[3] = -one[3]  # they meet behind the first camera
    other[4] = [-0.5, 0.6, 2.0]  # they pass each other: 0.05 apart at 2
    rays = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in (one, other)]
    found = meetings(centres, (rays[0], rays[1]), (1e-3, 1e-3))  # the third meet at 0.1 degrees
    np.testing.assert_allclose(found, points[:2], rtol=1e-12)
    wider = meetings(centres, (rays[0], rays[1]), (0.05, 0.05))
    assert len(wider) == 3
    assert meetings(centres, (np.full((2, 3), np.nan), rays[1][:2]), (1.0, 1.0)).shape == (0, 3)


def _pose(place: int, turned: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.0, turned, 0.0]))
    pose[0, 3] = 0.1 * place
    return pose
