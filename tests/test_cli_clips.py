"""nerfcli poses and run with a video: where its frames and its scene go, and the errors for unusable videos."""

from pathlib import Path
from typing import Any

import pytest
from clips import encode, ffmpeg, pan
from commands import estimated_poses, nerfcli

from nerfcli.errors import BAD_INPUT, TOO_FEW_PHOTOS, UserError
from nerfcli.poses import structure_from_motion
from nerfcli.workflows import pipeline


@pytest.fixture
def estimated(monkeypatch) -> list[tuple[str, str, int]]:
    """The calls of structure from motion: folder, scene, number of photos in the folder. Each makes an empty scene."""
    calls = []

    def estimate(folder: Path, scene: Path, **more: Any) -> Any:
        calls.append((str(folder), str(scene), len(list(folder.glob("*.jpg")))))
        scene.mkdir(parents=True, exist_ok=True)
        return estimated_poses()

    monkeypatch.setattr(structure_from_motion, "estimate_poses", estimate)
    return calls


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    return encode(tmp_path_factory.mktemp("video") / "my clip.MOV", pan([3.0 * number for number in range(20)]))


@pytest.fixture
def clip(video, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = Path("my clip.MOV")
    path.write_bytes(video.read_bytes())
    return path


def test_frames_stand_beside_the_scene(clip, estimated):
    result = nerfcli("poses", clip, "--frames", "6")
    assert (result.exit_code, result.stdout) == (0, "my clip-scene\n")
    assert estimated == [("my clip-frames", "my clip-scene", 6)]
    assert "my clip-frames: 6 of 20 frames of my clip.MOV" in result.stderr


def test_frames_stand_beside_the_output(clip, estimated, tmp_path, monkeypatch):
    """Regression: a traceback where that is the folder that one is in, as "." has no name."""
    assert nerfcli("poses", clip, "--frames", "6", "-o", "out/kitchen").stdout == "out/kitchen\n"
    (tmp_path / "kitchen").mkdir()
    monkeypatch.chdir(tmp_path / "kitchen")
    assert nerfcli("poses", Path("..") / clip, "--frames", "6", "-o", ".").stdout == ".\n"
    assert estimated == [("out/kitchen-frames", "out/kitchen", 6), (f"{tmp_path}/kitchen-frames", ".", 6)]


def test_run_takes_a_video_too(clip, estimated, monkeypatch):
    def stop(*args: Any, **settings: Any) -> None:
        raise UserError("far enough", "")

    monkeypatch.setattr(pipeline, "train_scene", stop)
    assert "far enough" in nerfcli("run", clip, "--frames", "6", "-o", "all").stderr
    assert "far enough" in nerfcli("run", clip, "--frames", "6").stderr
    assert estimated == [("all/frames", "all/scene", 6), ("my clip-frames", "my clip-scene", 6)]


def test_videos_and_folders_on_standard_input(clip, estimated):
    """Unreadable files are reported, the rest is processed, and the exit code is that of the failure."""
    Path("photos").mkdir()
    ffmpeg("-f", "lavfi", "-i", "sine=duration=0.2", "sound.m4a")
    Path("cut.mp4").write_bytes(clip.read_bytes()[:-900])
    lines = "photos\nsound.m4a\ncut.mp4\nmy clip.MOV\n"
    result = nerfcli("poses", "-", "--frames", "6", stdin=lines)
    assert result.exit_code == BAD_INPUT
    assert result.stdout.splitlines() == ["photos-scene", "my clip-scene"]
    assert [folder for folder, _, _ in estimated] == ["photos", "my clip-frames"]
    for reported in (
        "photos is not a video: using all of its photos",
        "Error: sound.m4a contains no video stream",
        "cut.mp4 is truncated",
    ):
        assert reported in result.stderr
    assert sorted(path.name for path in Path().iterdir() if "frames" in path.name) == ["my clip-frames"]


@pytest.mark.parametrize("number", ["0", "3", "-1", "many"])
def test_a_number_of_frames_that_cannot_be(number, clip, estimated):
    assert nerfcli("poses", clip, f"--frames={number}").exit_code == 2
    assert estimated == []


def test_a_camera_that_stands_still(tmp_path, estimated):
    result = nerfcli("poses", encode(tmp_path / "still.mp4", pan([0.0] * 12)))
    assert result.exit_code == TOO_FEW_PHOTOS
    assert "walking around" in result.stderr
    assert estimated == []


def test_frames_and_scene_are_kept(clip, estimated):
    nerfcli("poses", clip, "--frames", "6")
    assert "my clip-frames is kept" in nerfcli("poses", clip, "--frames", "6").stderr
    assert "my clip-frames contains other frames" in nerfcli("poses", clip, "--frames", "5").stderr
    assert nerfcli("poses", clip, "--frames", "5", "--overwrite").exit_code == 0
    assert [count for _, _, count in estimated] == [6, 6, 5]
