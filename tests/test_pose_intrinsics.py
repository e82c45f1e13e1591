"""Intrinsics that are given: found in every kind of file, matched to photos, kept or refined; and what is refused.

The capture is the room corner of `corner`, whose cameras are known: 450 px at 480x360, no distortion.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from captures import CAMERAS, ring
from commands import error_of, nerfcli
from corner import CENTRES, FOCAL_PX, NAMES, write_capture
from in_this_process import worker_in_this_process
from PIL import Image
from test_cli import write_photos
from test_pose_stages import model, rows

from nerfcli.cameras.alignment import align
from nerfcli.cameras.camera import Camera
from nerfcli.captures.calibration import Calibration, calibrated, read_calibration
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.registry import format_named
from nerfcli.captures.orientation import Picture
from nerfcli.errors import BAD_INPUT, UserError
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.report import PosesReport
from nerfcli.poses.structure_from_motion import estimate_poses
from nerfcli.poses.workspace import is_same_scene

ONE_THREAD = PoseSettings(max_features=200, max_image_size=256, threads=1)
# The true camera at twice the size of the larger photos, in a model whose distortion terms are zero.
TRUE = Camera("OPENCV", 960, 720, (2 * FOCAL_PX, 2 * FOCAL_PX, 480, 360, 0, 0, 0, 0))


def estimate(photos: Path, scene: Path, **options: Any) -> PosesReport:
    with worker_in_this_process():
        return estimate_poses(photos, scene, settings=ONE_THREAD, **options)


def worst_centre(scene: Path) -> float:
    """How far a camera is from the truth, after the best similarity; the corner is 4 units away."""
    found = pycolmap.Reconstruction(str(scene / "sparse/0"))
    centres = np.array([found.find_image_with_name(name).projection_center() for name in NAMES])
    return float(np.linalg.norm(align(centres, CENTRES).apply(centres) - CENTRES, axis=1).max())


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_capture(tmp_path_factory.mktemp("capture") / "my photos")
    (folder / "wall.png").unlink()
    return folder


@pytest.fixture(scope="module")
def unaided(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene of a call without intrinsics."""
    scene = tmp_path_factory.mktemp("unaided") / "scene"
    estimate(photos, scene)
    return scene


def test_fixed_intrinsics_stay_to_the_bit_and_only_mapping_is_done_again(photos: Path, unaided: Path, tmp_path: Path):
    """Synthetic truth, rescaled exactly to each photo size; the poses are better than without given intrinsics."""
    scene, notes = shutil.copytree(unaided, tmp_path / "scene"), []
    given = Calibration(tmp_path / "cameras.txt", (TRUE,), {})
    assert not is_same_scene(scene, photos, ONE_THREAD, given=given)
    report = estimate(photos, scene, given=given, notify=notes.append)
    for table, key in (("descriptors", "image_id"), ("matches", "pair_id")):
        assert rows(scene, table, key) == rows(unaided, table, key)
    assert model(scene) != model(unaided)
    found = {(camera["width"], camera["height"]): camera for camera in report.cameras}
    for (width, height), factor in {(480, 360): 1.0, (384, 288): 0.8}.items():
        assert found[width, height]["params"] == [factor * v for v in (450, 450, 240, 180, 0, 0, 0, 0)]
        assert not found[width, height]["focal_from_exif"]
    assert worst_centre(scene) < worst_centre(unaided)
    assert "1 camera for 7 photos, 7 by size" in notes[0]
    assert "5 photos are 480x360, but the intrinsics are for 960x720: rescaled" in notes
    assert "2 photos are 384x288, but the intrinsics are for 960x720: rescaled" in notes
    assert report.intrinsics is not None
    assert [one["photos"] for one in report.intrinsics["cameras"]] == [5, 2]
    made = json.loads((scene / "scene.json").read_text())["provenance"]["intrinsics"]
    assert made == {"file": str(tmp_path / "cameras.txt"), "key": given.key}
    assert is_same_scene(scene, photos, ONE_THREAD, given=given)
    assert not is_same_scene(scene, photos, ONE_THREAD)


def capture_named(photos: Path) -> Capture:
    """Return a ring of frames with the names and files of the photos, from two alternating cameras."""
    cameras = CAMERAS["OPENCV"], Camera("OPENCV", 320, 240, (300, 301, 161, 119, 0.05, -0.02, 0.001, 0.002))
    capture = ring(*cameras, num_frames=4)
    named = (replace(f, name=f"{i}.jpg", image=photos / f"{i}.jpg") for i, f in enumerate(capture.frames))
    return replace(capture, frames=tuple(named), missing=())


@pytest.mark.parametrize("form", ["nerfcli", "colmap", "colmap-text", "transforms"])
def test_every_kind_of_file_gives_the_cameras_by_name(tmp_path: Path, form: str):
    """Round trip; the formats that hold a camera per frame."""
    photos = tmp_path / "images"
    photos.mkdir()
    capture = capture_named(photos)
    for frame in capture.frames:
        Image.new("RGB", (frame.camera.width, frame.camera.height)).save(photos / frame.name)
    target = format_named(form)
    assert target.write is not None
    path = tmp_path / "out" / target.default_name
    path.parent.mkdir(exist_ok=True)
    target.write(capture, path)
    calibration = read_calibration(path, images=photos)
    assert len(calibration.cameras) == 2
    pictures = [Picture(photos / f.name, f.camera.width, f.camera.height, 1) for f in capture.frames]
    found = calibrated(calibration, pictures)
    assert all(one.by_name for one in found)
    for one, frame in zip(found, capture.frames, strict=True):
        assert one.camera.model == frame.camera.model
        assert one.camera.params == pytest.approx(frame.camera.params, rel=1e-12)


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
@pytest.mark.parametrize("with_images", [True, False])
def test_the_cameras_of_colmap_may_stand_alone(tmp_path: Path, suffix: str, with_images: bool):
    form = format_named("colmap" if suffix == ".bin" else "colmap-text")
    assert form.write is not None
    form.write(capture_named(tmp_path), tmp_path / "model")
    alone = tmp_path / "alone"
    alone.mkdir()
    for name in ("cameras", "images") if with_images else ("cameras",):
        shutil.copy(tmp_path / "model" / f"{name}{suffix}", alone)
    for path in (alone, alone / f"cameras{suffix}"):
        calibration = read_calibration(path)
        assert len(calibration.cameras) == 2
        assert len(calibration.of_image) == (4 if with_images else 0)


def photo(width: int, height: int, orientation: int = 1, name: str = "photo.jpg") -> Picture:
    return Picture(Path(name), width, height, orientation)


def only(calibration: Calibration, picture: Picture) -> Camera:
    (found,) = calibrated(calibration, [picture])
    return found.camera


def test_a_lying_photo_turns_its_camera():
    """Closed form: a quarter turn clockwise takes (x, y) of a 360x480 picture to (480 - y, x)."""
    stored = Calibration(Path("c"), (Camera("PINHOLE", 360, 480, (450, 460, 170, 250)),), {})
    assert only(stored, photo(480, 360, 6)) == Camera("PINHOLE", 480, 360, (460, 450, 230, 170))
    upright = Calibration(Path("c"), (Camera("PINHOLE", 480, 360, (460, 450, 230, 170)),), {}, upright=True)
    assert only(upright, photo(480, 360, 6)) == upright.cameras[0]
    half = only(stored, photo(240, 180, 6))
    assert half == Camera("PINHOLE", 240, 180, (230, 225, 115, 85))


def test_a_photo_gets_the_camera_of_its_size_before_one_of_its_shape():
    small, large = Camera.pinhole(320, 240, 300), Camera.pinhole(640, 480, 500)
    both = Calibration(Path("c"), (small, large), {})
    assert only(both, photo(640, 480)) == large
    named = Calibration(Path("c"), (small, large), {"folder/photo.jpg": 0})
    assert only(named, photo(640, 480)) == Camera.pinhole(640, 480, 600)


def test_what_matches_no_photo_is_reported():
    small, large = Camera.pinhole(320, 240, 300), Camera.pinhole(640, 480, 500)
    with pytest.raises(UserError, match=r"c has no camera for photo photo\.jpg of 640x360: .* for 320x240, 640x480$"):
        only(Calibration(Path("c"), (small, large), {}), photo(640, 360))
    with pytest.raises(
        UserError, match=r"c does not list photo photo\.jpg of 1280x960, and 2 of its cameras have that size"
    ):
        only(Calibration(Path("c"), (small, large), {}), photo(1280, 960))
    with pytest.raises(UserError, match=r"c lists 2 images called photo\.jpg, with different cameras"):
        only(Calibration(Path("c"), (small, large), {"a/photo.jpg": 0, "b/photo.jpg": 1}), photo(640, 480))
    with pytest.raises(UserError, match=r"photo\.jpg: a picture of 640x360 pixels does not match a camera of 640x480"):
        only(Calibration(Path("c"), (large,), {"photo.jpg": 0}), photo(640, 360))
    with pytest.raises(UserError, match="EXIF orientation 2 mirrors the photo"):
        only(Calibration(Path("c"), (large,), {}), photo(640, 480, 2))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("cameras.txt", "# no camera\n", "cameras.txt has no cameras"),
        ("cameras.txt", "1 PINHOLE 64 48 nan 50 32 24\n", "cameras.txt: camera 1: invalid camera parameters nan"),
        ("cameras.txt", "1 PINHOLE 64 48 50\n", "PINHOLE has 4 parameters, got 1"),
        ("cameras.bin", "half a file", "cameras.bin is damaged"),
        (
            "lens.json",
            '{"model": "PINHOLE", "width": 64, "height": 48, "params": [NaN, 1, 1, 1]}',
            "invalid parameters|NaN",
        ),
        ("poses.txt", "0 1 2 3 0 0 0 1\n" * 3, "poses.txt has no cameras"),
        ("cameras.txt", "1 PINHOLE 64 40 50 50 32 20\n", "has no camera for photo photo 0.jpg of 64x48"),
        ("cameras.txt", "1 EQUIRECTANGULAR 64 48 64 48\n", "invalid size of an EQUIRECTANGULAR picture: 64x48"),
    ],
)
def test_files_that_are_of_no_use_are_bad_input(tmp_path: Path, name: str, content: str, said: str):
    photos = write_photos(tmp_path / "photos", 4)
    (tmp_path / name).write_text(content)
    result = nerfcli("poses", photos, "--dry-run", "--intrinsics", tmp_path / name)
    assert result.exit_code == BAD_INPUT, result.stderr
    error, _ = error_of(result)
    assert any(part in error for part in said.split("|")), error


def test_a_dry_run_says_which_cameras_are_used(tmp_path: Path):
    photos = write_photos(tmp_path / "photos", 4)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 128 96 100 100 64 48\n")
    result = nerfcli("poses", photos, "--dry-run", "--intrinsics", tmp_path / "cameras.txt")
    said = " ".join(result.stderr.split())
    assert "cameras.txt: 1 camera for 4 photos, 4 by size" in said
    assert "4 photos are 64x48, but the intrinsics are for 128x96: rescaled" in said
