"""Depth of photos by stereo matching, on two textured walls whose distance is known in closed form."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pools import pool_of_photos

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, rotation_from_vector
from nerfcli.matching.stereo import LONGER_SIDE_PX, SECONDS_PER_PIXEL, DenseDepth, affordable_side_px, dense_depths
from nerfcli.matching.tracks import Tracks
from nerfcli.photos.images import write_png
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training.evidence import dense_points

PINHOLE = Camera.pinhole(200, 150, 180.0)
LENS = Camera("RADIAL", 200, 150, (180.0, 103.0, 72.0, -0.12, 0.03))
# Two walls that meet at right angles or so, each turned by 40 degrees from the cameras: x . NORMAL = 3.
NORMALS = np.array([[np.sin(0.7), 0.0, np.cos(0.7)], [-np.sin(0.7), 0.0, np.cos(0.7)]])
OFFSETS = (0.0, 0.25, -0.25, 0.5)
TEXTURE = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (900, 900)).astype(np.float32), (0, 0), 2)


def truth(camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (h, w) along the rays of a camera to the nearer wall, and the points (h, w, 3)."""
    rays = (camera.pixel_bearings()[0] @ pose[:3, :3].T).reshape(camera.height, camera.width, 3)
    distances = ((3.0 - NORMALS @ pose[:3, 3]) / (rays @ NORMALS.T)).min(-1)
    return distances, pose[:3, 3] + distances[..., None] * rays


def photo(
    x: float, *, z: float = 0.0, turned: float = 0.0, camera: Camera = PINHOLE, contrast: float = 4.0
) -> LoadedPhoto:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.0, turned, 0.0]))
    pose[0, 3], pose[2, 3] = x, z
    _, points = truth(camera, pose)
    x_texture, y_texture = (points[..., axis].astype(np.float32) * 130 + 450 for axis in (0, 1))
    shown = 128 + contrast * (cv2.remap(TEXTURE, x_texture, y_texture, cv2.INTER_CUBIC) - 128)
    grey = np.clip(np.rint(shown), 0, 255).astype(np.uint8)
    return LoadedPhoto(Frame(f"{x:.3f}_{z:.3f}.png", camera, pose), np.repeat(grey[..., None], 3, axis=2), None)


def tracks(photos: list[LoadedPhoto]) -> Tracks:
    """Points of the walls as all photos see them, in view or not."""
    x, y = np.random.default_rng(1).uniform(-1.5, 1.5, (2, 400))
    points = np.stack([x, y, ((3.0 - x[:, None] * NORMALS[:, 0]) / NORMALS[:, 2]).min(-1)], axis=-1)
    parts = []
    for number, one in enumerate(photos):
        away = points - one.frame.centre
        rays = away / np.linalg.norm(away, axis=1, keepdims=True)
        parts.append((np.full(400, number), np.arange(400), rays))
    return Tracks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def written(folder: Path, photos: list[LoadedPhoto]) -> tuple[Frame, ...]:
    """Write photos as 0.png, 1.png, ... and return their frames."""
    for number, one in enumerate(photos):
        write_png(folder / f"{number}.png", one.pixels)
    paths = [folder / f"{number}.png" for number in range(len(photos))]
    return tuple(replace(one.frame, name=path.name, image=path) for one, path in zip(photos, paths, strict=True))


def found(photos: list[LoadedPhoto], threads: int = 1) -> list[DenseDepth]:
    return dense_depths(photos, tracks(photos), longer_side_px=200, threads=threads)


SMALL = Camera.pinhole(120, 160, 150.0)
AHEAD = (0.0, 0.3, 0.6, -0.3)
# Photos, least fraction of pixels with a depth, and the largest error, relative to the distance, of half and of 97 %.
# A column is 0.1 px of disparity sideways.
MATCHED = {
    "pinhole": (lambda: [photo(x) for x in OFFSETS], 0.5, 0.008, 0.03),
    "lens": (lambda: [photo(x, camera=LENS) for x in OFFSETS], 0.5, 0.008, 0.03),
    "sizes and turns": (
        lambda: [photo(0.0), photo(0.3, turned=-0.1), photo(-0.3, camera=SMALL), photo(0.15, turned=0.05)],
        *(0.3, 0.008, 0.02),
    ),
    "two photos": (lambda: [photo(0.0), photo(0.3)], 0.5, 0.008, 0.03),
    "ahead": (lambda: [photo(0.0, z=z) for z in AHEAD], 0.3, 0.012, 0.05),
    "ahead, lens": (lambda: [photo(0.0, z=z, camera=LENS) for z in AHEAD], 0.3, 0.012, 0.05),
    "ahead, beside the view": (lambda: [photo(0.4 * z, z=z, turned=0.1 * z) for z in AHEAD], 0.3, 0.012, 0.05),
    "ahead, epipole outside": (lambda: [photo(1.2 * z, z=z) for z in AHEAD], 0.3, 0.012, 0.05),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("case", MATCHED)
def test_pixels_of_two_walls_have_their_distance_within_the_error_that_is_claimed(case):
    make, share, median, near = MATCHED[case]
    photos = make()
    for one, depth in zip(photos, found(photos), strict=True):
        columns, rows = depth.pixels.T
        assert len(columns) > share * one.pixels[..., 0].size
        assert len(np.unique(depth.pixels, axis=0)) == len(columns)
        off = np.abs(depth.distances / truth(one.frame.camera, one.frame.world_from_cam)[0][rows, columns] - 1.0)
        assert np.median(off) < median
        assert np.percentile(off / depth.errors, 68) < 1.0
        assert np.percentile(off / depth.errors, 95) > 0.1
        assert np.mean(off < near) > 0.97


NOTHING = {
    "one photo": lambda: [photo(0.0)],
    "the camera only turned": lambda: [photo(0.0, turned=turn) for turn in (-0.1, 0.0, 0.1)],
    "no common part": lambda: [photo(0.0), photo(0.3, turned=2.0), photo(-0.3, turned=-2.0)],
    "no texture": lambda: [photo(x, contrast=0.02) for x in OFFSETS],
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("case", NOTHING)
def test_no_depth_error_is_reported_without_evidence_of_depth(case):
    photos = NOTHING[case]()
    assert [len(depth.pixels) for depth in found(photos)] == [0] * len(photos)


def test_without_points_there_are_no_neighbours():
    nothing = Tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    photos = [photo(x) for x in OFFSETS]
    assert all(len(depth.pixels) == 0 for depth in dense_depths(photos, nothing, longer_side_px=200, threads=1))


def test_masked_and_transparent_pixels_have_no_depth():
    used = np.ones((150, 200), dtype=bool)
    used[:, :100] = False
    photos = [replace(photo(x), used=used) for x in OFFSETS[:3]]
    alpha = np.where(np.arange(150) < 75, 0, 255).astype(np.uint8)[:, None].repeat(200, 1)
    clear = photo(OFFSETS[3])
    photos.append(replace(clear, pixels=np.concatenate([clear.pixels, alpha[..., None]], axis=-1)))
    depths = found(photos)
    assert all(len(depth.pixels) > 1000 for depth in depths)
    assert min(depth.pixels[:, 0].min() for depth in depths[:3]) >= 100
    assert depths[3].pixels[:, 1].min() >= 75


def test_threads_change_nothing():
    photos = [photo(x) for x in OFFSETS]
    for one, other in zip(found(photos), found(photos, threads=2), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(vars(one).values(), vars(other).values(), strict=True))


def test_depths_are_pixels_of_the_pool_in_its_frame():
    similarity = Similarity(0.5, np.eye(3), np.array([1.0, 2.0, 3.0]))
    photos = [photo(x) for x in OFFSETS]
    pool = pool_of_photos(photos, similarity)
    depths = found(photos)
    of_stereo = dense_points(depths, pool)
    rays = pool.rays_of(of_stereo.numbers)
    ends = rays.origins + rays.directions * of_stereo.distances[:, None]
    points = similarity.inverse().apply(ends.double().numpy())
    assert np.median(np.abs((points @ NORMALS.T).max(-1) - 3.0)) < 0.02
    errors = np.concatenate([depth.errors for depth in depths])
    assert of_stereo.trust.numpy() == pytest.approx(1 / (1 + (errors / 0.05) ** 2), rel=1e-5)


def test_pictures_are_as_large_as_there_is_time_for():
    photos = [photo(x) for x in OFFSETS]
    assert affordable_side_px(photos, seconds=1e9, threads=1) == LONGER_SIDE_PX
    side = affordable_side_px(photos, seconds=0.5, threads=1)
    assert 4 * 0.75 * side**2 * SECONDS_PER_PIXEL == pytest.approx(0.5, rel=0.02)
    assert affordable_side_px(photos, seconds=0.5, threads=2) == pytest.approx(side * 2**0.5, abs=1)
    assert affordable_side_px(photos, seconds=0.01, threads=1) == 0
