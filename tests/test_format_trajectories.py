"""TUM and KITTI trajectories by hand and in round trips."""

from pathlib import Path

import numpy as np
import pytest
from captures import refused

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.trajectories import KITTI, TUM, losses_kitti, losses_tum, write_tum
from nerfcli.errors import UserError

CAMERA = Camera("OPENCV", 640, 480, (500, 510, 331, 236, 0.1, -0.05, 0.001, 0.002))
HALF = 0.5**0.5

# At (1, 2, 3), turned a quarter about y: the camera's x axis points along world -z, its z axis along world x.
POSE = [[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
TUM_TEXT = (
    f"# timestamp tx ty tz qx qy qz qw\n\n1305031102.1753 1 2 3 0 {HALF!r} 0 {HALF!r}\n1305031102.2112 0 0 0 0 0 0 1\n"
)
KITTI_TEXT = "0 0 1 1 0 1 0 2 -1 0 0 3\n1 0 0 0 0 1 0 0 0 0 1 0\n"

FORMATS = {"tum": TUM, "kitti": KITTI}
LOSSES = {"tum": losses_tum, "kitti": losses_kitti}
TEXTS = {"tum": TUM_TEXT, "kitti": KITTI_TEXT}


def capture_of(names: list[str]) -> Capture:
    rng = np.random.default_rng(2)
    poses = [rigid.look_at(6 * rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)) for _ in names]
    frames = [Frame(name, CAMERA, pose) for name, pose in zip(names, poses, strict=True)]
    return Capture(tuple(frames), np.zeros((0, 3)), (), None, "colmap")


@pytest.mark.parametrize(
    ("kind", "names"), [("tum", ["1305031102.1753", "1305031102.2112"]), ("kitti", ["000000", "000001"])]
)
def test_poses_by_hand(tmp_path, kind, names):
    path = tmp_path / "poses.txt"
    path.write_text(TEXTS[kind])
    capture = FORMATS[kind].parse(path, UserInputs(camera=CAMERA))
    assert [frame.name for frame in capture.frames] == names
    assert all(frame.camera == CAMERA and frame.image is None for frame in capture.frames)
    assert capture.kind == kind
    np.testing.assert_allclose(capture.frames[0].world_from_cam, POSE, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(capture.frames[1].world_from_cam, np.eye(4))


@pytest.mark.parametrize(
    ("names", "timestamps"),
    [
        (["0.5", "1.25"], ["0.5", "1.25"]),
        (["rgb/0.5.png", "rgb/1.25.png"], ["0.5", "1.25"]),
        (["a.png", "b.png"], ["0", "1"]),
        (["left/1.png", "right/1.png"], ["0", "1"]),  # no two poses at the same time
        (["1e3", "2E-4"], ["1e3", "2E-4"]),
        (["1", "nan"], ["0", "1"]),
    ],
)
def test_timestamps_are_the_names_where_these_are_numbers(tmp_path, names, timestamps):
    capture = capture_of(names)
    write_tum(capture, tmp_path / "poses.txt")
    lines = (tmp_path / "poses.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines[1:]] == timestamps
    lost = ("intrinsics of 1 camera",) if names == timestamps else ("intrinsics of 1 camera", "names of 2 frames")
    assert losses_tum(capture) == lost


def test_losses_are_reported():
    frame = Frame("000000", CAMERA, np.eye(4), mask=Path("m.png"), split="train")
    capture = Capture((frame,), np.ones((5, 3)), (), None, "x", colours=np.zeros((5, 3), dtype=np.uint8), unit="metre")
    rest = ("1 mask", "5 points", "colours of 5 points", "the split of 1 frame", "the unit of length (metre)")
    for losses in LOSSES.values():
        assert losses(capture) == ("intrinsics of 1 camera", *rest)
    assert losses_kitti(capture_of(["a"])) == ("intrinsics of 1 camera", "names of 1 frames")


@pytest.mark.parametrize("kind", FORMATS)
def test_without_a_camera_the_message_requests_one(tmp_path, kind):
    path = tmp_path / "poses.txt"
    path.write_text(TEXTS[kind])
    with pytest.raises(UserError, match=f"a {kind.upper()} trajectory contains poses but no camera") as caught:
        FORMATS[kind].parse(path, UserInputs())
    assert "--intrinsics" in caught.value.hint


@pytest.mark.parametrize(
    ("kind", "text", "what"),
    [
        ("tum", "", "has no pose"),
        ("tum", "# only\n", "has no pose"),
        ("tum", "1 2 3\n", "line 1: has 3 numbers"),
        ("tum", "\n1 0 0 0 0 0 0 x\n", "line 2: 'x' is not a number"),
        ("tum", "1 0 0 0 0 0 0 nan\n", "'nan' is not finite"),
        ("tum", "1 1e200 0 0 0 0 0 1\n", "'1e200' is too large"),
        ("tum", "noon 0 0 0 0 0 0 1\n", "its timestamp is 'noon'"),
        ("tum", "1 0 0 0 0 0 0 2\n", "quaternion has length 2"),
        ("tum", "1 0 0 0 0 0 0 0\n", "quaternion has length 0"),
        ("tum", "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "'1' is listed twice"),
        ("kitti", "1 0 0 0 0 1 0 0 0 0 1\n", "line 1: has 11 numbers"),
        ("kitti", "2 0 0 0 0 1 0 0 0 0 1 0\n", "is not a rotation"),
        ("kitti", "-1 0 0 0 0 1 0 0 0 0 1 0\n", "mirrors the scene"),
    ],
)
def test_malformed_files_are_refused_with_file_and_line(tmp_path, kind, text, what):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with refused(what, path):
        FORMATS[kind].parse(path, UserInputs(camera=CAMERA))
