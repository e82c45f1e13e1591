"""Scale from known distances, GPS and printed markers, on scenes of known size; and their standard errors."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from captures import random_similarity
from commands import completed
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from nerfcli.cameras import rigid
from nerfcli.cameras.alignment import align, align_robustly
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.captures.boards import (
    CharucoBoard,
    Side,
    nearest_in_pixels,
    refine_corners,
    scale_from_charuco,
    scale_from_corners,
    scale_from_markers,
)
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.colmap import write_colmap_binary
from nerfcli.captures.loading import load_scene
from nerfcli.captures.scale import (
    KnownDistance,
    ScaleEstimate,
    known_distance,
    scale_from_distances,
    scale_from_gps,
)
from nerfcli.errors import UserError
from nerfcli.photos.geodesy import Position, east_north_up, ecef
from nerfcli.photos.images import write_png

few = examples(20)
seeds = st.integers(0, 2**32 - 1)


def frames_at(centres: np.ndarray) -> list[Frame]:
    camera = Camera.pinhole(64, 48, 50.0)
    return [Frame(f"{i:03d}.jpg", camera, rigid.from_parts(np.eye(3), centre)) for i, centre in enumerate(centres)]


def test_an_estimate_as_json():
    estimate = ScaleEstimate(2.5, 0.01, (("a", 3.0), ("b", -4.0)), "percent", "2 known distances")
    assert estimate.to_json() == {
        "metres_per_unit": 2.5,
        "standard_error": 0.01,
        "residuals": {"a": 3.0, "b": -4.0},
        "residual_unit": "percent",
        "rms_residual": pytest.approx(np.sqrt(12.5)),
        "source": "2 known distances",
        "details": "",
    }


# Known distances


def test_distances_by_hand():
    """1, 2 and 4 units for 2, 4.04 and 8 m: the mean of the logarithms gives 2 * 1.01^(1/3)."""
    measured = [KnownDistance("a", 1.0, 2.0), KnownDistance("b", 2.0, 4.04), KnownDistance("c", 4.0, 8.0)]
    estimate = scale_from_distances(measured)
    scale = 2 * 1.01 ** (1 / 3)
    assert estimate.metres_per_unit == pytest.approx(scale, rel=1e-14)
    scatter = np.std(np.log([2, 2.02, 2]), ddof=1) / np.sqrt(3)
    assert estimate.standard_error == pytest.approx(scale * scatter, rel=1e-12)
    expected = [100 * (scale / 2 - 1), 100 * (scale / 2.02 - 1), 100 * (scale / 2 - 1)]
    assert [name for name, _ in estimate.residuals] == ["a", "b", "c"]
    np.testing.assert_allclose([value for _, value in estimate.residuals], expected, rtol=1e-10)
    single = scale_from_distances(measured[:1])
    assert (single.metres_per_unit, single.standard_error, single.source) == (2.0, None, "1 known distance")


def test_tolerances_weigh_and_give_the_error_unless_the_distances_disagree_by_more():
    agree = [KnownDistance("a", 1.0, 2.0, 0.02), KnownDistance("b", 1.0, 2.02, 0.0202)]
    estimate = scale_from_distances(agree)
    assert estimate.metres_per_unit == pytest.approx(2 * np.sqrt(1.01), rel=1e-12)
    assert estimate.standard_error == pytest.approx(estimate.metres_per_unit * 0.01 / np.sqrt(2), rel=1e-12)
    # A distance with a tenth of the error counts a hundred times.
    estimate = scale_from_distances([KnownDistance("a", 1.0, 2.0, 0.002), KnownDistance("b", 1.0, 2.02, 0.0202)])
    assert np.log(estimate.metres_per_unit / 2) == pytest.approx(np.log(1.01) / 101, rel=1e-9)
    apart = [KnownDistance("a", 1.0, 2.0, 0.002), KnownDistance("b", 1.0, 2.2, 0.0022)]
    estimate = scale_from_distances(apart)
    assert estimate.standard_error == pytest.approx(estimate.metres_per_unit * np.log(1.1) / 2, rel=1e-12)
    assert scale_from_distances(agree[:1]).standard_error == pytest.approx(0.02, rel=1e-12)


def test_the_standard_error_of_distances_is_the_spread_of_estimates():
    """Five distances with errors of 1 %: the scatter of 2000 estimates is the RMS of their standard errors."""
    rng = np.random.default_rng(0)
    estimates = [
        scale_from_distances([KnownDistance("d", u, 3.0 * u * np.exp(0.01 * rng.normal())) for u in range(1, 6)])
        for _ in range(2000)
    ]
    scatter = np.std([estimate.metres_per_unit for estimate in estimates])
    stated_error = np.sqrt(np.mean([(estimate.standard_error or 0) ** 2 for estimate in estimates]))
    assert stated_error == pytest.approx(scatter, rel=0.05)
    assert scatter == pytest.approx(3 * 0.01 / np.sqrt(5), rel=0.05)


def test_distances_as_people_type_them():
    frames = [
        Frame(name, Camera.pinhole(8, 8, 8.0), rigid.from_parts(np.eye(3), np.array(centre)))
        for name, centre in {"images/a b.jpg": [0.0, 0, 0], "images/c.jpg": [3.0, 4, 0], "1,2,3": [0.0, 0, 2]}.items()
    ]
    assert known_distance('"a b.jpg" c 2.5', frames) == KnownDistance("a b.jpg to c", 5.0, 2.5)
    assert known_distance("0,0,0 1e0,0,-0 0.3+-0.002", frames) == KnownDistance("0,0,0 to 1e0,0,-0", 1.0, 0.3, 0.002)
    assert known_distance("c.jpg 3,4,12 6±0.1", frames) == KnownDistance("c.jpg to 3,4,12", 12.0, 6.0, 0.1)
    assert known_distance("1,2,3 0,0,0 1", frames).units == 2.0  # a name wins
    for text, what in (
        ("c.jpg 2.5", "is not a valid distance"),
        ("a b c 2.5", "is not a valid distance"),
        ("c.jpg 0,0,0 far", "is not a valid distance"),
        ("it's c.jpg 2.5", "is not a valid distance"),
        ("c.jpg 0,0,0 1+-1+-1", "is not a valid distance"),
        ("c.jpg c.jpg 2.5", "coincide in the scene"),
        ("c.jpg 0,0,0 -2", "invalid distance of -2 m"),
        ("c.jpg 0,0,0 nan", "invalid distance of nan m"),
        ("c.jpg 0,0,0 1+-2", r"1 m ± 2 m"),
        ("c.jpg d.jpg 1", r"no image is named 'd\.jpg'"),
        ("c.jpg 0,0,x 1", "'0,0,x' is not a point"),
    ):
        with pytest.raises(UserError, match=what):
            known_distance(text, frames)


# GPS


def test_ecef_of_places_known_in_closed_form():
    """Equator and poles from the axes alone; Paris from the geodesic textbook value of pyproj (EPSG:4979 to 4978)."""
    b = 6378137.0 * (1 - 1 / 298.257223563)
    found = ecef(np.array([0.0, 0, 90, -90]), np.array([0.0, 90, 17, 0]), np.array([10.0, 0, 5, 0]))
    expected = [[6378147, 0, 0], [0, 6378137, 0], [0, 0, b + 5], [0, 0, -b]]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@given(latitude=st.floats(-89, 89), longitude=st.floats(-180, 180), seed=seeds)
@few
def test_local_metres_are_arcs_of_the_ellipsoid(latitude, longitude, seed):
    """Small steps north and east are radius of curvature times angle (in closed form); distances are those of ECEF."""
    a, f = 6378137.0, 1 / 298.257223563
    e2, sine = f * (2 - f), np.sin(np.radians(latitude))
    meridian = a * (1 - e2) / (1 - e2 * sine**2) ** 1.5
    normal = a / np.sqrt(1 - e2 * sine**2)
    step = 1e-5
    beside = [(latitude + step, longitude, 100.0), (latitude, longitude + step, 100.0)]
    enu = east_north_up([(latitude, longitude, 100.0), *beside, (latitude, longitude, 107.0)])
    north = np.radians(step) * (meridian + 100)
    east = np.radians(step) * (normal + 100) * np.cos(np.radians(latitude))
    np.testing.assert_allclose(enu, [[0, 0, 0], [0, north, 0], [east, 0, 0], [0, 0, 7]], rtol=0, atol=2e-6)


def test_a_photo_without_altitude_is_at_the_median_of_the_others():
    enu = east_north_up([(48.0, 11.0, 500.0), (48.0, 11.0, None), (48.0, 11.0, 510.0), (48.0, 11.0, 504.0)])
    np.testing.assert_allclose(enu[:, 2], [0, 4, 10, 4], rtol=0, atol=1e-6)
    enu = east_north_up([(48.0, 11.0, None), (48.0, 11.0001, None)])
    assert abs(enu[1, 2]) < 1e-4


@given(seed=seeds, count=st.integers(3, 30))
@few
def test_alignment_agrees_with_colmap_and_with_the_truth(seed, count):
    rng = np.random.default_rng(seed)
    x, truth = rng.normal(size=(count, 3)), random_similarity(rng)
    found = align(x, truth.apply(x))
    assert found.scale == pytest.approx(truth.scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation, truth.rotation, rtol=0, atol=1e-7)
    y = truth.apply(x) + 0.1 * truth.scale * rng.normal(size=(count, 3))
    found = align(x, y)
    witness = pycolmap.estimate_sim3d(x, y)
    assert witness is not None
    np.testing.assert_allclose(found.matrix()[:3], witness.matrix(), rtol=0, atol=1e-9 * max(1, truth.scale))
    with pytest.raises(ValueError, match="two points apart"):
        align(np.ones((3, 3)), y[:3])


@given(seed=seeds, count=st.sampled_from([7, 20, 101]))
@few
def test_a_third_of_wrong_points_does_not_move_the_alignment(seed, count):
    rng = np.random.default_rng(seed)
    x, truth = rng.normal(size=(count, 3)), random_similarity(rng)
    wrong = rng.permutation(count)[: count // 3]
    y = truth.apply(x + 0.001 * rng.normal(size=x.shape))
    y[wrong] += truth.scale * 10 * rng.normal(size=(len(wrong), 3))
    found = align_robustly(x, y)
    assert not found.follows[wrong].any()
    assert found.b_from_a.scale == pytest.approx(truth.scale, rel=0.01)
    np.testing.assert_array_equal(found.follows, align_robustly(x, y).follows)  # no chance in it


def with_gps(metres: np.ndarray, errors: np.ndarray, truth: Similarity) -> tuple[list[Frame], dict[str, Position]]:
    """Cameras at places in metres around Munich, in another frame, and their GPS positions with errors in metres."""
    frames = frames_at(truth.inverse().apply(metres))
    east, north, up = (metres + errors).T
    latitude, longitude = 48.137, 11.575
    north_deg = np.degrees(north / 6365000.0)  # nearly: the fit's scale tells the difference below 1e-3
    east_deg = np.degrees(east / (6389000.0 * np.cos(np.radians(latitude))))
    return frames, {
        frame.name: (latitude + float(n), longitude + float(e), 520.0 + float(u))
        for frame, n, e, u in zip(frames, north_deg, east_deg, up, strict=True)
    }


def photographed(
    rng: np.random.Generator, *, count: int, size: float, noise: float
) -> tuple[list[Frame], dict[str, Position], Similarity]:
    """Cameras anywhere in a square of `size` metres, and GPS with `noise` metres in each coordinate."""
    metres = size * rng.uniform(-0.5, 0.5, (count, 3)) * [1, 1, 0.2]
    truth = random_similarity(rng)
    return *with_gps(metres, noise * rng.normal(size=metres.shape), truth), truth


@given(seed=seeds)
@few
def test_gps_gives_the_scale(seed):
    rng = np.random.default_rng(seed)
    frames, gps, truth = photographed(rng, count=60, size=300.0, noise=3.0)
    gps["005.jpg"] = (48.2, 11.7, 520.0)  # the fix of another place
    found = scale_from_gps(frames, gps)
    error = found.metres_per_unit / truth.scale - 1
    assert abs(error) < 0.02
    assert found.residual_unit == "metre"
    stated = re.fullmatch(
        r"the photos are spread over (\d+) m, and the GPS error is ([\d.]+) m; outliers ignored: (.+)", found.details
    )
    assert stated is not None
    assert 3.0 < float(stated[2]) < 8.0  # 3 m in each of three coordinates: 5.2
    assert "005.jpg" in stated[3]
    assert len(stated[3].split(", ")) < 6
    assert max(found.residuals, key=lambda r: r[1])[0] == "005.jpg"


def test_the_standard_error_of_gps_is_the_spread_of_estimates():
    rng = np.random.default_rng(1)
    ratios, stated_error = [], []
    for _ in range(120):
        frames, gps, truth = photographed(rng, count=30, size=200.0, noise=3.0)
        estimate = scale_from_gps(frames, gps)
        ratios.append(estimate.metres_per_unit / truth.scale)
        stated_error.append((estimate.standard_error or 0) / truth.scale)
    assert np.sqrt(np.mean(np.square(stated_error))) == pytest.approx(np.std(ratios), rel=0.25)
    assert abs(np.mean(ratios) - 1) < 0.002


def test_the_standard_error_of_gps_allows_for_correlated_errors_of_neighbours():
    """On a walk around a block, three photos in a row share one error: sqrt(3) times that of independent errors."""
    rng = np.random.default_rng(4)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    walk = 150 * np.stack([np.cos(angle), np.sin(angle), np.zeros(60)], axis=1)
    ratios, stated_error = [], []
    for _ in range(80):
        truth = random_similarity(rng)
        errors = 3 * np.repeat(rng.normal(size=(20, 3)), 3, axis=0)
        estimate = scale_from_gps(*with_gps(walk, errors, truth))
        ratios.append(estimate.metres_per_unit / truth.scale)
        stated_error.append((estimate.standard_error or 0) / truth.scale)
    assert np.sqrt(np.mean(np.square(stated_error))) == pytest.approx(np.std(ratios), rel=0.25)


def test_gps_is_refused_up_to_a_spread_of_three_times_the_noise():
    """3 m in each coordinate are 5.2 m; a square of side a has a spread of a / sqrt(6), to which the noise adds."""
    for ratio in (2.0, 2.6, 3.5, 5.0):
        size = 3 * np.sqrt(3) * np.sqrt(6 / 1.02 * (ratio**2 - 1))
        for seed in range(5):
            frames, gps, _ = photographed(np.random.default_rng(seed), count=200, size=size, noise=3.0)
            if ratio > 3:
                assert scale_from_gps(frames, gps).metres_per_unit > 0
            else:
                with pytest.raises(UserError, match="GPS is too inaccurate for a scale"):
                    scale_from_gps(frames, gps)


def test_gps_of_photos_within_a_few_metres_is_refused_with_numbers():
    """A teapot from all sides; and pure noise, which a similarity fits to some degree, at every number of photos."""
    rng = np.random.default_rng(2)
    frames, gps, _ = photographed(rng, count=40, size=3.0, noise=3.0)
    with pytest.raises(UserError, match=r"spread over [\d.]+ m, and the GPS error is [\d.]+ m") as caught:
        scale_from_gps(frames, gps)
    assert "give a known distance instead" in caught.value.hint
    accepted = 0
    for trial in range(200):
        frames = frames_at(rng.normal(size=(6 + trial % 10, 3)))
        noise = {f.name: (48.0 + 3e-5 * rng.normal(), 11.0 + 4e-5 * rng.normal(), 3 * rng.normal()) for f in frames}
        try:
            scale_from_gps(frames, noise)
            accepted += 1
        except UserError:
            pass
    assert accepted <= 2


def test_centimetres_over_a_few_metres_are_accepted():
    """An RTK receiver gives the scale of a house: only the ratio of spread to noise counts."""
    frames, gps, truth = photographed(np.random.default_rng(3), count=30, size=4.0, noise=0.02)
    found = scale_from_gps(frames, gps)
    assert found.metres_per_unit == pytest.approx(truth.scale, rel=0.01)


def test_two_photos_far_apart_give_the_scale_and_three_on_a_line_too():
    for metres in ([[0, 0, 0], [400, 0, 0]], [[0, 0, 0], [200, 1, 0], [400, 0, 0]]):
        frames = frames_at(np.array(metres) / 7.0)
        gps = {
            frame.name: (0.0, float(np.degrees(m[0] / 6378137.0)), float(m[1]))
            for frame, m in zip(frames, metres, strict=True)
        }
        found = scale_from_gps(frames, gps)
        assert found.metres_per_unit == pytest.approx(7.0, rel=1e-4)
        # An error of 3 m at each position along the line.
        expected = 7.0 * 3.0 / np.sqrt(np.sum((np.array(metres) - np.mean(metres, axis=0)) ** 2))
        assert found.standard_error == pytest.approx(expected, rel=1e-3)


def test_what_gps_cannot_determine():
    frames = frames_at(np.arange(9.0).reshape(3, 3))
    with pytest.raises(UserError, match="only 1 of 3 photos"):
        scale_from_gps(frames, {"000.jpg": (1.0, 2.0, None)})
    same: dict[str, Position] = {frame.name: (1.0, 2.0, None) for frame in frames}
    with pytest.raises(UserError, match="GPS positions of all 3 photos are identical"):
        scale_from_gps(frames, same)
    apart: dict[str, Position] = {f.name: (i / 10, 2.0, None) for i, f in enumerate(frames)}
    with pytest.raises(UserError, match="cameras of all 3 photos are identical"):
        scale_from_gps(frames_at(np.zeros((3, 3))), apart)


# Markers


SUPERSAMPLED = 4


def photo_of(plane: np.ndarray, world_from_plane: np.ndarray, per_unit: float, frame: Frame) -> np.ndarray:
    """Return a pinhole camera's photo of a picture on a plane, by a homography, with grey around it.

    The plane's pixel (x, y), centres at 0.5, is at (x, y, 0) / per_unit in its frame.
    """
    fx, fy, cx, cy = (SUPERSAMPLED * value for value in frame.camera.params)
    cam_from_plane = rigid.inverse(frame.world_from_cam) @ world_from_plane
    scaled = cam_from_plane[:3, [0, 1, 3]] * [1 / per_unit, 1 / per_unit, 1]
    homography = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) @ scaled
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV counts pixel centres from 0
    size = (SUPERSAMPLED * frame.camera.width, SUPERSAMPLED * frame.camera.height)
    large = cv2.warpPerspective(
        plane, np.linalg.inv(half) @ homography @ half, size, flags=cv2.INTER_LINEAR, borderValue=128
    )
    grey = cv2.resize(large, (frame.camera.width, frame.camera.height), interpolation=cv2.INTER_AREA)
    return np.repeat(grey[..., None], 3, axis=2)


def photos_of(folder: Path, plane: np.ndarray, *, per_unit: float, count: int = 6) -> list[Frame]:
    """Photos of a plane from a ring above it, in a world that is turned and moved."""
    rng = np.random.default_rng(0)
    world_from_plane = rigid.from_parts(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([3.0, -2, 5]))
    middle = np.array([plane.shape[1], plane.shape[0], 0]) / 2 / per_unit
    size = float(np.linalg.norm(middle))
    frames = []
    for index in range(count):
        angle = 2 * np.pi * index / count + 0.2
        offset = size * np.array([1.6 * np.cos(angle), 1.6 * np.sin(angle), -3.2 + 0.3 * rng.normal()])
        pose = world_from_plane @ rigid.look_at(middle + offset, middle, np.array([0.3, -1, 0]))
        frame = Frame(f"{index}.png", Camera("PINHOLE", 640, 480, (700, 710, 330, 236)), pose)
        path = folder / frame.name
        write_png(path, photo_of(plane, world_from_plane, per_unit, frame))
        frames.append(Frame(frame.name, frame.camera, pose, image=path))
    return frames


def sheet_of_markers(numbers: list[int], side_px: int) -> np.ndarray:
    """Markers in a row on white, a side apart."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    sheet = np.full((3 * side_px, (2 * len(numbers) + 1) * side_px), 255, dtype=np.uint8)
    for place, number in enumerate(numbers):
        left = (2 * place + 1) * side_px
        sheet[side_px : 2 * side_px, left : left + side_px] = cv2.aruco.generateImageMarker(dictionary, number, side_px)
    return sheet


def test_scale_from_aruco_markers(tmp_path):
    """Markers of 0.05 m that are 0.7 units wide, 64 pixels in the photos; OpenCV's own corners are 0.4 % too near."""
    sheet = sheet_of_markers([3, 17], 120)
    frames = photos_of(tmp_path, sheet, per_unit=120 / 0.7)
    estimate = scale_from_markers(frames, 0.05, dictionary="DICT_4X4_50")
    truth = 0.05 / 0.7
    assert estimate.metres_per_unit == pytest.approx(truth, rel=1e-4)
    assert [name for name, _ in estimate.residuals] == ["marker 3", "marker 17"]
    assert estimate.rms_residual < 0.01
    assert estimate.source == "ArUco markers (DICT_4X4_50, 0.05 m), 8 sides"
    # A marker that appears twice is not used.
    frames = photos_of(tmp_path, sheet_of_markers([3, 17, 3], 100), per_unit=100 / 0.7)
    assert [name for name, _ in scale_from_markers(frames, 0.05, dictionary="DICT_4X4_50").residuals] == ["marker 17"]


@pytest.mark.parametrize(("rows", "legacy"), [(5, False), (4, False), (4, True)])
def test_scale_from_a_charuco_board(rows, legacy, tmp_path):
    """With an even number of rows, boards of OpenCV before 4.6 begin with a white square."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    printed = cv2.aruco.CharucoBoard((6, rows), 0.03, 0.022, dictionary)
    printed.setLegacyPattern(legacy)
    picture = printed.generateImage((600, 100 * rows), marginSize=0)
    assert (picture[5, 5] == 255) == legacy
    board = CharucoBoard(6, rows, 0.03, 0.022, "DICT_5X5_100", legacy=legacy)
    on_paper = cv2.copyMakeBorder(picture, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    frames = photos_of(tmp_path, on_paper, per_unit=50)
    estimate = scale_from_charuco(frames, board)
    truth = 0.03 / 2  # squares of 100 pixels at 50 per unit
    assert estimate.metres_per_unit == pytest.approx(truth, rel=0.002)
    assert len(estimate.residuals) == 4 * (rows - 1) + 5 * (rows - 2)
    assert estimate.rms_residual < 0.5


@given(seed=seeds, blur=st.floats(0.6, 1.5), turn=st.floats(0, 6.3))
@few
def test_corners_of_a_blurred_square_are_where_its_edges_meet(seed, blur, turn):
    """Closed form: a blurred square is a product of normal distribution functions. Noise of 2 of 255 levels."""
    rng = np.random.default_rng(seed)
    half, axes = 20.0, np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    truth = 60.0 + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ axes
    across = (np.stack(np.meshgrid(np.arange(120), np.arange(120)), axis=-1) - 60.0) @ axes.T
    inside = (norm.cdf((half - across) / blur) - norm.cdf((-half - across) / blur)).prod(axis=-1)
    grey = np.rint(230 - 200 * inside).astype(np.uint8)
    noisy = np.rint(230 - 200 * inside + 2 * rng.normal(size=inside.shape)).clip(0, 255).astype(np.uint8)
    found = refine_corners(noisy, truth + rng.uniform(-1, 1, (4, 2)))
    assert found is not None
    np.testing.assert_allclose(found, truth, rtol=0, atol=0.1)
    clean = refine_corners(grey, truth + rng.uniform(-1, 1, (4, 2)))
    assert clean is not None
    np.testing.assert_allclose(clean, truth, rtol=0, atol=0.05)
    assert refine_corners(np.full_like(grey, 128), truth) is None
    assert refine_corners(grey, np.full((4, 2), 60.0)) is None


def test_markers_that_give_no_scale_are_reported(tmp_path):
    sheet = sheet_of_markers([3], 120)
    frames = photos_of(tmp_path, sheet, per_unit=120.0, count=2)
    what = r"no scale from the .* in 1 photo: 4 of 4 corners .* visible in only one photo"
    with pytest.raises(UserError, match=what):
        scale_from_markers(frames[:1], 0.05, dictionary="DICT_4X4_50")
    again = Frame("again.png", frames[0].camera, frames[0].world_from_cam, image=frames[0].image)
    with pytest.raises(UserError, match="visible only from nearly the same direction"):
        scale_from_markers([frames[0], again], 0.05, dictionary="DICT_4X4_50")
    with pytest.raises(UserError, match=r"no photo shows the ArUco markers \(DICT_6X6_50"):
        scale_from_markers(frames, 0.05, dictionary="DICT_6X6_50")
    with pytest.raises(UserError, match="no photo shows the ChArUco board"):
        scale_from_charuco(frames, CharucoBoard(5, 4, 0.03, 0.02, "DICT_6X6_50"))
    with pytest.raises(UserError, match="unknown dictionary of markers 'ARUCO'"):
        scale_from_markers(frames, 0.05, dictionary="ARUCO")
    with pytest.raises(UserError, match="side length of markers: 0 m"):
        scale_from_markers(frames, 0.0, dictionary="DICT_4X4_50")
    with pytest.raises(UserError, match="DICT_4X4_50 has only 50 markers"):
        scale_from_charuco(frames, CharucoBoard(20, 20, 0.03, 0.02, "DICT_4X4_50"))
    with pytest.raises(UserError, match=r"squares of 0\.02 m and markers of 0\.03 m"):
        CharucoBoard(5, 4, 0.02, 0.03, "DICT_4X4_50")
    with pytest.raises(UserError, match="1x4 squares"):
        CharucoBoard(1, 4, 0.03, 0.02, "DICT_4X4_50")


@given(seed=seeds, wrong=st.booleans())
@few
def test_a_point_from_rays_is_exact_and_one_wrong_ray_moves_it_little(seed, wrong):
    rng = np.random.default_rng(seed)
    point, c = rng.normal(size=3), 5 * rng.normal(size=(8, 3))
    d = point - c
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    if wrong:
        d[0] = Rotation.from_rotvec(0.05 * rng.normal(size=3)).apply(d[0])
    found, missed = nearest_in_pixels(c, d, np.full(8, 500.0))
    np.testing.assert_allclose(found, point, rtol=0, atol=0.02 if wrong else 1e-9)
    assert missed.shape == (8,)


def test_corners_through_distorted_lenses_and_how_well_their_error_is_estimated():
    """Corners seen through a fisheye and a distorted lens, exact without noise; right standard error with 0.2 px."""
    rng = np.random.default_rng(0)
    lenses = [
        Camera("OPENCV_FISHEYE", 640, 480, (300, 305, 322, 239, 0.05, -0.01, 0, 0)),
        Camera("OPENCV", 640, 480, (500, 505, 318, 243, -0.2, 0.05, 0.001, -0.002)),
    ]
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) - [0.5, 0.5, 0]
    angles = np.linspace(0, 5, 8)
    places = 4 * np.stack([np.cos(angles), np.sin(angles), np.full(8, 1.5)], axis=1)
    poses = [rigid.look_at(place, np.zeros(3), np.ones(3)) for place in places]
    frames = [Frame(f"{i}.png", lenses[i % 2], pose) for i, pose in enumerate(poses)]
    offsets = 1.2 * np.array([[0.0, 0, 0], [1, 0, 0.2], [-1, 0, 0.1]])
    sides = [Side(f"marker {m}", (m, k), (m, (k + 1) % 4), 0.1) for m in range(len(offsets)) for k in range(4)]

    corners = {(m, k): square[k] + offset for m, offset in enumerate(offsets) for k in range(4)}
    seen = [f.camera.project(f.in_camera(np.array(list(corners.values()))))[0] for f in frames]

    def estimate(noise: float) -> ScaleEstimate:
        sightings = {
            corner: [(i, pixels[number] + e) for (i, pixels), e in zip(enumerate(seen), errors, strict=True)]
            for number, corner in enumerate(corners)
            for errors in [noise * rng.normal(size=(len(frames), 2))]
        }
        return scale_from_corners(frames, sightings, sides, pattern="markers")

    assert estimate(0.0).metres_per_unit == pytest.approx(0.1, rel=1e-9)
    found = [estimate(0.2) for _ in range(30)]
    scatter = np.std([one.metres_per_unit for one in found])
    stated_error = np.sqrt(np.mean([(one.standard_error or 0) ** 2 for one in found]))
    assert 0.6 < stated_error / scatter < 1.7


def test_positions_in_exif_give_the_scale(tmp_path):
    """Photos 11 m apart in a square at 48 degrees north, with positions to a hundredth of a second of arc."""
    frames = []
    for i, (east, north) in enumerate([(0, 0), (11, 0), (22, 0), (0, 11), (11, 11), (22, 11), (0, 22), (22, 22)]):
        exif = Image.Exif()
        # With the metres of a degree there.
        latitude, longitude = (48, 0, 3600 * north / 111194.0), (11, 0, 3600 * east / 74629.0)
        exif[ExifTags.IFD.GPSInfo] = {1: "N", 2: latitude, 3: "E", 4: longitude, 5: b"\0", 6: 500.0}
        path = tmp_path / f"{i}.jpg"
        Image.new("RGB", (64, 48)).save(path, exif=exif)
        pose = rigid.from_parts(np.diag([1.0, -1, -1]), np.array([north, -east, 3.0]) / 10)
        frames.append(Frame(path.name, Camera.pinhole(64, 48, 50.0), pose, image=path))
    Image.new("RGB", (64, 48)).save(tmp_path / "without.jpg")  # it has no position; and one photo is missing
    frames += [replace(frames[0], name=name, image=None) for name in ("without.jpg", "missing.jpg")]
    write_colmap_binary(Capture(tuple(frames), np.zeros((0, 3)), (), None, "made"), tmp_path / "in")
    done = completed("convert", tmp_path / "in", tmp_path / "out", "--to", "nerfcli", "--scale", "gps", "--json")
    assert json.loads(done.stdout)["scale"]["metres_per_unit"] == pytest.approx(10.0, rel=2e-3)
    written = load_scene(tmp_path / "out")
    assert written.unit == "metre"
    assert (written.unit_source or "").startswith("GPS of 8 photos (EXIF)")
    assert np.linalg.norm(written.frames[7].centre - written.frames[0].centre) == pytest.approx(22 * 2**0.5, rel=2e-3)
