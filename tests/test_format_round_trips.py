"""Every format that is written: an independent reader finds what was written, and the parser of the format too."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import views
from captures import CAMERAS, reprojection_px, ring, with_photos
from readback import READERS, FileLens, assert_holds

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.conventions import OPENCV_FROM_OPENGL
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import blender, colmap_binary, llff, opensfm, trajectories, transforms
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import format_named
from nerfcli.captures.formats.transforms_cameras import lost_to_transforms, record_of_camera

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


NOT_IN_OPENSFM = {
    "FULL_OPENCV": ("k4", "k5", "k6"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("p0", "p1", "s0", "s1", "s2", "s3"),
}
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


def test_the_other_code_projects_fisheyes_as_opencv_does():
    camera = views.FISHEYE
    points = np.random.default_rng(0).normal((0, 0, 3), (1, 1, 0.5), (200, 3))
    fx, fy, cx, cy, *terms = camera.params
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(terms))
    pixels = FileLens(camera.model, camera.width, camera.height, camera.params).project(points)
    np.testing.assert_allclose(pixels, expected[:, 0], rtol=0, atol=1e-9)


# Faults: each is put into the code that writes, and must be found by the code that reads back


def half_a_pixel(camera: Camera) -> dict[str, Any]:
    content = record_of_camera(camera)
    return {**content, "cx": content["cx"] + 0.5, "cy": content["cy"] + 0.5}


def turned(pose: np.ndarray) -> np.ndarray:
    return pose @ np.diag([-1.0, -1.0, 1.0, 1.0])


def transposed(pose: np.ndarray) -> np.ndarray:
    wrong = opencv_gl(pose).copy()
    wrong[..., :3, :3] = np.swapaxes(wrong[..., :3, :3], -1, -2)
    return wrong


def opencv_gl(pose: np.ndarray) -> np.ndarray:
    return pose @ OPENCV_FROM_OPENGL


def scalar_last(rotation: np.ndarray) -> np.ndarray:
    return np.roll(rigid.quaternion_from_rotation(rotation), -1, axis=-1)


def rigid_with(**faults: Any) -> Any:
    """Return the module `rigid` with some functions replaced, to patch into a single module."""
    return SimpleNamespace(**{**vars(rigid), **faults})


rows_of_poses = colmap_binary.pose_rows

FAULTS = {
    "transforms, flipped axes": ("transforms", transforms, "opengl_from_opencv_pose", turned),
    "transforms, transposed rotation": ("transforms", transforms, "opengl_from_opencv_pose", transposed),
    "transforms, half a pixel": ("transforms", transforms, "record_of_camera", half_a_pixel),
    "transforms, other photo": ("transforms", transforms, "relative_path", lambda frame, folder: "ä_01.jpg"),
    "blender, flipped axes": ("blender", blender, "opengl_from_opencv_pose", turned),
    "llff, OpenGL axes": ("llff", llff, "llff_from_opencv_pose", opencv_gl),
    "opensfm, inverse transform": ("opensfm", opensfm, "rigid", rigid_with(inverse=lambda pose: pose)),
    "tum, order of quaternion": ("tum", trajectories, "rigid", rigid_with(quaternion_from_rotation=scalar_last)),
    "colmap, order of quaternion": (
        *("colmap", colmap_binary, "pose_rows"),
        lambda model: rows_of_poses(model)[:, [1, 2, 3, 0, 4, 5, 6]],
    ),
    "colmap, transposed rotation": (
        *("colmap", colmap_binary, "pose_rows"),
        lambda model: rows_of_poses(model) * [1, -1, -1, -1, 1, 1, 1],
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_writer_is_found(fault, tmp_path, monkeypatch):
    name, module, function, wrong = FAULTS[fault]
    capture = full(CENTRED[1], tmp_path)
    monkeypatch.setattr(module, function, wrong)
    path = written(capture, name, tmp_path)
    with pytest.raises(AssertionError):
        assert_holds(capture, READERS[name](path, capture))


@pytest.mark.parametrize(
    ("name", "part"),
    [
        *(("colmap", "colours"), ("transforms", "colours"), ("transforms", "masks"), ("transforms", "splits")),
        *((("nerfcli", part)) for part in ("observations", "masks", "splits", "depth_bounds", "unit")),
        *(("llff", "depth_bounds"), ("opensfm", "points")),
    ],
)
def test_what_stands_beside_the_cameras_is_compared(name, part, tmp_path):
    capture = full(CENTRED[1], tmp_path)
    (tmp_path / "my_photos").mkdir()
    (tmp_path / "my_photos/ä_00.jpg").touch()
    back = READERS[name](written(capture, name, tmp_path), capture)
    assert_holds(capture, back)
    assert capture.colours is not None
    assert capture.observations is not None
    assert capture.depth_bounds is not None
    changed: dict[str, Any] = {
        "points": capture.points[::-1],
        "colours": capture.colours[::-1],
        "observations": replace(capture.observations, point_index=capture.observations.point_index[::-1]),
        "masks": tuple(replace(frame, mask=None) for frame in capture.frames),
        "splits": tuple(replace(frame, split="train") for frame in capture.frames),
        "depth_bounds": 2 * capture.depth_bounds,
        "unit": "arbitrary",
    }
    field = "frames" if part in ("masks", "splits") else part
    with pytest.raises(AssertionError):
        assert_holds(replace(capture, **{field: changed[part]}), back)
