"""Inputs of training: the normalised frame, photos at the size of training, pixels with their rays."""

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from frame_rays import frame_rays
from pools import pool_of_photos
from present import present

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts, look_at, rotation_from_quaternion
from nerfcli.captures.capture import Capture
from nerfcli.errors import OUT_OF_MEMORY, UserError
from nerfcli.machine import default_memory_limit, resident_bytes
from nerfcli.photos.images import downscale, write_png
from nerfcli.photos.loading import LoadedPhoto, downscaled_camera, load_photos
from nerfcli.training import preparation
from nerfcli.training.appearance import over_background
from nerfcli.training.extent import (
    BALLS_BEFORE_BACKGROUND,
    Extent,
    box_frame,
    choose_extent,
    contracted_frame,
    has_narrow_baseline,
    narrow_frame,
    object_frame,
)
from nerfcli.training.losses import colour_losses
from nerfcli.training.pool import Album, PixelPool, load_album
from nerfcli.training.preparation import prepare
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.storage import IN_MEMORY, InFiles, MemoryNeeds, PhotoStorage, check_device_memory, storage_for

CPU = torch.device("cpu")
CAMERA, MIDDLE = Camera.pinhole(40, 30, 50.0), np.array([1.0, 2.0, 3.0])
MOVED = Similarity(250.0, rotation_from_quaternion(np.array([0.7, -0.1, 0.5, 0.5])), np.array([1e4, -2e4, 300.0]))


def write_photo(path: Path, level: int = 90, *, height: int = 30, width: int = 40) -> Path:
    write_png(path, np.full((height, width, 3), level, dtype=np.uint8))
    return path


def ring(count: int = 12, radius: float = 3.0, moved: Similarity | None = None) -> list[Frame]:
    """Cameras at distances radius and 2 radius in turn about the middle, looking at it."""
    frames = []
    for index in range(count):
        angle = 2 * math.pi * index / count
        distance = radius * (1 + index % 2)
        centre = MIDDLE + distance * np.array([math.cos(angle), math.sin(angle), 0.5]) / 1.25**0.5
        pose = look_at(centre, MIDDLE, np.array([0.0, 0.0, 1.0]))
        frames.append(Frame(f"{index:02d}.png", CAMERA, pose if moved is None else moved.apply_pose(pose)))
    return frames


def scene_of(frames: list[Frame], points: np.ndarray | None = None) -> Capture:
    return Capture(tuple(frames), np.zeros((0, 3)) if points is None else points, kind="transforms")


def sphere(radius: float, count: int) -> np.ndarray:
    """Return points (N, 3) all around the point that the cameras of `ring` look at."""
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return MIDDLE + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def training_centres(scene: Capture, similarity: Similarity) -> np.ndarray:
    return np.array([similarity.apply(frame.centre) for frame in scene.frames])


def test_unbounded_scenes_are_centred_where_cameras_look_and_reach_to_the_median_camera():
    scene = scene_of(ring())
    similarity, marching = contracted_frame(scene)
    np.testing.assert_allclose(similarity.apply(MIDDLE), 0, atol=1e-9)
    distances = np.linalg.norm(training_centres(scene, similarity), axis=1)
    assert np.median(distances) == pytest.approx(1, abs=1e-9)
    assert marching.far > 100 * distances.max()
    assert 0 < marching.near < distances.min()


def test_bounded_scenes_are_as_wide_as_the_widest_picture():
    scene = scene_of(ring())
    similarity, marching = object_frame(scene)
    centres = training_centres(scene, similarity)
    distances = np.linalg.norm(centres, axis=1)
    half_width = distances * math.tan(math.radians(max(CAMERA.fov_deg)) / 2)
    assert half_width.max() == pytest.approx(1, abs=1e-9)
    # The whole cube is between near and far of every camera.
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    to_corners = np.linalg.norm(centres[:, None] - corners, axis=-1)
    assert marching.far >= to_corners.max()
    assert marching.near <= to_corners.min()


@pytest.mark.parametrize("frame_of", [contracted_frame, object_frame])
def test_the_training_frame_can_be_undone_and_does_not_depend_on_where_the_capture_lies(frame_of):
    points = np.random.default_rng(0).normal((1, 2, 3), size=(50, 3))
    here, there = scene_of(ring(), points), scene_of(ring(moved=MOVED), MOVED.apply(points))
    first, marching = frame_of(here)
    second, marching_there = frame_of(there)
    np.testing.assert_allclose(first.inverse().apply(first.apply(points)), points, atol=1e-12)
    np.testing.assert_allclose(second.inverse().apply(second.apply(there.points)), there.points, rtol=1e-12)
    # Up to a rotation, which the normalisation does not change, the two training frames are the same.
    rotated = Similarity(1.0, MOVED.rotation, np.zeros(3))
    np.testing.assert_allclose(second.apply(there.points), rotated.apply(first.apply(points)), atol=1e-8)
    for name in ("near", "far", "shortest_step", "growth"):
        assert getattr(marching_there, name) == pytest.approx(getattr(marching, name), rel=1e-8)


def test_the_unit_ball_reaches_what_cameras_see_where_it_is_behind_them():
    """Walls at 10 and cameras at 3 and 6 from the middle: the median depths of cameras are about 13 and 16."""
    walls = sphere(10, 20000)
    radius = 1 / contracted_frame(scene_of(ring(), walls))[0].scale
    assert radius == pytest.approx(0.75 * 14.5, rel=0.05)
    # A few stray points far away change little; too few points are ignored.
    stray = np.concatenate([walls, sphere(1e6, 500)])
    assert 1 / contracted_frame(scene_of(ring(), stray))[0].scale == pytest.approx(radius, rel=0.02)
    assert 1 / contracted_frame(scene_of(ring(), walls[:20]))[0].scale == pytest.approx(4.5, rel=1e-9)
    # An object surrounded by the cameras is in front of them and changes nothing.
    assert 1 / contracted_frame(scene_of(ring(), sphere(1, 20000)))[0].scale == pytest.approx(4.5, rel=1e-9)


def test_panoramas_are_as_far_from_all_around_them_as_from_what_is_ahead():
    """From the middle of a sphere of radius 10, z of half of the points ahead is less than 5."""
    panorama = Camera("EQUIRECTANGULAR", 64, 32, (64, 32))
    frames = [replace(frame, camera=panorama) for frame in ring(radius=0.01)]
    similarity, _, background = narrow_frame(scene_of(frames, sphere(10, 2000)))
    assert 1 / similarity.scale == pytest.approx(10, rel=0.01)
    assert background == pytest.approx(2.5, rel=0.01)


def test_a_box_holds_the_points_but_for_stray_ones():
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, 0, 5), (5, 2, 8), (5000, 3))
    scene = scene_of(ring(), np.concatenate([points, rng.normal(0, 1e4, (20, 3))]))
    similarity, marching = box_frame(scene)
    inside = np.abs(similarity.apply(points))
    assert inside.max() < 1
    assert inside[:, 0].max() > 0.88  # the longest side fills the cube
    for frame in scene.frames:
        distances = np.linalg.norm(similarity.apply(points) - similarity.apply(frame.centre), axis=1)
        assert (distances < marching.far).all()
        assert (distances > marching.near).all()


def test_a_box_needs_points():
    with pytest.raises(UserError, match="cannot be estimated from its 3 points") as caught:
        box_frame(scene_of(ring(), np.zeros((3, 3))))
    assert "--contraction l2" in caught.value.hint


def test_near_is_before_what_the_cameras_see():
    # Points on a ball of radius 2 around the focus; the nearest one to each camera is at least 1 away.
    points = sphere(2, 4000)
    scene = scene_of(ring(), points)
    similarity, marching = contracted_frame(scene)
    nearest = min(np.linalg.norm(points - frame.centre, axis=1).min() for frame in scene.frames)
    assert marching.near < nearest * similarity.scale


def test_depth_bounds_of_forward_facing_captures_set_the_focus():
    # Parallel cameras do not look at a common point: the focus is 1.6, the harmonic mean of the bounds, before them.
    frames = side_by_side(-2, -1, 0, 1, 2)
    scene = replace(scene_of(frames), depth_bounds=np.tile([1.0, 4.0], (5, 1)))
    similarity, marching = contracted_frame(scene)
    np.testing.assert_allclose(similarity.inverse().apply(np.zeros(3)), [0, 0, 1.6], atol=1e-6)
    assert marching.near == pytest.approx(0.9 * similarity.scale, rel=1e-6)


def side_by_side(*places: float, turned: Similarity | None = None) -> list[Frame]:
    """Parallel cameras on a line, looking along +z."""
    poses = [from_parts(np.eye(3), np.array([place, 0.0, 0.0])) for place in places]
    poses = poses if turned is None else [turned.apply_pose(pose) for pose in poses]
    return [Frame(f"{number}.png", CAMERA, pose) for number, pose in enumerate(poses)]


@pytest.mark.parametrize("spread", [0.3, 0.99, 1.01, 3.0])
def test_a_narrow_baseline_is_one_below_half_of_the_nearest_depth(spread):
    scene = replace(scene_of(side_by_side(-spread, 0.0, spread)), depth_bounds=np.tile([2.0, 8.0], (3, 1)))
    assert has_narrow_baseline(scene) == (spread < 1.0)
    extent = choose_extent(scene, TrainSettings(), is_object=False)
    ball, marching = narrow_frame(scene)[:2] if spread < 1.0 else contracted_frame(scene)
    assert extent.training_from_scene.scale == ball.scale
    assert extent.marching == marching
    # Cameras that are close together see a motion along a ray half as large as its length, at most.
    assert extent.parallax == (0.5 if spread < 1.0 else 1.0)
    assert Extent.from_json(extent.to_json()).to_json() == extent.to_json()
    if spread > 1.0:  # a learned background surrounds the unit ball, seen from the farthest camera
        centres = training_centres(scene, extent.training_from_scene)
        assert extent.reach == pytest.approx(np.linalg.norm(centres, axis=1).max() + BALLS_BEFORE_BACKGROUND)
    assert not has_narrow_baseline(replace(scene, depth_bounds=None))
    # Bounds that begin at the cameras give no radius, not even to cameras that only turn.
    turning = replace(scene_of(side_by_side(0.0, 0.0)), depth_bounds=np.array([[0.0, 8.0], [0.0, 8.0]]))
    assert not has_narrow_baseline(turning)
    # An object on an empty background needs no depth.
    assert choose_extent(scene, TrainSettings(), is_object=True).contraction == "none"


def test_narrow_captures_lie_in_contracted_space_behind_a_ball_around_the_cameras():
    places = (0.0, 0.2, 0.7)
    for turned in (None, MOVED):
        unit = 1.0 if turned is None else turned.scale
        frames = side_by_side(*places, turned=turned)
        scene = replace(scene_of(frames), depth_bounds=unit * np.tile([2.0, 8.0], (3, 1)))
        similarity, marching, background = narrow_frame(scene)
        centres = training_centres(scene, similarity)
        np.testing.assert_allclose(centres.mean(axis=0), 0, atol=1e-9)
        assert np.linalg.norm(centres, axis=1).max() < 0.5
        assert 1 / similarity.scale == pytest.approx(2.0 * unit, rel=1e-9)
        assert marching.near == pytest.approx(0.9)  # of the nearest depth, which is 1 here
        assert background == pytest.approx(2.5 * 3.2 / 2.0)  # the harmonic mean of the bounds is 3.2
        extent = choose_extent(scene, TrainSettings(), is_object=False)
        assert extent.before("sphere", sky_known=False).marching.far == pytest.approx(background)
        assert extent.before("black", sky_known=False).marching == marching


def test_points_reveal_a_narrow_baseline_and_rays_begin_before_them():
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.3, -0.3, 4.0), (0.3, 0.3, 9.0), (3000, 3))
    scene = scene_of(side_by_side(-0.5, 0.0, 0.5), points)
    assert has_narrow_baseline(scene)
    similarity, marching, _ = narrow_frame(scene)
    assert 4.0 < 1 / similarity.scale < 4.4
    assert marching.near / similarity.scale == pytest.approx(0.3 / similarity.scale)
    assert marching.near / similarity.scale < 4.0


@pytest.mark.parametrize("size", [(96, 64), (97, 71), (95, 66)])
@pytest.mark.parametrize("factor", [1, 2, 4, 8])
def test_a_downscaled_camera_fits_the_area_averaged_picture(size, factor):
    # Colours that are linear in the direction survive averaging exactly; the small camera must see the same ones.
    width, height = size
    camera = Camera("PINHOLE", width, height, (90.0, 88.0, width / 2 + 3, height / 2 - 2))
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    picture = np.stack([x * 2, y * 3, np.zeros_like(x)], axis=-1)
    small = downscale(np.round(picture).astype(np.uint8), factor)
    shrunk = downscaled_camera(camera, factor)
    assert small.shape[:2] == (shrunk.height, shrunk.width)
    bearings, valid = shrunk.pixel_bearings()
    assert valid.all()
    pixels, _ = camera.project(bearings)
    # Half a level of rounding when the picture is made, half a level when it is averaged.
    np.testing.assert_allclose(small[..., 0].ravel(), pixels[:, 0] * 2, atol=1.0)
    np.testing.assert_allclose(small[..., 1].ravel(), pixels[:, 1] * 3, atol=1.0)


def numbered_photo(index: int, camera: Camera, frame: Frame) -> LoadedPhoto:
    """Return a photo whose colours encode each pixel's (photo, row, column)."""
    rows, columns = np.indices((camera.height, camera.width))
    layers = [np.full_like(rows, index), rows, columns]
    return LoadedPhoto(replace(frame, camera=camera), np.stack(layers, axis=-1).astype(np.uint8), None)


FISHEYE = Camera("OPENCV_FISHEYE", 33, 21, (20.0, 21.0, 16.0, 11.0, 0.1, -0.02, 0.0, 0.0))
# The radius r (1 - 0.4 r^2) turns back before the corners: these pixels have no ray.
BARREL = Camera("OPENCV", 24, 18, (16.0, 16.0, 12.0, 9.0, -0.4, 0.0, 0.0, 0.0))
SIMILARITY = Similarity(0.3, rotation_from_quaternion(np.array([0.8, 0.2, -0.4, 0.4])), np.array([0.3, -0.2, 0.1]))


def drawn(pool: PixelPool, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw random pixels; return their origins, directions, and (count, 3) numbers (photo, row, column)."""
    origins, directions, colours = pool.draw(count, torch.Generator().manual_seed(0))[:3]
    assert colours.dtype == torch.float32
    return origins.numpy(), directions.numpy(), np.round(colours[:, :3].numpy() * 255).astype(int)


def test_drawn_rays_are_those_of_whole_pictures():
    cameras = (CAMERA, FISHEYE, CAMERA, BARREL, FISHEYE)
    photos = [numbered_photo(i, camera, ring()[i]) for i, camera in enumerate(cameras)]
    origins, directions, numbers = drawn(pool_of_photos(photos, SIMILARITY), 5000)
    assert set(numbers[:, 0]) == {0, 1, 2, 3, 4}
    for index, photo in enumerate(photos):
        rays = frame_rays(photo.frame, SIMILARITY, CPU)
        mine = numbers[:, 0] == index
        flat = numbers[mine, 1] * photo.frame.camera.width + numbers[mine, 2]
        assert rays.valid[flat].all()
        np.testing.assert_allclose(directions[mine], rays.directions[flat].numpy(), atol=5e-7)
        np.testing.assert_allclose(origins[mine], np.tile(rays.origin.numpy(), (mine.sum(), 1)), atol=1e-6)


def test_every_usable_pixel_is_drawn_equally_often():
    # Chi-squared over the pixels of two photos of different size: mean n - 1, standard deviation sqrt(2 n).
    photos = [numbered_photo(0, BARREL, ring()[0]), numbered_photo(1, FISHEYE, ring()[1])]
    usable = int(BARREL.pixel_bearings()[1].sum() + FISHEYE.pixel_bearings()[1].sum())
    pool = pool_of_photos(photos, SIMILARITY)
    assert pool.without_ray == 24 * 18 + 33 * 21 - usable > 0
    _, _, numbers = drawn(pool, 100 * usable)
    counts = np.unique(numbers, axis=0, return_counts=True)[1]
    assert len(counts) == usable
    assert np.square(counts - 100).sum() / 100 < usable + 5 * math.sqrt(2 * usable)


def test_masked_pixels_are_never_drawn():
    photo = numbered_photo(0, CAMERA, ring()[0])
    used = np.zeros((30, 40), dtype=bool)
    used[7, 31] = used[29, 0] = True
    _, _, numbers = drawn(pool_of_photos([replace(photo, used=used)], SIMILARITY), 200)
    assert {tuple(row) for row in numbers} == {(0, 7, 31), (0, 29, 0)}
    with pytest.raises(UserError, match="no pixels are left to train on"):
        pool_of_photos([replace(photo, used=np.zeros_like(used))], SIMILARITY)


def test_masks_shrink_to_pixels_that_are_used_whole(tmp_path):
    mask = np.full((30, 40, 3), 255, dtype=np.uint8)
    mask[5, 9] = 0
    write_png(tmp_path / "mask.png", mask)
    frame = replace(ring()[0], image=write_photo(tmp_path / "photo.png"), mask=tmp_path / "mask.png")
    (photo,) = load_photos([frame], factor=2, threads=1)
    expected = np.ones((15, 20), dtype=bool)
    expected[2, 4] = False
    np.testing.assert_array_equal(present(photo.used), expected)


def test_photos_that_do_not_fit_their_camera_are_reported(tmp_path):
    photo, small = write_photo(tmp_path / "photo.png"), write_photo(tmp_path / "small.png", height=15, width=20)
    frame = ring()[0]
    for wrong, message in (
        (frame, r"00\.png has no photo"),
        (replace(frame, image=small), r"small\.png is 20x15 pixels, but its camera is for 40x30"),
        (replace(frame, image=photo, mask=small), r"small\.png is 20x15, but its photo is 40x30"),
        (replace(frame, image=tmp_path / "gone.png"), r"photo not found: .*gone\.png"),
    ):
        with pytest.raises(UserError, match=message):
            load_photos([wrong], factor=1, threads=2)


def test_photos_come_in_the_order_of_their_frames(tmp_path):
    numbered = enumerate(ring())
    frames = [replace(frame, image=write_photo(tmp_path / frame.name, 10 * index)) for index, frame in numbered]
    photos = load_photos(frames, factor=2, threads=4)
    assert [int(photo.pixels[0, 0, 0]) for photo in photos] == [10 * index for index in range(12)]
    assert {photo.pixels.shape for photo in photos} == {(15, 20, 3)}


def test_colours_over_a_background():
    background = torch.tensor([[1.0, 0.5, 0.0], [0.2, 0.2, 0.2]])
    rgb = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    assert torch.equal(over_background(rgb, background), rgb)
    rgba = torch.cat([rgb, torch.tensor([[0.25], [1.0]])], dim=1)
    expected = torch.tensor([[0.25 * 0.1 + 0.75, 0.25 * 0.2 + 0.375, 0.25 * 0.3], [0.4, 0.5, 0.6]])
    torch.testing.assert_close(over_background(rgba, background), expected)


def test_the_loss_of_colours_is_quadratic_for_noise_and_linear_for_outliers():
    measured = torch.zeros(1, 3)
    for error, expected in ((0.0, 0.0), (0.02, 0.5 * 0.02**2 / 0.1), (0.8, 0.8 - 0.05)):
        assert colour_losses(measured + error, measured).mean().item() == pytest.approx(expected, rel=1e-5)


def test_a_pixel_is_found_again_by_its_number():
    # Every pixel of two photos of different size has its own colour.
    photos = []
    for name, width, height, first in (("a.png", 7, 5, 0), ("b.png", 4, 6, 100)):
        pixels = np.zeros((height, width, 3), dtype=np.uint8)
        pixels[..., 0] = np.arange(first, first + width * height).reshape(height, width)
        camera = Camera("SIMPLE_PINHOLE", width, height, (5.0, width / 2, height / 2))
        photos.append(LoadedPhoto(Frame(name, camera, np.eye(4)), pixels, None))
    pool = pool_of_photos(photos, SIMILARITY)
    by_name = {photo.frame.name: photo.pixels for photo in photos}
    for number in range(len(pool.colours)):
        name, x, y = pool.place(number)
        assert by_name[name][y, x, 0] == pool.colours[number, 0]


def drawn_from(frames: list[Frame], room: PhotoStorage) -> tuple[list[bytes], Album, PixelPool]:
    album = load_album(frames, factor=2, threads=2, storage=room)
    pool = PixelPool(album, SIMILARITY, CPU, storage=room)
    drawn = pool.draw(3000, torch.Generator().manual_seed(4))
    return [tensor.numpy().tobytes() for tensor in drawn], album, pool


@pytest.mark.parametrize("alpha", [(False, False), (True, True), (False, True)])
@pytest.mark.parametrize("masked", [False, True])
def test_photos_in_files_give_the_same_rays_as_in_memory(alpha, masked, tmp_path):
    # And both give those of photos that were loaded one by one.
    rng = np.random.default_rng(0)
    frames = []
    for index, has_alpha in enumerate(alpha):
        camera = Camera("SIMPLE_PINHOLE", 20 + 2 * index, 14, (15.0, 10.0, 7.0))
        path, mask = tmp_path / f"{index}.png", tmp_path / f"mask{index}.png"
        write_png(path, rng.integers(0, 256, size=(14, camera.width, 4 if has_alpha else 3), dtype=np.uint8))
        write_png(mask, rng.choice([0, 255, 255, 255], size=(14, camera.width)).astype(np.uint8))
        frames.append(Frame(path.name, camera, np.eye(4), path, mask if masked else None))
    in_memory, album, pool = drawn_from(frames, IN_MEMORY)
    in_files, _, _ = drawn_from(frames, InFiles(tmp_path / "room", 1))  # a limit that is always exceeded
    assert in_files == in_memory
    one_by_one = pool_of_photos(load_photos(frames, factor=2, threads=1), SIMILARITY)
    drawn = one_by_one.draw(3000, torch.Generator().manual_seed(4))
    assert [tensor.numpy().tobytes() for tensor in drawn] == in_memory
    assert album.fills_frame == (not all(alpha))
    assert pool.has_alpha == any(alpha)
    assert not list((tmp_path / "room").iterdir())  # files without a name


@pytest.mark.parametrize("transparent", [False, True])
def test_alpha_that_is_opaque_in_all_photos_is_none(transparent, tmp_path):
    """Regression: a flower before black, in PNGs with opaque alpha, was taken for a cut-out in a bounded black box."""
    frames = []
    for index in range(2):
        pixels = np.random.default_rng(index).integers(0, 255, (14, 20, 4), dtype=np.uint8)
        pixels[..., 3] = 0 if transparent and index else 255
        write_png(tmp_path / f"{index}.png", pixels)
        camera = Camera("SIMPLE_PINHOLE", 20, 14, (15.0, 10.0, 7.0))
        frames.append(Frame(f"{index}.png", camera, np.eye(4), tmp_path / f"{index}.png"))
    _, album, pool = drawn_from(frames, IN_MEMORY)
    assert pool.has_alpha == transparent
    assert album.fills_frame != transparent
    assert {photo.pixels.shape[-1] for photo in load_photos(frames, factor=1, threads=1)} == {4 if transparent else 3}


def test_pages_are_given_back_beyond_the_limit(tmp_path):
    room = InFiles(tmp_path, resident_bytes(os.getpid()) + 2**23)
    before = resident_bytes(os.getpid())
    array = room.array((2**26,), np.uint8)
    for part in range(16):
        array[part * 2**22 : (part + 1) * 2**22] = part
        room.release_pages()
    assert resident_bytes(os.getpid()) < before + 2**24  # of 2**26 written
    assert [int(array[part * 2**22 + 7]) for part in range(16)] == list(range(16))


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="only Linux lists what is mapped")
def test_a_file_goes_with_its_array(tmp_path):
    def mapped() -> int:
        return Path("/proc/self/maps").read_text().count(str(tmp_path))

    room = InFiles(tmp_path, 1)
    array = room.array((5000, 3), np.uint8)
    assert mapped() == 1
    del array
    assert mapped() == 0
    room.release_pages()


def test_what_does_not_fit_is_refused_up_front(tmp_path):
    needs = MemoryNeeds(photos=3 * 10**9, step=10**9, rest=10**9)
    assert storage_for(needs, None, folder=tmp_path)[0] is IN_MEMORY
    assert storage_for(needs, 4 * 10**9, folder=tmp_path)[0] is IN_MEMORY
    room, reported = storage_for(needs, 2 * 10**9, folder=tmp_path)
    assert isinstance(room, InFiles)
    assert "about 4.00 GB needed, limit 2.00 GB: the photos (3.00 GB) are kept in temporary files" in reported
    said = r"needs about 1\.00 GB of memory in addition to the photos, but the limit is 0\.90 GB"
    with pytest.raises(UserError, match=said) as caught:
        storage_for(needs, 9 * 10**8, folder=tmp_path)
    assert caught.value.exit_code == OUT_OF_MEMORY


def test_a_gpu_without_room_is_refused_up_front(monkeypatch):
    needs = MemoryNeeds(photos=3 * 10**9, step=10**9, rest=9 * 10**9)  # decoding is on the host and does not count
    device = torch.device("cuda:1")
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (4 * 10**9, 8 * 10**9))
    assert check_device_memory(needs, device, None) == "memory on cuda:1: about 4.00 GB of 4.00 GB that are free"
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (3 * 10**9, 8 * 10**9))
    with pytest.raises(UserError, match=r"needs about 4\.00 GB of memory on cuda:1, where 3\.00 GB are free") as caught:
        check_device_memory(needs, device, None)
    assert caught.value.exit_code == OUT_OF_MEMORY
    assert "--device cpu" in caught.value.hint


def test_a_limit_of_memory_is_that_of_the_gpu(monkeypatch, tmp_path):
    """The limit is passed to torch; the host's memory then has its default limit."""
    needs, device = MemoryNeeds(photos=3 * 10**9, step=10**9, rest=0), torch.device("cuda:1")
    kept: list[tuple[float, torch.device]] = []
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (6 * 10**9, 10 * 10**9))
    monkeypatch.setattr(torch.cuda, "set_per_process_memory_fraction", lambda *given: kept.append(given))
    with pytest.raises(UserError, match=r"4\.00 GB of memory on cuda:1, where the limit is 3\.90 GB"):
        check_device_memory(needs, device, 39 * 10**8)
    with pytest.raises(UserError, match=r"8\.00 GB of memory on cuda:1, where 6\.00 GB are free"):
        check_device_memory(MemoryNeeds(7 * 10**9, 10**9, 0), device, 9 * 10**9)
    assert kept == []
    check_device_memory(needs, device, 5 * 10**9)
    assert kept == [(0.5, device)]
    assert default_memory_limit("cuda:1") is None
    needed = MemoryNeeds(photos=0, step=0, rest=2 * (default_memory_limit() or 0))
    monkeypatch.setattr(preparation, "needs_of", lambda *given, **named: needed)
    settings = TrainSettings(steps=1, device="cuda:1")
    with pytest.raises(UserError, match="in addition to the photos, but the limit is"):
        prepare(scene_of(ring()), settings, run=tmp_path, notify=lambda text: None)


def test_a_full_disk_is_reported_before_anything_is_written(tmp_path):
    with pytest.raises(UserError, match="cannot write"):
        InFiles(tmp_path, 1).array((2**55,), np.uint8)
