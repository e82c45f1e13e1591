"""nerfstudio's camera-path JSON against its definition, round trips, and the errors for damaged files."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import refused
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.camera_path import (
    FORMAT,
    find_camera_path,
    losses_camera_path,
    read_path,
    write_camera_path,
)
from nerfcli.errors import UserError

# A camera at (1, 2, 3) that looks along -x with +z up; OpenGL axes: right +y, up +z, backward +x.
OPENGL_POSE = [0.0, 0, 1, 1, 1, 0, 0, 2, 0, 1, 0, 3, 0, 0, 0, 1]
OPENCV_POSE = [[0.0, 0, -1, 1], [1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]]


def content(**more: Any) -> dict[str, Any]:
    view = {"camera_to_world": OPENGL_POSE, "fov": 60.0, "aspect": 1.0}
    return {"camera_type": "perspective", "render_height": 48, "render_width": 64, "camera_path": [view, view], **more}


def written(folder: Path, value: Any) -> Path:
    path = folder / "path.json"
    path.write_text(value if isinstance(value, str) else json.dumps(value), encoding="utf-8")
    return path


def nerfstudio_directions(kind: str, fov: float, pixels: np.ndarray, *, width: int, height: int) -> np.ndarray:
    """Return unit directions in OpenGL axes as nerfstudio computes them: get_path_from_json, then rays of Cameras."""
    focal = height / 2 / np.tan(fov * np.pi / 180 / 2)
    fx, fy = (width / 2, height) if kind == "equirectangular" else (focal, focal)
    x, y = (pixels[:, 0] - width / 2) / fx, -(pixels[:, 1] - height / 2) / fy
    if kind == "perspective":
        directions = np.stack([x, y, -np.ones_like(x)], axis=-1)
    elif kind == "fisheye":
        theta = np.sqrt(x**2 + y**2)
        directions = np.stack([x * np.sin(theta) / theta, y * np.sin(theta) / theta, -np.cos(theta)], axis=-1)
    else:
        theta, phi = -np.pi * x, np.pi * (0.5 - y)
        directions = np.stack([-np.sin(theta) * np.sin(phi), np.cos(phi), -np.cos(theta) * np.sin(phi)], axis=-1)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", ["perspective", "fisheye", "equirectangular"])
def test_pixels_see_where_nerfstudio_says(tmp_path, kind):
    """An independent implementation of nerfstudio's formulas, in world coordinates, off axis and off the diagonal."""
    frame = read_path(written(tmp_path, content(camera_type=kind))).frames[0]
    np.testing.assert_allclose(frame.world_from_cam, OPENCV_POSE, rtol=0, atol=1e-15)
    pixels = np.array([[3.5, 7.5], [60.0, 11.0], [32.5, 40.0], [20.0, 24.5]])
    directions, valid = frame.camera.bearings(pixels)
    assert valid.all()
    expected = nerfstudio_directions(kind, 60.0, pixels, width=64, height=48)
    world_from_opengl = np.array(OPENGL_POSE).reshape(4, 4)[:3, :3]
    found = directions @ frame.world_from_cam[:3, :3].T
    np.testing.assert_allclose(found, expected @ world_from_opengl.T, rtol=0, atol=1e-12)


def test_the_fov_is_vertical_and_of_a_fisheye_only_a_name_for_its_focal_length(tmp_path):
    perspective = read_path(written(tmp_path, content())).frames[0].camera
    np.testing.assert_allclose(perspective.fov_deg[1], 60.0, rtol=0, atol=1e-9)
    square = content(camera_type="fisheye", render_width=48)
    square["camera_path"][0]["fov"] = 90.0
    fisheye = read_path(written(tmp_path, square)).frames[0].camera
    np.testing.assert_allclose(fisheye.fov_deg[1], math.degrees(2.0), rtol=0, atol=1e-6)  # 114.6


@pytest.mark.parametrize(
    ("more", "fps"),
    [({"fps": 30, "seconds": 9.0}, 30.0), ({"seconds": 4.0}, 0.5), ({}, 24.0), ({"fps": None, "seconds": 1}, 2.0)],
)
def test_frames_per_second(tmp_path, more, fps):
    assert read_path(written(tmp_path, content(**more))).fps == fps


def test_a_camera_path_is_distinguished_from_other_files_and_parsed_as_a_capture(tmp_path):
    assert find_camera_path(written(tmp_path, content())) is not None
    assert find_camera_path(written(tmp_path, {"frames": [], "fl_x": 1.0, "camera_path": []})) is None
    nested = content(camera_type="Perspective", keyframes=[{"matrix": "[1, 2]"}])
    nested["camera_path"][0]["camera_to_world"] = np.array(OPENGL_POSE).reshape(4, 4).tolist()
    capture = FORMAT.parse(written(tmp_path, nested))
    assert [frame.name for frame in capture.frames] == ["frame_0000", "frame_0001"]
    assert (capture.kind, capture.missing, capture.points.shape) == ("camera-path", (), (0, 3))
    np.testing.assert_array_equal(capture.frames[0].world_from_cam, capture.frames[1].world_from_cam)


def random_capture(rng: np.random.Generator, kind: str) -> Capture:
    frames = []
    for index in range(4):
        pose = rigid.from_parts(Rotation.from_quat(rng.normal(size=4)).as_matrix(), 100 * rng.normal(size=3))
        pinhole = Camera.pinhole(64, 48, 10.0 ** rng.uniform(0.5, 3))
        camera = {
            "perspective": pinhole,
            "fisheye": Camera("OPENCV_FISHEYE", 64, 48, (*pinhole.params, 0, 0, 0, 0)),
            "equirectangular": Camera("EQUIRECTANGULAR", 64, 48, (64, 48)),
        }[kind]
        frames.append(Frame(f"orbit_{index:04d}", camera, pose))
    return Capture(tuple(frames), np.zeros((0, 3)), (), None, "path")


@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(["perspective", "fisheye", "equirectangular"]))
@examples(30)
def test_round_trip(tmp_path_factory, seed, kind):
    before = random_capture(np.random.default_rng(seed), kind)
    assert losses_camera_path(before) == ()
    path = tmp_path_factory.mktemp("trip") / "path.json"
    write_camera_path(before, path, fps=12.5)
    after = read_path(path)
    assert after.fps == 12.5
    for one, other in zip(after.frames, before.frames, strict=True):
        np.testing.assert_allclose(one.world_from_cam, other.world_from_cam, rtol=0, atol=1e-13)
        assert (one.camera.model, one.camera.width, one.camera.height) == (other.camera.model, 64, 48)
        np.testing.assert_allclose(one.camera.params, other.camera.params, rtol=1e-13)
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["seconds"] == 4 / 12.5
    assert [k["matrix"] for k in content["keyframes"]] == [v["camera_to_world"] for v in content["camera_path"]]


def test_what_the_format_cannot_hold_is_reported(tmp_path):
    opencv = Camera("OPENCV", 64, 48, (50, 52, 33, 24, 0.1, 0, 0, 0))
    frames = (
        Frame("a", opencv, np.eye(4)),
        Frame("b", Camera.pinhole(64, 48, 50.0), np.eye(4)),
        Frame("c", Camera.pinhole(128, 96, 100.0), np.eye(4)),
        Frame("d", Camera("SIMPLE_RADIAL_FISHEYE", 64, 48, (50, 32, 24, 0.0)), np.eye(4)),
    )
    capture = Capture(frames)
    assert losses_camera_path(capture) == (
        "type of lens of 1 of 4 views",
        "lens distortion of 1 of 4 views",
        "principal point of 1 of 4 views",
        "focal lengths that differ in x and y of 1 of 4 views",
        "picture size of 1 of 4 views",
    )
    write_camera_path(capture, tmp_path / "path.json")
    cameras = [frame.camera for frame in read_path(tmp_path / "path.json").frames]
    assert {(camera.model, camera.width, camera.height) for camera in cameras} == {("PINHOLE", 64, 48)}
    # The picture of twice the size has the same field of view.
    np.testing.assert_allclose([camera.focal_px for camera in cameras], [51, 50, 50, 50], rtol=1e-13)
    with pytest.raises(UserError, match="there are no views to write"):
        write_camera_path(Capture((), np.zeros((0, 3)), (), None, "x"), tmp_path / "none.json")
    assert not (tmp_path / "none.json").exists()


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ({"camera_type": "vr180"}, "camera_type is 'vr180'"),
        ({"camera_type": 3}, "camera_type is 3"),
        ({"render_height": None}, "render_height is None"),
        ({"render_height": 47.5}, "width and height are 64.0 and 47.5"),
        ({"render_width": 0}, "width and height are 0.0 and 48.0"),
        ({"render_height": float("nan")}, "render_height is nan"),
        ({"render_width": 10**12}, "width and height are 1000000000000.0 and 48.0"),
        ({"render_width": True}, "render_width is True"),
        ({"fps": 0}, "fps is 0"),
        ({"fps": "many"}, "fps is 'many'"),
        ({"seconds": -1}, "seconds is -1"),
        ({"camera_path": []}, "has no list camera_path"),
        ({"camera_path": {"a": 1}}, "has no list camera_path"),
        ({"camera_path": [3]}, r"camera_path\[0\]: is 3"),
    ],
)
def test_damaged_files_are_reported_with_file_and_field(tmp_path, more, what):
    path = written(tmp_path, content(**more))
    with refused(what, path):
        read_path(path)


TRANSPOSED = np.array(OPENGL_POSE).reshape(4, 4).T.ravel().tolist()


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ({"fov": None}, "fov is None"),
        ({"fov": 0}, "fov is 0"),
        ({"fov": 180}, "fov is 180"),
        ({"fov": float("nan")}, "fov is nan"),
        ({"camera_to_world": None}, "camera_to_world is None"),
        ({"camera_to_world": OPENGL_POSE[:12]}, "camera_to_world is a list of 12"),
        ({"camera_to_world": [*OPENGL_POSE[:15], float("inf")]}, "camera_to_world contains a number that is not"),
        ({"camera_to_world": [*OPENGL_POSE[:15], 10**400]}, "camera_to_world is a list of 16"),
        ({"camera_to_world": ["right", *OPENGL_POSE[1:]]}, "camera_to_world is a list of 16"),
        ({"camera_to_world": [[1.0], [2.0, 3.0], [4.0]]}, "camera_to_world is a list of 4"),
        ({"camera_to_world": TRANSPOSED}, "camera_to_world: its last row is 1 2 3 1"),
        ({"camera_to_world": [2.0, *OPENGL_POSE[1:]]}, "is not a rotation"),
        ({"camera_to_world": [0.0, 0, -1, *OPENGL_POSE[3:]]}, "mirrors the scene"),
    ],
)
def test_damaged_views_are_reported_with_their_number(tmp_path, more, what):
    good = {"camera_to_world": OPENGL_POSE, "fov": 60.0}
    path = written(tmp_path, content(camera_path=[good, {**good, **more}]))
    with refused(rf"camera_path\[1\].*{what}", path):
        read_path(path)
