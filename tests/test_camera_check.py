"""Focal lengths from matched features of known points and cameras, with noise, wrong matches and wrong poses."""

import math
from dataclasses import replace

import numpy as np
import pytest

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.lens_change import FOCAL, changed
from nerfcli.cameras.rigid import rotation_from_vector
from nerfcli.matching.camera_check import FARTHEST, FEWEST_MATCHES, CameraCheck, check_cameras
from nerfcli.matching.correspondences import LONGER_SIDE_PX, chosen_pairs
from nerfcli.matching.features import Matches
from nerfcli.photos.loading import LoadedPhoto

PINHOLE = Camera.pinhole(600, 450, 550.0)
LENSES = {
    "pinhole": PINHOLE,
    "distorted": Camera("OPENCV", 600, 450, (550.0, 545.0, 290.0, 230.0, -0.12, 0.03, 1e-3, -1e-3)),
    "fisheye": Camera("OPENCV_FISHEYE", 600, 450, (300.0, 300.0, 300.0, 225.0, 0.02, -0.01, 0.0, 0.0)),
}


def ring(camera: Camera, *, turned_deg: float = 0.0) -> list[LoadedPhoto]:
    """Return cameras on an arc that look at its centre, each then turned by an angle about a random axis of its own."""
    rng = np.random.default_rng(1)
    photos = []
    for index in range(16):
        angle = 0.09 * (index - 7.5)
        pose = np.eye(4)
        axis = rng.normal(size=3)
        wrong = rotation_from_vector(math.radians(turned_deg) * axis / np.linalg.norm(axis))
        pose[:3, :3] = rotation_from_vector(np.array([0.0, angle, 0.0])) @ wrong
        pose[:3, 3] = 4.0 * np.array([-math.sin(angle), 0.05 * math.cos(5.0 * angle), 1.0 - math.cos(angle) - 1.0])
        black = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
        photos.append(LoadedPhoto(Frame(f"{index}.png", camera, pose), black, None))
    return photos


def matched(photos: list[LoadedPhoto], *, noise_px: float, wrong: float) -> list[Matches]:
    """Return matches of points in a ball between pairs of photos; a fraction of them is wrong by tens of pixels."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400, 3)) * 0.8
    made = []
    for pair in chosen_pairs(photos):
        seen, inside = [], np.ones(len(points), dtype=bool)
        for index in pair:
            frame = photos[index].frame
            pixels, valid = frame.camera.project((points - frame.centre) @ frame.world_from_cam[:3, :3])
            size = np.array([frame.camera.width, frame.camera.height])
            inside &= valid & (pixels > 0).all(1) & (pixels < size).all(1)
            away = np.where(rng.random((len(points), 1)) < wrong, 30.0, noise_px)
            seen.append(pixels + away * rng.normal(size=pixels.shape))
        made.append(Matches(pair, (seen[0][inside], seen[1][inside])))
    return made


def with_lens(photos: list[LoadedPhoto], log_factor: float) -> list[LoadedPhoto]:
    return [
        replace(photo, frame=replace(photo.frame, camera=changed(photo.frame.camera, (FOCAL,), np.array([log_factor]))))
        for photo in photos
    ]


def checked(photos: list[LoadedPhoto], matches: list[Matches]) -> CameraCheck:
    check = check_cameras(photos, matches)
    assert check is not None
    return check


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("factor", [1.0, 1.02, 0.95, 1.08])
def test_the_focal_length_is_found_among_noise_and_wrong_matches(lens, factor):
    photos = ring(LENSES[lens])
    matches = matched(photos, noise_px=0.2, wrong=0.1)
    check = checked(with_lens(photos, math.log(factor)), matches)
    assert check.log_focal == pytest.approx(-math.log(factor), abs=4.0 * check.error)
    assert 1e-5 < check.error < (3e-3 if lens == "fisheye" else 1e-3)  # the object fills only the middle of it
    assert check.misses_px[1] < 0.3
    if factor != 1.0 and lens != "fisheye":
        assert check.misses_px[0] > 1.3 * check.misses_px[1]


def test_exact_matches_determine_it_to_a_hundredth_of_a_per_cent():
    photos = ring(PINHOLE)
    check = checked(with_lens(photos, 0.013), matched(photos, noise_px=0.0, wrong=0.0))
    assert check.log_focal == pytest.approx(-0.013, abs=1e-4)
    assert check.misses_px[1] < 0.01
    assert check.matches == sum(len(m.pixels[0]) for m in matched(photos, noise_px=0.0, wrong=0.0))


def test_the_error_is_that_of_leaving_out_each_tenth_of_the_photos():
    """The same check without the matches of these photos, in ten calls."""
    photos = ring(PINHOLE)
    every = matched(photos, noise_px=0.5, wrong=0.1)
    matches = [replace(m, pixels=(m.pixels[0][::4], m.pixels[1][::4])) for m in every]
    without = [
        checked(photos, [m for m in matches if left not in (m.photos[0] % 10, m.photos[1] % 10)]).log_focal
        for left in range(10)
    ]
    assert checked(photos, matches).matches < 4000
    assert checked(photos, matches).error == pytest.approx(math.sqrt(10 - 1) * np.std(without), rel=1e-6)


def test_misses_are_in_pixels_of_the_pictures_that_features_are_sought_in():
    """Moving one picture by d pixels across the baseline gives a miss of d pixels."""
    photos = ring(PINHOLE)
    matches = [
        replace(m, pixels=(m.pixels[0], m.pixels[1] + np.array([0.0, 3.0])))
        for m in matched(photos, noise_px=0.0, wrong=0.0)
    ]
    assert PINHOLE.width == LONGER_SIDE_PX
    assert checked(photos, matches).misses_px[0] == pytest.approx(3.0, rel=0.15)


def test_wrong_poses_are_not_taken_for_a_wrong_lens():
    """Photos turned by half a degree: the misses stay, and the focal length is off by no more than its uncertainty."""
    check = checked(ring(PINHOLE, turned_deg=0.5), matched(ring(PINHOLE), noise_px=0.2, wrong=0.1))
    assert abs(check.log_focal) < 4.0 * check.error
    assert min(check.misses_px) > 1.5


def test_where_no_length_fits_the_misses_are_reported():
    """Focal lengths that are 35 % too long, far outside of the range that is searched."""
    photos = ring(PINHOLE)
    check = checked(with_lens(photos, 3 * FARTHEST), matched(photos, noise_px=0.2, wrong=0.0))
    assert (check.log_focal, check.error) == (0.0, math.inf)
    assert check.misses_px[0] == check.misses_px[1] > 3.0


def test_nothing_is_reported_without_enough_evidence():
    photos = ring(PINHOLE)
    matches = matched(photos, noise_px=0.2, wrong=0.0)
    few = [replace(m, pixels=(m.pixels[0][:2], m.pixels[1][:2])) for m in matches]
    assert sum(len(m.pixels[0]) for m in few) > FEWEST_MATCHES
    assert check_cameras(photos, matches[:5]) is None
    assert check_cameras(photos, few[: FEWEST_MATCHES // 2 - 1]) is None
    assert check_cameras(photos, []) is None
    around = Camera("EQUIRECTANGULAR", 600, 300, (600.0, 300.0))
    assert check_cameras(ring(around), matches) is None


def test_rays_along_the_line_between_two_cameras_do_no_harm():
    """Photos one behind the other: the middle of both is on that line, and fits any focal length."""
    photos = []
    for index, photo in enumerate(ring(PINHOLE)):
        pose = np.eye(4)
        pose[2, 3] = 0.1 * index - 6.0
        photos.append(replace(photo, frame=replace(photo.frame, world_from_cam=pose)))
    middle = np.array([[300.0, 225.0]])
    matches = [
        replace(m, pixels=(np.vstack([m.pixels[0], middle]), np.vstack([m.pixels[1], middle])))
        for m in matched(photos, noise_px=0.0, wrong=0.0)
    ]
    check = checked(photos, matches)
    assert np.isfinite([check.log_focal, check.error, *check.misses_px]).all()
    assert check.misses_px[0] < 0.01
