"""Pixels that look like a sky, in photos of a sky by direction above textured hills and of a plain wall."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import rotation_from_vector
from nerfcli.matching import sky
from nerfcli.matching.sky import PointsBefore, points_before, points_of_depths, points_of_tracks, sky_masks
from nerfcli.matching.stereo import DenseDepth
from nerfcli.matching.tracks import MOST_POINTS, Tracks
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training.evidence import Evidence, confirm_sky, find_sky

CAMERA = Camera.pinhole(160, 120, 140.0)
GAINS = (1.0, 0.8, 1.2, 0.9, 1.0)


def photo(x: float, *, turned: float = 0.0, gain: float = 1.0, below: bool = False) -> LoadedPhoto:
    """Return a photo whose sky has a colour by direction, with noise under a skyline 10 degrees above the horizon."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array([0.0, turned, 0.0]))
    pose[0, 3] = x
    rays = (CAMERA.pixel_bearings()[0] @ pose[:3, :3].T).reshape(120, 160, 3)
    sky = np.stack([90 - 60 * rays[..., 1], 120 - 40 * rays[..., 0], 170 + 0 * rays[..., 1]], axis=-1)
    ground = np.random.default_rng(round(1000 * x)).uniform(0, 255, (120, 160, 3))
    is_plain = rays[..., 1:2] > 0.17 if below else rays[..., 1:2] < -0.17
    levels = np.where(is_plain, gain * sky, ground)
    return LoadedPhoto(Frame(f"{x}.png", CAMERA, pose), np.clip(np.rint(levels), 0, 255).astype(np.uint8), None)


def is_sky(one: LoadedPhoto) -> np.ndarray:
    rays = (CAMERA.pixel_bearings()[0] @ one.frame.world_from_cam[:3, :3].T).reshape(120, 160, 3)
    return rays[..., 1] < -0.17


def photos() -> list[LoadedPhoto]:
    return [photo(0.2 * k, turned=0.05 * k, gain=gain) for k, gain in enumerate(GAINS)]


def test_the_sky_is_found_up_to_its_border_whatever_the_exposures():
    for one, mask in zip(photos(), sky_masks(photos(), threads=1), strict=True):
        assert mask.shape == (120, 160)
        assert not mask[~is_sky(one)].any()
        assert mask[is_sky(one)].mean() > 0.97


def noise(k: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 255, shape)


def moving_patches() -> list[LoadedPhoto]:
    """A plain patch that moves against the directions, as a near thing does."""
    plain = photos()
    for k, one in enumerate(plain):
        one.pixels[...] = noise(k, *one.pixels.shape)
        one.pixels[10:40, 10 + 30 * k : 34 + 30 * k] = 200
    return plain


def under_roofs() -> list[LoadedPhoto]:
    """What was the sky may be a wall of its colour."""
    roofed = photos()
    for k, one in enumerate(roofed):
        one.pixels[:16] = noise(k, 16, 160, 3)
    return roofed


NO_SKY = {
    "plain ground": lambda: [photo(0.2 * k, turned=0.05 * k, below=True) for k in range(4)],
    "elsewhere in each photo": moving_patches,
    "below a roof": under_roofs,
    "a single photo": lambda: photos()[:1],
}


@pytest.mark.parametrize("case", NO_SKY)
def test_what_else_is_plain_is_no_sky(case):
    assert not np.any(sky_masks(NO_SKY[case](), threads=1))


def test_a_wire_does_not_end_a_sky():
    with_wires = photos()
    for one in with_wires:
        one.pixels[20:22] = 0
    for mask in sky_masks(with_wires, threads=1):
        assert mask[:16].mean() > 0.7
        assert mask[26:30].mean() > 0.7


def test_the_sky_of_a_camera_on_its_side_is_found():
    upright, one_aside = photos(), photos()
    clockwise = np.eye(4)
    clockwise[:2, :2] = [[0.0, 1.0], [-1.0, 0.0]]  # its x axis is down, its y axis to the right
    frame = Frame("aside.png", Camera.pinhole(120, 160, 140.0), one_aside[2].frame.world_from_cam @ clockwise)
    one_aside[2] = LoadedPhoto(frame, np.ascontiguousarray(np.rot90(one_aside[2].pixels, -1)), None)
    mask, turned = sky_masks(upright, threads=1)[2], sky_masks(one_aside, threads=1)[2]
    assert (np.rot90(turned) != mask).mean() < 0.02
    assert mask.any()
    one_aside[2].pixels[:, -16:] = noise(0, 160, 16, 3)  # a roof
    assert not sky_masks(one_aside, threads=1)[2].any()


def test_a_mask_is_no_sky():
    masked = [LoadedPhoto(one.frame, one.pixels, np.arange(160) >= np.full((120, 1), 80)) for one in photos()]
    for mask in sky_masks(masked, threads=2):
        assert not mask[:, :79].any()
        assert mask[:, 80:].any()


def before(points: np.ndarray, of: list[LoadedPhoto], *, seen_by: int) -> PointsBefore:
    """Return what the tracks of these points (N, 3), each seen by the first photos, say about the masks of the sky."""
    numbers, indices = np.tile(np.arange(len(points)), seen_by), np.repeat(np.arange(seen_by), len(points))
    rays = points[numbers] - np.array([one.frame.centre for one in of])[indices]
    tracks = Tracks(indices, numbers, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    return points_before(sky_masks(of, threads=1), of, points_of_tracks(of, tracks))


def points_in_front(count: int, *, above: bool) -> np.ndarray:
    """Return points (N, 3) 2 to 5 units away, above the skyline or below."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(2.0, 5.0, count)
    slope = rng.uniform(-0.35, -0.25, count) if above else rng.uniform(-0.1, 0.4, count)
    return np.stack([rng.uniform(-0.3, 0.3, count) * depth, slope * depth, depth], axis=-1)


def test_points_below_the_skyline_confirm_the_sky_and_points_above_refute_it():
    ground = before(points_in_front(800, above=False), photos(), seen_by=3)
    assert ground.found == 0
    area = np.mean([mask.mean() for mask in sky_masks(photos(), threads=1)])
    assert 0.7 * 5 * 700 * area / (1 - area) < ground.expected < 5 * 800 * area / (1 - area)
    assert ground.confirm
    assert not ground.refute
    both = np.concatenate([points_in_front(800, above=False), points_in_front(30, above=True)])
    wall = before(both, photos(), seen_by=3)
    assert 60 < wall.found <= 150  # in all five photos, wherever the three that see them stand
    assert wall.refute
    assert not wall.confirm


def test_few_points_and_points_of_two_photos_decide_nothing():
    for points, seen_by in ((points_in_front(100, above=False), 3), (points_in_front(800, above=True), 2)):
        found = before(points, photos(), seen_by=seen_by)
        assert not found.confirm
        assert not found.refute
    none = points_of_tracks(photos(), Tracks(*empty()))
    assert points_before([np.zeros((120, 160), bool)] * 5, photos(), none) == PointsBefore(0, 0.0)


def test_depths_by_stereo_confirm_a_sky_where_the_capture_has_no_points():
    of = photos()
    skies = sky_masks(of, threads=1)
    shared = SimpleNamespace(of_model=Tracks(*empty()))
    seen: Any = SimpleNamespace(album=SimpleNamespace(photos=of), shared=shared, plain=None)
    rows, columns = np.divmod(np.arange(0, 120 * 160, 7), 160)
    everywhere = np.stack([columns, rows], axis=-1)
    below = everywhere[rows > 60]
    for pixels, is_sky_confirmed in ((below, True), (everywhere, False), (below[:9], False)):
        depth = DenseDepth(pixels, np.full(len(pixels), 3.0), np.zeros(len(pixels)))
        found = Evidence(may_match=False)
        find_sky(found, skies, seen, device=torch.device("cpu"))
        assert found.sky is not None
        assert found.sky.sum() == sum(mask.sum() for mask in skies)
        assert not found.sky_confirmed
        confirm_sky(found, skies, seen, [depth] * len(of))
        assert found.sky_confirmed == is_sky_confirmed
        assert found.sky is not None


def test_pixels_of_known_depth_are_points_at_their_distances():
    of = photos()[1:3]
    pixels = np.array([[0, 0], [80, 60], [159, 119]])
    dense = [DenseDepth(pixels, np.array([2.0, 3.0, 5.0]), np.zeros(3)) for _ in of]
    points = points_of_depths(of, dense).reshape(2, 3, 3)
    for one, found in zip(of, points, strict=True):
        in_camera = (found - one.frame.centre) @ one.frame.world_from_cam[:3, :3]
        np.testing.assert_allclose(np.linalg.norm(in_camera, axis=1), [2.0, 3.0, 5.0], rtol=1e-12)
        np.testing.assert_allclose(CAMERA.project(in_camera)[0], pixels + 0.5, rtol=0, atol=1e-9)
    vague = replace(dense[0], errors=np.array([0.0, 0.03, np.nan]))
    assert len(points_of_depths(of, [vague, vague])) == 2
    many = DenseDepth(np.zeros((MOST_POINTS, 2), np.int64), np.ones(MOST_POINTS), np.zeros(MOST_POINTS))
    assert len(points_of_depths(of, [many, many])) == MOST_POINTS
    assert len(points_of_depths(of, [replace(many, errors=many.errors + 1.0)] * 2)) == 0


def empty() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))


def test_more_points_than_needed_are_thinned_out(monkeypatch):
    monkeypatch.setattr(sky, "MOST_POINTS", 400)
    whole = before(points_in_front(800, above=False), photos(), seen_by=3)
    monkeypatch.undo()
    assert 0.4 < whole.expected / before(points_in_front(800, above=False), photos(), seen_by=3).expected < 0.6


def test_a_scene_far_from_the_origin_gives_the_same_counts():
    both = np.concatenate([points_in_front(800, above=False), points_in_front(30, above=True)])
    away = np.array([300.0, -200.0, 100.0])
    elsewhere = photos()
    for one in elsewhere:
        one.frame.world_from_cam[:3, 3] += away
    found, wanted = before(both + away, elsewhere, seen_by=3), before(both, photos(), seen_by=3)
    assert found.found == pytest.approx(wanted.found, abs=2)
    assert found.expected == pytest.approx(wanted.expected, rel=0.01)
