"""The doctor's findings on captures with known faults: each is found and named; a clean capture gets no alarm.

The photos are drawn by `walks`: boards with known textures at known distances, seen by a camera on a known path.
"""

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from present import present
from walks import BOARDS, FOCAL_PX, HEIGHT, WIDTH, view, walk, write

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.calibration import Calibration
from nerfcli.captures.capture import Capture
from nerfcli.doctor import camera_layout, inventory, quality
from nerfcli.doctor.compared_pairs import Pair, choose_pairs, estimate_motion, pair_count
from nerfcli.doctor.examination import (
    Diagnosis,
    ExaminedCapture,
    compare_all,
    content,
    estimated_seconds,
    examine,
    find_subject,
    judged,
)
from nerfcli.doctor.page import page_html
from nerfcli.doctor.photo_facts import PhotoFacts, Source, measure_sharpness, read_photo
from nerfcli.errors import UserError
from nerfcli.matching.features import LOOSE_RATIO, mutual_matches
from nerfcli.matching.graph import potentials
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding
from nerfcli.photos.exif import Exif

ONE = 3  # the number of the photo that is spoilt
FEATURES = 500


@dataclass(frozen=True)
class Examination:
    """A capture that was read and compared, so that one photo can be spoilt without repeating this for the others."""

    folder: Path
    photos: tuple[np.ndarray, ...]
    facts: tuple[PhotoFacts, ...]
    pairs: tuple[Pair, ...]

    def diagnosis(self) -> Diagnosis:
        sources = tuple(Source(fact.name, self.folder / fact.name) for fact in self.facts)
        subject = ExaminedCapture(self.folder, sources, None)
        return judged(subject, list(self.facts), list(self.pairs), unreadable={})

    def spoilt(self, photo: np.ndarray, tmp_path: Path) -> Diagnosis:
        """Return the findings with another photo in place of `ONE`."""
        path = tmp_path / self.facts[ONE].name
        Image.fromarray(photo).save(path, quality=93)
        facts = list(self.facts)
        facts[ONE] = read_photo(Source(path.name, path), FEATURES)
        pairs = {(pair.first, pair.second): pair for pair in self.pairs}
        again = [place for place in pairs if ONE in place]
        for pair in compare_all(facts, again, [FOCAL_PX] * len(facts), threads=2, progress=lambda done: None):
            pairs[pair.first, pair.second] = pair
        return replace(self, facts=tuple(facts), pairs=tuple(pairs.values())).diagnosis()


def examined(folder: Path, photos: list[np.ndarray]) -> Examination:
    write(folder, photos)
    facts = [read_photo(Source(path.name, path), FEATURES) for path in sorted(folder.iterdir())]
    places = choose_pairs(facts)
    pairs = compare_all(facts, places, [FOCAL_PX] * len(facts), threads=2, progress=lambda done: None)
    return Examination(folder, tuple(photos), tuple(facts), tuple(pairs))


def examination_of(folder: Path, *, threads: int = 2, calibration: Calibration | None = None) -> Diagnosis:
    subject = find_subject(folder)
    return examine(subject, threads=threads, progress=lambda *reported: None, calibration=calibration)


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Examination:
    return examined(tmp_path_factory.mktemp("doctor") / "clean", walk())


@pytest.fixture(scope="module")
def exif(clean: Examination) -> Exif:
    """What a camera with a known lens states about the photos."""
    return replace(clean.facts[0].exif, make="Maker", model="One", focal_mm=4.0, focal_35mm=28.0)


def finding(diagnosis: Diagnosis, check: str) -> Finding:
    return next(found for found in diagnosis.findings if found.check == check)


def alarms(diagnosis: Diagnosis) -> dict[str, tuple[str, ...]]:
    """Return photo names by checks that are not good, but for count and size: captures here are small on purpose."""
    found = {f.check: f.names for f in diagnosis.findings if f.verdict != GOOD}
    return {check: names for check, names in found.items() if check not in ("count", "size")}


# One fault at a time


def test_a_clean_capture_gets_no_alarm(clean):
    diagnosis = clean.diagnosis()
    assert alarms(diagnosis) == {}
    # The camera stepped aside by 0.9 to either side, at distances of 2.6 to 6.
    assert 0.15 < (finding(diagnosis, "movement").number or 0) < 0.7


def test_a_photo_out_of_focus_is_named(clean, tmp_path):
    diagnosis = clean.spoilt(cv2.GaussianBlur(clean.photos[ONE], (0, 0), 1.5), tmp_path)
    assert alarms(diagnosis) == {"sharpness": ("03.jpg",)}
    assert "smeared" not in finding(diagnosis, "sharpness").photos[0][1]


def test_a_motion_blurred_photo_is_named_and_distinguished_from_one_out_of_focus(clean, tmp_path):
    smear = np.zeros((9, 9), np.float32)
    smear[4] = 1 / 9
    found = finding(clean.spoilt(cv2.filter2D(clean.photos[ONE], -1, smear), tmp_path), "sharpness")
    assert found.names == ("03.jpg",)
    assert "smeared" in found.photos[0][1]


@pytest.mark.parametrize("stops", [-2.0, 1.2])
def test_the_stops_of_a_photo_that_is_lighter_or_darker_are_measured(clean, stops, tmp_path):
    linear = (clean.photos[ONE] / 255) ** 2.2 * 2**stops
    photo = np.rint(255 * linear.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    diagnosis = clean.spoilt(photo, tmp_path)
    assert finding(diagnosis, "exposure").names == ("03.jpg",)
    np.testing.assert_allclose(diagnosis.exposure_stops[ONE], stops, atol=0.15)  # gamma 2.2 is not quite sRGB's
    assert finding(diagnosis, "white balance").verdict == GOOD


def test_another_white_balance_is_named_and_is_no_exposure(clean, tmp_path):
    photo = (clean.photos[ONE] * (1.15, 1.0, 0.85)).clip(0, 255).astype(np.uint8)
    diagnosis = clean.spoilt(photo, tmp_path)
    assert list(alarms(diagnosis)) == ["white balance"]
    assert finding(diagnosis, "white balance").names == ("03.jpg",)


def test_a_photo_of_nothing_is_no_blurred_photo(clean, tmp_path):
    found = alarms(clean.spoilt(np.full_like(clean.photos[ONE], 140), tmp_path))
    assert found == {"texture": ("03.jpg",), "connectivity": ("03.jpg",)}


def test_a_photo_of_another_place_hangs_on_nothing(clean, tmp_path):
    diagnosis = clean.spoilt(view(seed=50), tmp_path)
    assert alarms(diagnosis) == {"connectivity": ("03.jpg",)}
    np.testing.assert_allclose(finding(diagnosis, "connectivity").number or 0, 6 / 7)


def test_doubles_are_named_whether_the_file_is_the_same_or_not(clean, tmp_path):
    again = clean.spoilt(clean.photos[ONE + 1], tmp_path)
    assert finding(again, "duplicates").photos == (("04.jpg", "same file as 03.jpg"),)
    lighter = clean.spoilt((clean.photos[ONE + 1] * 0.97).astype(np.uint8), tmp_path)
    assert finding(lighter, "duplicates").photos == (("04.jpg", "same picture as 03.jpg"),)


def test_mixed_lenses_and_zooms_are_reported_but_not_a_phone_on_its_side(clean, exif):

    def cameras(*odd: Exif) -> Finding:
        return inventory.cameras([replace(f, exif=e) for f, e in zip(clean.facts, [*odd, *[exif] * 6], strict=True)])

    assert cameras(exif).verdict == GOOD
    assert cameras(replace(exif, focal_mm=4.05)).verdict == GOOD  # autofocus
    assert cameras(replace(exif, width=exif.height, height=exif.width)).verdict == GOOD
    for odd in ({"focal_35mm": 56.0}, {"model": "Two"}, {"lens": "Wide"}, {"focal_mm": 6.0}, {"width": 300}):
        found = cameras(replace(exif, **odd))
        assert (found.verdict, found.names) == (LOOK, ("00.jpg",)), odd


def test_only_photos_with_an_orientation_in_exif_are_said_to_be_turned(clean):
    landscape = clean.facts[0].exif
    portrait = replace(landscape, width=landscape.height, height=landscape.width)

    def orientation(exif: Exif) -> Finding:
        return inventory.orientation([replace(clean.facts[0], exif=exif), *clean.facts[1:]])

    assert orientation(landscape).advice == ""
    stored, tagged = orientation(portrait), orientation(replace(portrait, orientation=6))
    assert (stored.verdict, stored.names, tagged.verdict) == (LOOK, ("00.jpg",), LOOK)
    assert stored.advice == "nothing to do: the two get separate cameras"
    assert tagged.advice == "nothing to do: nerfcli turns photos upright; other programs may ignore the tag"


def test_each_folder_has_a_camera_of_its_own(clean, exif):
    other = replace(exif, model="Two")

    def cameras(*exifs: Exif) -> Finding:
        names = ("left/0.jpg", "left/1.jpg", "left/2.jpg", "right/0.jpg", "right/1.jpg", "right/2.jpg")
        return inventory.cameras([replace(clean.facts[0], name=n, exif=e) for n, e in zip(names, exifs, strict=True)])

    found = cameras(exif, exif, exif, other, other, other)
    assert (found.verdict, found.number, found.names) == (GOOD, 1, ())
    assert found.summary.startswith("one camera in each of 2 folders: Maker One, 4 mm")
    assert "; Maker Two, 4 mm" in found.summary
    found = cameras(exif, exif, exif, other, exif, other)
    assert (found.verdict, found.number, found.names) == (LOOK, 2, ("right/1.jpg",))
    assert found.summary.startswith("up to 2 different combinations of camera, lens, zoom and image size in each of 2")


def test_exif_of_another_picture_is_named(clean, exif):
    """EXIF records 4032x2268, another shape than the file's; 4032x3024 has the same shape: only downscaled."""
    resized = replace(exif, taken_px=(4032, 3024))
    cropped = replace(exif, taken_px=(4032, 2268))

    def focal_length(*exifs: Exif) -> Finding:
        return inventory.focal_length([replace(f, exif=e) for f, e in zip(clean.facts, exifs, strict=False)])

    assert focal_length(exif, resized).verdict == GOOD
    assert focal_length(exif, resized).summary == "0.81 times the longer side, from EXIF (2 photos)"
    assert focal_length(replace(exif, focal_35mm=None)).summary.startswith("in EXIF in millimetres, without the size")
    assert focal_length(replace(exif, focal_mm=None, focal_35mm=None)).summary.startswith("not in EXIF")
    found = focal_length(resized, cropped)
    assert (found.verdict, found.names) == (LOOK, ("01.jpg",))
    assert "EXIF is for 4032x2268 pixels" in found.summary
    assert "give --intrinsics" in found.advice


# Whole captures


def test_a_camera_that_only_turns_is_distinguished_from_one_that_moves(tmp_path):
    turning = examined(tmp_path / "turning", [view(pan_deg=angle) for angle in np.linspace(-15, 15, 5)]).diagnosis()
    assert list(alarms(turning)) == ["movement"]
    found = finding(turning, "movement")
    assert (found.verdict, len(found.names)) == (BAD, 5)
    assert (found.number or 0) < 0.03


def test_two_halves_without_common_places_are_reported_separately(clean, tmp_path):
    halves = examined(tmp_path / "halves", [*clean.photos[:3], *walk(3, seed=50)]).diagnosis()
    assert list(alarms(halves)) == ["connectivity"]
    found = finding(halves, "connectivity")
    assert (found.verdict, found.names) == (BAD, ("03.jpg", "04.jpg", "05.jpg"))


def test_something_that_moves_by_itself_is_found_where_it_is(tmp_path):
    def with_mover(step: float) -> np.ndarray:
        mover = (0.2 + 0.5 * step, 0.25 + 0.5 * np.cos(4 * step), 2.5, 0.9)
        return view((0.9 * step, 0.1 * step**2, 0.0), pan_deg=-6 * step, boards=(*BOARDS, mover))

    diagnosis = examined(tmp_path / "moving", [with_mover(step) for step in np.linspace(-1, 1, 5)]).diagnosis()
    assert list(alarms(diagnosis)) == ["moving content"]
    found = finding(diagnosis, "moving content")
    middle = dict(found.photos)["02.jpg"]  # there the mover is at x 0.2, y 0.75, distance 2.5
    across, down = (int(word) for word in middle.replace(",", "").split() if word.isdigit())
    assert abs(across - 100 * (0.5 + 0.2 / 2.5 * FOCAL_PX / WIDTH)) < 6
    assert abs(down - 100 * (0.5 + 0.75 / 2.5 * FOCAL_PX / HEIGHT)) < 8


def test_a_flat_world_is_distinguished_from_a_camera_that_only_turns(tmp_path):
    places = [((0.9 * s, 0.4 * s * s, 0.5 * s), -14 * s) for s in np.linspace(-1.5, 1.5, 4)]
    flat = examined(tmp_path / "flat", [view(c, pan_deg=a, boards=BOARDS[:1]) for c, a in places]).diagnosis()
    assert list(alarms(flat)) == ["depth relief"]


def test_given_intrinsics_determine_how_far_things_are(tmp_path):
    """The camera moves by 0.5 in front of boards at 2.6 to 6; twice the stated focal length doubles all distances."""
    folder = write(tmp_path / "photos", [view((step, 0, 0)) for step in (0.0, 0.5)])

    def baseline_over_depth(focal_px: float) -> float:
        calibrated = Calibration(Path("c"), (Camera.pinhole(2 * WIDTH, 2 * HEIGHT, 2 * focal_px),), {})
        (pair,) = examination_of(folder, threads=1, calibration=calibrated).pairs
        return present(pair.views).baseline_over_depth

    right = baseline_over_depth(FOCAL_PX)
    assert 0.5 / 6 < right < 0.5 / 2.6
    np.testing.assert_allclose(baseline_over_depth(2 * FOCAL_PX), right / 2, rtol=0.05)


# Parts


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_detail_falls_with_blur_and_not_with_content_or_contrast(seed):
    photo = cv2.cvtColor(view(seed=seed), cv2.COLOR_RGB2GRAY).astype(np.float32)
    blurred = [photo, *(cv2.GaussianBlur(photo, (0, 0), sigma) for sigma in (0.5, 1, 1.5, 2, 3))]
    details = np.array([measure_sharpness(picture)[0].detail for picture in blurred])
    assert (np.diff(details) < -0.05).all()
    assert abs(measure_sharpness(128 + 0.5 * (photo - 128))[0].detail - details[0]) < 0.05
    assert abs(measure_sharpness(np.ascontiguousarray(photo[:, ::-1].T))[0].detail - details[0]) < 0.02


@cache
def two_view_points() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 2, 300), rng.uniform(-1.5, 1.5, 300), rng.uniform(4, 8, 300)])
    return points, rng.normal(scale=0.3, size=(2, 300, 2))


def seen(points: np.ndarray, turn_deg: float, centre: tuple[float, float, float]) -> np.ndarray:
    rotation = cv2.Rodrigues(np.radians([0.3, 1.0, 0.1]) * turn_deg)[0]
    local = (points - centre) @ rotation.T
    return 700 * local[:, :2] / local[:, 2:]


@pytest.mark.parametrize(
    ("turn_deg", "baseline", "focal_px"),
    [(12, 0.0, 700.0), (12, 0.0, 500.0), (5, 0.3, 700.0), (5, 0.6, 700.0), (5, 1.2, 700.0)],
)
def test_the_baseline_over_the_depth_is_measured_and_a_pure_rotation_recognized(turn_deg, baseline, focal_px):
    """The true focal length is 700 px; a pure rotation is recognized at any."""
    points, noise = two_view_points()
    x, y = seen(points, 0, (0, 0, 0)) + noise[0], seen(points, turn_deg, (baseline, 0, 0)) + noise[1]
    views = present(estimate_motion(x, y, (focal_px, focal_px), within_px=2.0))
    assert views.flat == (baseline == 0)
    over_depth = baseline / np.median(points[:, 2])
    assert views.baseline_over_depth == pytest.approx(over_depth, rel=0.1, abs=0.02 * views.flat)


def test_a_plane_gives_no_more_than_its_baseline_over_its_distance():
    """The ratio is 0.2; if the focal length may be 1.45 times the given one, 0.2 / 1.45 explains the same pixels."""
    points, _ = two_view_points()
    flat = np.column_stack([points[:, :2], np.full(len(points), 5.0)])
    x, y = seen(flat, 0, (0, 0, 0)), seen(flat, 0, (1.0, 0, 0))
    views = present(estimate_motion(x, y, (700.0, 700.0), within_px=2.0))
    assert views.flat
    assert 0.2 / 1.46 < views.baseline_over_depth < 0.201


def test_matches_are_those_of_a_double_loop():
    rng = np.random.default_rng(0)
    one = rng.integers(0, 150, (40, 128)).astype(np.uint8)
    other = np.concatenate([one[:20] + rng.integers(0, 40, (20, 128)).astype(np.uint8), one[30:] // 2])
    distances = np.array([[np.linalg.norm(a.astype(float) - b) for b in other] for a in one])
    expected = []
    for i, row in enumerate(distances):
        j = int(row.argmin())
        if distances[:, j].argmin() == i and row[j] < 0.8 * np.delete(row, j).min():
            expected.append((i, j))
    assert [(int(i), int(j)) for i, j in zip(*mutual_matches(one, other, ratio=LOOSE_RATIO), strict=True)] == expected
    assert len(expected) > 15


def test_heights_come_back_from_differences_of_which_some_are_wrong():
    rng = np.random.default_rng(0)
    truth = rng.normal(size=12)
    pairs = [(i, j) for i in range(11) for j in range(i + 1, 11)]  # the last one has no pair
    differences = np.array([truth[j] - truth[i] for i, j in pairs])
    differences[::9] += 5
    differences[4] = np.nan
    values, backing = potentials(12, pairs, differences, trust=np.ones(len(pairs)), usual_error=0.1)
    np.testing.assert_allclose(values[:11], truth[:11] - np.median(truth[:11]), atol=0.1)  # squares below 0.1
    assert np.isnan(values[11])
    assert backing[11] == 0


def test_large_captures_are_not_compared_exhaustively(clean):
    few = replace(clean.facts[0].features, descriptors=clean.facts[0].features.descriptors[:20], scales=np.ones(20))
    photos = [replace(clean.facts[0], features=few)] * 70
    pairs = choose_pairs(photos)
    assert len(pairs) <= pair_count(70) < 1000
    assert {(i, i + 1) for i in range(69)} <= set(pairs)
    # Linear in the number of photos from here on, so that the time for a thousand can be stated before the start.
    np.testing.assert_allclose(estimated_seconds(1000, 2), 4 * estimated_seconds(250, 2))


# Scenes


def test_focal_lengths_of_a_scene_are_those_of_its_cameras_and_their_pixels_are_square():
    scene = ring(8, span_deg=360)
    found = camera_layout.focal_lengths(scene)
    assert (found.verdict, found.summary) == (GOOD, "0.94 times the longer side, from the scene")
    narrow = Camera("PINHOLE", 640, 480, (600.0, 720.0, 320.0, 240.0))
    fisheye = Camera("OPENCV_FISHEYE", 640, 480, (600.0, 609.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))  # 1.5 % is usual
    first, second, *others = scene.frames
    frames = (replace(first, camera=narrow), replace(second, camera=fisheye), *others)
    found = camera_layout.focal_lengths(replace(scene, frames=frames))
    assert (found.verdict, found.photos) == (LOOK, (("0.jpg", "focal lengths along x and y differ by 20.0 %"),))


def ring(count: int, *, span_deg: float, radius: float = 3.0) -> Capture:
    camera = Camera.pinhole(640, 480, 600.0)
    up = np.array([0.0, 0.0, 1.0])
    angles = np.radians(np.linspace(0, span_deg, count, endpoint=False))
    centres = [np.array([radius * np.cos(a), radius * np.sin(a), 0.8]) for a in angles]
    frames = tuple(
        Frame(f"{i}.jpg", camera, rigid.look_at(centre, np.zeros(3), up), mask=Path("m.png") if i else None)
        for i, centre in enumerate(centres)
    )
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    return Capture(frames, points, ("gone.jpg",), kind="transforms")


@pytest.mark.parametrize(
    ("span_deg", "number_deg", "verdict"),
    [(360, 15, GOOD), (300, 72.5, LOOK), (240, 130, BAD), (10, 10 * 23 / 24, LOOK)],
)
def test_the_gap_in_a_ring_of_cameras_and_the_span_of_those_in_front_are_measured(span_deg, number_deg, verdict):
    found = camera_layout.directions(ring(24, span_deg=span_deg))
    assert (found.verdict, found.number) == (verdict, pytest.approx(number_deg, abs=0.6))


def test_cameras_at_one_place_and_one_far_off_are_reported():
    scene = ring(24, span_deg=360)
    assert camera_layout.spread(scene).verdict == GOOD
    near = tuple(replace(f, world_from_cam=scene.frames[0].world_from_cam) for f in scene.frames)
    assert camera_layout.spread(replace(scene, frames=near)).verdict == BAD
    pose = scene.frames[5].world_from_cam.copy()
    pose[:3, 3] *= 40
    off = (*scene.frames[:5], replace(scene.frames[5], world_from_cam=pose), *scene.frames[6:])
    assert camera_layout.spread(replace(scene, frames=off)).names == ("5.jpg",)


def test_the_depth_of_what_surrounds_a_panorama_is_its_distance():
    """Half of it is behind the camera: its median along the axis is near 0. Cameras 0.5 off the centre, walls at 4."""
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    walls = 4 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    camera = Camera("EQUIRECTANGULAR", 800, 400, (800.0, 400.0))
    poses = [rigid.from_parts(np.eye(3), 0.5 * direction) for direction in (*np.eye(3), *-np.eye(3))]
    frames = tuple(Frame(f"{index}.jpg", camera, pose) for index, pose in enumerate(poses))
    found = camera_layout.spread(Capture(frames, walls, kind="transforms"))
    assert (found.verdict, found.number) == (GOOD, pytest.approx(0.5 / 4, rel=0.02))


def test_weakly_determined_intrinsics_of_a_scene_are_named(tmp_path):
    """As reported by nerfcli poses: weak, firm, and reports without uncertainties."""
    scene = replace(ring(24, span_deg=360), root=tmp_path, kind="nerfcli")

    def found(*cameras: dict[str, object]) -> Finding | None:
        (tmp_path / "poses_report.json").write_text(json.dumps({"cameras": cameras}))
        return camera_layout.intrinsics(scene)

    firm = {"weak": False, "focal_percent": 0.2, "distortion_border_px": 0.5}
    weak = {"weak": True, "focal_percent": 4.0, "distortion_border_px": 3.0}
    assert camera_layout.intrinsics(scene) is None
    assert found({"model": "OPENCV"}, {"uncertainty": None}, {"uncertainty": {"weak": None}}) is None
    good, bad = map(present, (found({"uncertainty": firm}), found({"uncertainty": firm}, {"uncertainty": weak})))
    assert (good.verdict, good.number) == (GOOD, 0.2)
    assert good.threshold.endswith("look from 1 % of the focal length, or 0.3 % of half the image diagonal")
    assert (bad.verdict, bad.number) == (LOOK, 4.0)
    assert "weakly determined: focal length ± 4 %, distortion ± 3 px at the corners" in bad.summary
    assert "--intrinsics" in bad.advice
    undistorted = found({"uncertainty": firm | {"distortion_border_px": None}})
    assert present(undistorted).summary == "focal length ± 0.2 %"


def test_missing_photos_and_masks_that_only_some_have_are_named():
    found = {finding.check: finding for finding in camera_layout.check_scene_files(ring(24, span_deg=360))}
    assert found["missing photos"].names == ("gone.jpg",)
    assert found["masks"].names == ("0.jpg",)
    assert "no metric scale" in found["unit"].summary


# Files and the page


def test_damaged_files_are_named_and_the_rest_is_examined(clean, tmp_path):
    folder = write(tmp_path / "photos", list(clean.photos[:2]))
    (folder / "cut <b>.jpg").write_bytes((folder / "00.jpg").read_bytes()[:3000])
    (folder / "empty.png").touch()
    diagnosis = examination_of(folder)
    found = finding(diagnosis, "files")
    assert (found.verdict, found.names) == (BAD, ("cut <b>.jpg", "empty.png"))
    assert finding(diagnosis, "count").verdict == BAD
    assert "<b>.jpg" not in page_html(diagnosis)
    assert content(diagnosis)["verdict"] == BAD


def test_a_check_that_raises_is_listed_and_the_others_are_made(clean, tmp_path, monkeypatch: pytest.MonkeyPatch):
    folder = write(tmp_path / "photos", list(clean.photos[:2]))

    def singular(*arguments: object) -> None:
        raise np.linalg.LinAlgError("singular matrix")

    monkeypatch.setattr("nerfcli.doctor.geometry.movement", singular)
    monkeypatch.setattr("nerfcli.doctor.quality.stops", singular)
    diagnosis = examination_of(folder)
    why = "could not be computed: LinAlgError: singular matrix"
    assert dict(diagnosis.not_checked).items() >= {"movement": why, "stops": why}.items()
    assert finding(diagnosis, "count").verdict == BAD
    assert page_html(diagnosis).count("singular matrix") == 2
    photos = content(diagnosis)["photos"]
    assert isinstance(photos, list)
    assert [photo["stops"] for photo in photos] == [None] * 2


def test_nothing_readable_is_a_finding_too(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"no picture")
    diagnosis = examination_of(tmp_path, threads=1)
    assert [f.verdict for f in diagnosis.findings] == [BAD, BAD]
    assert "a.jpg" in page_html(diagnosis)


def test_a_video_is_sent_to_the_command_that_extracts_its_frames(tmp_path):
    video = tmp_path / "my walk.MP4"
    video.write_bytes(b"\0\0\0\x18ftypmp42")
    for subfolders in (False, True):
        with pytest.raises(
            UserError, match=r"my walk\.MP4 is a file, neither a folder of photos nor a scene"
        ) as caught:
            find_subject(video, subfolders=subfolders)
        assert f"nerfcli poses '{video}' writes its frames to a folder" in str(caught.value.hint)


def test_the_page_needs_nothing_else_and_shows_each_photo_once(clean):
    html = page_html(clean.diagnosis())
    assert html.count("data:image/jpeg") == len(clean.facts)
    assert not [word for word in ("http://", "https://", "<script", 'src="/') if word in html]
    assert str(clean.folder) not in html


def test_the_same_photos_give_the_same_findings(clean, tmp_path):
    folder = write(tmp_path / "again", list(clean.photos[:3]))
    one, other = (content(examination_of(folder, threads=threads)) for threads in (1, 3))
    assert one == other


def test_quality_thresholds_are_those_of_the_docstring():
    """Blurring a sharp photo by 0.8 px loses about 0.3 octaves of detail, by 1.5 px about 0.7."""
    photo = cv2.cvtColor(view(seed=3), cv2.COLOR_RGB2GRAY).astype(np.float32)
    sharp = measure_sharpness(photo)[0].detail
    lack = [sharp - measure_sharpness(cv2.GaussianBlur(photo, (0, 0), sigma))[0].detail for sigma in (0.8, 1.5)]
    np.testing.assert_allclose(lack, (quality.BLURRED, quality.VERY_BLURRED), rtol=0.35)
