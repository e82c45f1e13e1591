"""AliceVision's .sfm against files by hand in each version of the format, and its own formulas."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import assert_projects, refused
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.alicevision import FORMAT, parse_alicevision
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import recognise

# Written by Meshroom 2023: focal length and sensor in millimetres, 6.3 mm / 9 mm * 640 px = 448 px.
LENS = (
    {"intrinsicId": "77", "width": "640", "height": "480", "sensorWidth": "9", "sensorHeight": "6.75"}
    | {"serialNumber": "x", "type": "radial3", "initializationMode": "estimated", "initialFocalLength": "6"}
    | {"focalLength": "6.3", "pixelRatio": "1", "pixelRatioLocked": "true", "principalPoint": ["-3.5", "2.25"]}
    | {"distortionParams": ["0.08", "-0.11", "0.03"], "undistortionParams": "", "locked": "false"}
)
WITHOUT_TERMS = {"distortionParams": ["0", "0", "0"]}
ROTATIONS = Rotation.from_rotvec([[0.1, -0.4, 0.2], [1.3, 0.2, -0.7]]).as_matrix()
CENTRES = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 2.0]])


def texts(values: np.ndarray) -> list[str]:
    return [repr(value) for value in values.ravel().tolist()]


def content(**lens: Any) -> dict[str, Any]:
    paths = ("D:/house/day 1/a.jpg", "D:/house/day 2/a.jpg", "D:/house/day 2/lost.jpg")
    views = [
        {"viewId": str(i), "poseId": str(i), "intrinsicId": "77", "path": path, "width": "640", "height": "480"}
        for i, path in enumerate(paths)
    ]
    poses = [
        {"poseId": str(i), "pose": {"transform": {"rotation": texts(rotation), "center": texts(centre)}, "locked": "0"}}
        for i, (rotation, centre) in enumerate(zip(ROTATIONS, CENTRES, strict=True))
    ]
    head = {"version": ["1", "2", "6"], "featuresFolders": ["../f"], "matchesFolders": ["../m"]}
    return {**head, "views": views, "intrinsics": [LENS | lens], "poses": poses}


def write(folder: Path, content: dict[str, Any], *, name: str = "cameras.sfm") -> Path:
    path = folder / name
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_poses_are_world_from_camera_by_rows_and_names_are_relative(tmp_path):
    (tmp_path / "day 2").mkdir()
    (tmp_path / "day 2/a.jpg").write_bytes(b"")
    capture = parse_alicevision(write(tmp_path, content()))
    # The third view has no pose.
    assert capture.notes[1:] == ("1 photo without a pose left out: day 2/lost.jpg",)
    assert [frame.name for frame in capture.frames] == ["day 1/a.jpg", "day 2/a.jpg"]
    assert [frame.image for frame in capture.frames] == [tmp_path / "day 1/a.jpg", tmp_path / "day 2/a.jpg"]
    poses = [frame.world_from_cam for frame in capture.frames]
    np.testing.assert_allclose(poses, rigid.from_parts(ROTATIONS, CENTRES), rtol=0, atol=1e-15)
    assert (capture.kind, capture.unit, len(capture.points)) == ("alicevision", "arbitrary", 0)
    (tmp_path / "photos").mkdir()
    elsewhere = parse_alicevision(write(tmp_path, content()), UserInputs(tmp_path / "photos"))
    photos = [tmp_path / "photos/day 1/a.jpg", tmp_path / "photos/day 2/a.jpg"]
    assert [frame.image for frame in elsewhere.frames] == photos


def test_photos_are_used_where_the_file_says_if_they_are_there(tmp_path):
    (tmp_path / "here").mkdir()
    (tmp_path / "here/a.jpg").write_bytes(b"")
    changed = content()
    changed["views"] = [changed["views"][0] | {"path": str(tmp_path / "here/a.jpg")}]
    assert parse_alicevision(write(tmp_path, changed)).frames[0].image == tmp_path / "here/a.jpg"


@pytest.mark.parametrize(
    ("version", "lens", "params"),
    [
        ((1, 2, 6), {}, (448, 448, 316.5, 242.25)),
        ((1, 2, 6), {"pixelRatio": "1.25"}, (448, 560, 316.5, 242.25)),
        ((1, 2, 4), {"pixelRatio": "1.25"}, (448, 358.4, 316.5, 242.25)),
        ((1, 2, 1), {"pxFocalLength": ["448", "450"]}, (448, 450, 316.5, 242.25)),
        (
            (1, 2, 0),
            {"pxFocalLength": ["448", "450"], "principalPoint": ["316.5", "242.25"]},
            (448, 450, 316.5, 242.25),
        ),
        ((1, 0, 0), {"pxFocalLength": "448", "principalPoint": ["316.5", "242.25"]}, (448, 448, 316.5, 242.25)),
    ],
)
def test_focal_length_and_principal_point_of_each_version(tmp_path, version, lens, params):
    file = content(**WITHOUT_TERMS, **lens) | {"version": [str(number) for number in version]}
    camera = parse_alicevision(write(tmp_path, file)).frames[0].camera
    assert (camera.model, camera.width, camera.height) == ("PINHOLE", 640, 480)
    np.testing.assert_allclose(camera.params, params, rtol=1e-15)


def test_numbers_that_are_no_texts(tmp_path):
    """As scripts in Python write them that read the file with float()."""

    def as_numbers(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: item if key.endswith("Id") else as_numbers(item) for key, item in value.items()}
        if isinstance(value, list):
            return list(map(as_numbers, value))
        try:
            return float(value)
        except ValueError:
            return value

    as_texts = parse_alicevision(write(tmp_path, content()))
    again = parse_alicevision(write(tmp_path, as_numbers(content())))
    assert [frame.camera for frame in again.frames] == [frame.camera for frame in as_texts.frames]
    for frame, other in zip(again.frames, as_texts.frames, strict=True):
        np.testing.assert_array_equal(frame.world_from_cam, other.world_from_cam)


def distorted(terms: list[float], points: np.ndarray) -> np.ndarray:
    """DistortionBrown::addDistortion, written out, in pixels of the lens."""
    k1, k2, k3, t1, t2 = (*terms, *(0.0,) * 5)[:5]
    x, y = (points[:, :2] / points[:, 2:]).T
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    tx = t2 * (r2 + 2 * x * x) + 2 * t1 * x * y
    ty = t1 * (r2 + 2 * y * y) + 2 * t2 * x * y
    return 448 * np.stack([x * radial + tx, y * radial + ty], axis=-1) + [316.5, 242.25]


@pytest.mark.parametrize(
    ("lens", "listed", "terms"),
    [
        ({}, ["0.08", "-0.11", "0.03"], [0.08, -0.11, 0.03]),
        ({"type": "radial1"}, ["0.08"], [0.08]),
        ({"type": "radial1"}, ["0.08", "-0.11", "0.03"], [0.08]),  # left over from another lens
        ({"type": "brown"}, ["0.08", "-0.11", "0.03", "0.002", "-0.003"], [0.08, -0.11, 0.03, 0.002, -0.003]),
        ({"type": "pinhole", "distortionType": "radialk3"}, ["0.08", "-0.11", "0.03"], [0.08, -0.11, 0.03]),  # later
        ({"type": "pinhole", "distortionType": "none"}, "", []),
    ],
)
def test_lenses_project_by_its_formulas(tmp_path, lens, listed, terms):
    camera = parse_alicevision(write(tmp_path, content(**lens, distortionParams=listed))).frames[0].camera
    assert_projects(camera, lambda points: distorted(terms, points))


def test_fisheyes_are_those_of_opencv(tmp_path):
    terms = {"type": "fisheye4", "distortionParams": ["0.01", "-0.02", "0.003", "0.0004"]}
    camera = parse_alicevision(write(tmp_path, content(**terms))).frames[0].camera
    assert camera == Camera("OPENCV_FISHEYE", 640, 480, (448.0, 448.0, 316.5, 242.25, 0.01, -0.02, 0.003, 0.0004))


def test_points_and_their_colours(tmp_path):
    structure = [
        {"landmarkId": "5", "descType": "sift", "color": ["10", "20", "255"], "X": ["1.5", "-2", "3e-1"]},
        {"landmarkId": "6", "descType": "sift", "color": ["0", "7", "8"], "X": ["0", "0", "1"], "observations": []},
    ]
    capture = parse_alicevision(write(tmp_path, content() | {"structure": structure}))
    np.testing.assert_array_equal(capture.points, [[1.5, -2, 0.3], [0, 0, 1]])
    np.testing.assert_array_equal(capture.colours, [[10, 20, 255], [0, 7, 8]])


def test_files_are_recognised_by_their_suffix_or_their_keys(tmp_path):
    path = write(tmp_path, content(), name="sfm.json")
    transforms = write(tmp_path, {"frames": [], "camera_angle_x": 1.0}, name="transforms.json")
    for place, name in ((path, "alicevision"), (transforms, "transforms")):
        assert recognise(place)[0].name == name
    transforms.unlink()
    assert recognise(tmp_path)[0].name == "alicevision"
    path.rename(tmp_path / "any.sfm")
    assert recognise(tmp_path / "any.sfm")[0].name == "alicevision"


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"poses": None}, "has no version, views, intrinsics or poses"),
        ({"version": ["1", "2"]}, "version is a list of 2"),
        ({"views": [content()["views"][0] | {"rigId": "3"}]}, r"views\[0\]: belongs to a camera rig"),
        ({"views": [content()["views"][0] | {"intrinsicId": "8"}]}, r"views\[0\]: intrinsicId is '8'"),
        ({"views": [content()["views"][0] | {"poseId": []}]}, "lists no images with a pose"),
        ({"views": []}, "lists no images with a pose"),
        ({"intrinsics": [LENS | {"type": "equidistant"}]}, "a lens of type 'equidistant' is not supported"),
        ({"intrinsics": [LENS | {"sensorWidth": "0"}]}, "sensorWidth is 0"),
        ({"intrinsics": [LENS | {"focalLength": "wide"}]}, "focalLength is 'wide'"),
        ({"intrinsics": [LENS | {"intrinsicId": 77}]}, r"intrinsics\[0\]: intrinsicId is 77"),
        ({"structure": [{"X": ["1", "2"], "color": ["0", "0", "0"]}]}, r"structure\[0\]: X is a list of 2"),
    ],
)
def test_damaged_files_are_refused_with_their_field(tmp_path, change, what):
    path = write(tmp_path, content() | change)
    with refused(what, path):
        FORMAT.parse(path)
