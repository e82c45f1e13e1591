"""Every format that is written: an independent reader finds what was written, and the parser of the format too."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import CAMERAS, reprojection_px, ring, with_photos
from readback import READERS, assert_holds

from nerfcli.cameras.camera import Camera
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import format_named
from nerfcli.captures.formats.transforms_cameras import lost_to_transforms

TOLERANCE_PX = 1e-6

CENTRED = (Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0)), Camera.pinhole(640, 480, 500.0))
SPLITS = ("train", "train", "train", "train", "val", "test")


def full(camera: Camera, folder: Path) -> Capture:
    """Return a capture with everything that one can have; its photos are in a folder."""
    capture = ring(camera)
    frames = [replace(f, name=f.name.replace(" ", "_"), split=s) for f, s in zip(capture.frames, SPLITS, strict=True)]
    (folder / "mask ö.png").touch()
    frames[1] = replace(frames[1], mask=folder / "mask ö.png")
    bounds = np.random.default_rng(0).uniform(1, 2, size=(len(frames), 2)).cumsum(axis=1)
    return with_photos(replace(capture, frames=tuple(frames), unit="metre", depth_bounds=bounds), folder)


def written(capture: Capture, name: str, folder: Path) -> Path:
    """Write a capture in a format, and return what to parse."""
    form = format_named(name)
    assert form.write is not None
    path = folder / "written" / form.default_name
    path.parent.mkdir(exist_ok=True)
    form.write(capture, path)
    return path


NOT_IN_OPENSFM = {"FULL_OPENCV": ("k4", "k5", "k6"), "RAD_TAN_THIN_PRISM_FISHEYE": ("p0", "p1", "s0", "s1", "s2", "s3")}
# Formats that do not hold every camera, and those that they hold.
HELD = {
    "transforms": [camera for camera in CAMERAS.values() if not lost_to_transforms(camera)],
    "opensfm": [
        camera.with_values(dict.fromkeys(NOT_IN_OPENSFM.get(model, ()), 0.0))
        for model, camera in CAMERAS.items()
        if model not in ("FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM")
    ],
    **dict.fromkeys(("blender", "llff"), CENTRED),
    **dict.fromkeys(("tum", "kitti"), CENTRED[:1]),
}
TRIPS = [(name, camera) for name in READERS for camera in HELD.get(name, CAMERAS.values())]


@pytest.mark.parametrize(("name", "camera"), TRIPS, ids=lambda item: getattr(item, "model", item))
def test_what_is_written_is_read_by_other_code_and_by_the_parser(tmp_path, name, camera):
    capture = full(camera, tmp_path)
    if name == "nerfcli":  # requires a photo
        assert capture.frames[0].image is not None
        capture.frames[0].image.parent.mkdir()
        capture.frames[0].image.touch()
    path = written(capture, name, tmp_path)
    assert_holds(capture, READERS[name](path, capture))
    again = format_named(name).parse(path, UserInputs(camera=camera))
    assert reprojection_px(capture, again) < TOLERANCE_PX
