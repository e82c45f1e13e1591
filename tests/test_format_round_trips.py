"""COLMAP -> each format -> COLMAP: every camera model that the format holds, by reprojection of all points."""

from dataclasses import replace
from pathlib import Path

import pytest
from captures import CAMERAS, reprojection_px, ring, with_photos

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.blender import parse_blender, write_blender
from nerfcli.cameras.formats.colmap import parse_colmap, write_colmap_binary, write_colmap_text
from nerfcli.cameras.formats.llff import parse_llff, write_llff
from nerfcli.cameras.formats.transforms import parse_transforms, write_transforms
from nerfcli.cameras.formats.transforms_cameras import lost_to_transforms
from nerfcli.cameras.formats.unsupported import lost_to_pinhole
from nerfcli.cameras.frame import Capture

TOLERANCE_PX = 1e-6

CENTRED = (Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0)), Camera.pinhole(640, 480, 500.0))


def through_transforms(capture: Capture, folder: Path) -> Capture:
    write_transforms(capture, folder / "transforms.json")
    return parse_transforms(folder / "transforms.json")


def through_blender(capture: Capture, folder: Path) -> Capture:
    for frame in capture.frames:
        (folder / frame.name).parent.mkdir(parents=True, exist_ok=True)
        (folder / frame.name).write_bytes(b"")
    write_blender(with_photos(capture, folder), folder)
    camera = capture.frames[0].camera
    return parse_blender(folder, lambda _: (camera.width, camera.height, 1))


def through_llff(capture: Capture, folder: Path) -> Capture:
    write_llff(capture, folder)
    return parse_llff(folder, lambda path: sorted(path.iterdir()))


def through_text(capture: Capture, folder: Path) -> Capture:
    write_colmap_text(capture, folder / "text")
    return parse_colmap(folder / "text")


TRIPS = [
    *((through_text, camera) for camera in CAMERAS.values()),
    *((through_transforms, camera) for camera in CAMERAS.values() if not lost_to_transforms(camera)),
    *((through_blender, camera) for camera in CENTRED),
    *((through_llff, camera) for camera in CENTRED),
]


@pytest.mark.parametrize(("through", "camera"), TRIPS, ids=lambda item: getattr(item, "model", None) or item.__name__)
def test_colmap_to_a_format_and_back(tmp_path, through, camera):
    write_colmap_binary(ring(camera), tmp_path / "before")
    before = parse_colmap(tmp_path / "before")
    (tmp_path / "between").mkdir()
    between = through(before, tmp_path / "between")
    write_colmap_binary(between, tmp_path / "after")
    after = parse_colmap(tmp_path / "after")
    assert reprojection_px(before, after) < TOLERANCE_PX


def test_a_format_that_loses_a_term_is_caught(tmp_path):
    """The measure can fail: without its distortion a lens is pixels off."""
    capture = ring(CAMERAS["OPENCV"])
    assert lost_to_pinhole(CAMERAS["OPENCV"])
    back = through_llff(replace(capture, observations=None), tmp_path)
    with pytest.raises(AssertionError):
        assert reprojection_px(capture, back) < TOLERANCE_PX
