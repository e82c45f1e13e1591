"""Bearings that photos of one lens share, against those that each camera computes by itself."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from frame_rays import frame_rays
from pools import pool_of_photos
from present import present
from test_training_rays import BARREL, CPU, FISHEYE, SIMILARITY, numbered_photo, ring

from nerfcli.cameras.camera import Camera, by_lens
from nerfcli.training.pool import BearingTables
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.storage import IN_MEMORY, needs_of

LENS = Camera("SIMPLE_RADIAL", 160, 120, (140.0, 80.0, 60.0, 0.05))
SHIFTS = np.array([(0.0, 0.0), (2.5, -1.25), (-3.7, 0.1), (1.0, 2.0), (0.3, -4.9), (-0.001, 3.3), (0.0, 0.0)])


def stabilised(lens: Camera) -> list[Camera]:
    return [lens.with_principal_point(lens.width / 2 + x, lens.height / 2 + y) for x, y in SHIFTS.tolist()]


@pytest.mark.parametrize("lens", [LENS, replace(LENS, model="PINHOLE", params=(140.0, 139.0, 80.0, 60.0))])
def test_rays_of_stabilised_photos_are_those_of_their_cameras(lens):
    """Every pixel of every photo, the borders too; interpolation is off by 1 / (8 f) of a pixel, 1 / f of a radian."""
    photos = [numbered_photo(i, camera, ring()[i % 5]) for i, camera in enumerate(stabilised(lens))]
    pool = pool_of_photos(photos, SIMILARITY)
    assert pool.without_ray == 0
    count = lens.width * lens.height
    for index, photo in enumerate(photos):
        origins, directions, *_ = pool.rays_of(index * count + torch.arange(count))
        rays = frame_rays(photo.frame, SIMILARITY, CPU)
        assert (directions - rays.directions).abs().max() < 1 / (8 * 140**2) + 3e-7
        assert directions.norm(dim=-1) == pytest.approx(1.0, abs=1e-6)
        assert (origins - rays.origin).abs().max() < 1e-6


def test_photos_of_other_lenses_keep_their_bits():
    """A photo of another lens among stabilised ones has the rays that it has alone."""
    cameras = [*stabilised(LENS), FISHEYE, BARREL]
    photos = [numbered_photo(i, camera, ring()[i % 5]) for i, camera in enumerate(cameras)]
    pool, begin = pool_of_photos(photos, SIMILARITY), 7 * LENS.width * LENS.height
    for photo, camera in ((photos[7], FISHEYE), (photos[8], BARREL)):
        numbers = torch.arange(camera.width * camera.height)
        alone = pool_of_photos([photo], SIMILARITY).rays_of(numbers)
        among = pool.rays_of(begin + numbers)
        assert torch.equal(among.directions, alone.directions)
        begin += len(numbers)


def test_photos_share_one_table_of_their_lens():
    tables = BearingTables(stabilised(LENS), CPU, storage=IN_MEMORY)
    assert len(tables.values) == (160 + 7 + 1) * (120 + 9 + 1)
    assert (present(tables.grids).widths == torch.tensor([160, 168])).all()
    same = BearingTables([LENS, LENS], CPU, storage=IN_MEMORY)
    assert len(same.values) == 160 * 120
    assert same.grids is None


def test_principal_points_far_apart_do_not_share():
    """Two crops of one picture, side by side: one table for both would be no smaller than two."""
    cameras = [LENS.with_principal_point(0.0, 60.0), LENS.with_principal_point(160.0, 60.0)]
    tables = BearingTables(cameras, CPU, storage=IN_MEMORY)
    assert len(tables.values) == 2 * 160 * 120
    assert tables.grids is None


def test_pixels_beyond_the_lens_are_left_out():
    """Where a lens turns back, a photo may lose the last ring of pixels, whose bearings would need one beyond."""
    cameras = [BARREL.with_principal_point(12.0 + x, 9.0 + y) for x, y in ((0.0, 0.0), (0.6, 0.3), (-0.4, 0.9))]
    tables = BearingTables(cameras, CPU, storage=IN_MEMORY)
    assert tables.grids is not None
    for camera in cameras:
        _, valid = camera.pixel_bearings()
        seen = tables.valid(camera)
        assert not (seen & ~valid).any()
        inside = valid.reshape(18, 24).astype(np.uint8)
        inside = cv2.erode(inside, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
        assert seen[inside.ravel() > 0].all()
        assert seen.sum() > 100


def test_lenses_are_distinguished_by_everything_but_the_principal_point():
    longer = replace(LENS, params=(141.0, 80.0, 60.0, 0.05))
    lenses = by_lens([LENS, longer, LENS.with_principal_point(70.0, 61.0), FISHEYE, LENS])
    assert sorted(len(cameras) for cameras in lenses.values()) == [1, 1, 2]
    panorama = Camera("EQUIRECTANGULAR", 64, 32, (64.0, 32.0))
    assert panorama.with_principal_point(1.0, 2.0) == panorama


def test_the_memory_of_stabilised_photos_counts_their_bearings_once():
    settings = TrainSettings(budget_seconds=None, steps=7)
    own, one = ([replace(ring()[0], camera=camera) for camera in cameras] for cameras in (stabilised(LENS), [LENS] * 7))
    assert needs_of(own, 1, settings=settings).photos == needs_of(one, 1, settings=settings).photos


def test_trials_need_a_list_of_pixels_and_occluders_another_one():
    """Eight bytes of a number and one of a mask; two masks for occluders, which users may turn off."""
    chosen = TrainSettings(budget_seconds=None, steps=7)
    trials = replace(chosen, model="auto")
    several = (chosen, replace(trials, fixed=("occluders",)), trials)
    photos = [needs_of(ring(), 1, settings=settings).photos for settings in several]
    pixels = sum(frame.camera.width * frame.camera.height for frame in ring())
    assert np.diff(photos).tolist() == [9 * pixels, 10 * pixels]


def test_a_step_of_a_network_needs_its_neurons():
    """Of each sample all activations and their gradients, float32: a layer has 1 / 3.5 of the weights."""
    sizes = [TrainSettings(field="mlp", field_memory_bytes=size) for size in (2**18, 2**26)]
    small, large = (needs_of(ring(), 1, settings=size).step for size in sizes)
    width = (2**26 / 4 / 3.5) ** 0.5
    more = 7 * (2**26 - 2**18) + TrainSettings().samples[1] * 4 * 2 * 4 * width * (1 - 1 / 16)
    assert large - small == pytest.approx(more, rel=0.1)
