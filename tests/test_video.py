"""nerfcli.media.video: what ffmpeg reads back, and nothing left after an exception."""

import re
import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from nerfcli.errors import UserError
from nerfcli.media.video import VideoWriter


def smooth_frames(count: int, *, height: int, width: int) -> list[np.ndarray]:
    y, x = np.mgrid[:height, :width]
    ramps = [np.stack([255 * x / width, 255 * y / height, 0 * x + 200 * i / count], -1) for i in range(count)]
    return [ramp.round().astype(np.uint8) for ramp in ramps]


def stream_line(path: Path) -> str:
    """What ffmpeg says about the video stream."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", f"file:{path}"]
    text = subprocess.run(command, capture_output=True, check=False).stderr.decode()
    (line,) = re.findall(r"Stream #0:0.*Video: .*", text)
    return line


def decoded(path: Path, *, height: int, width: int) -> np.ndarray:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", f"file:{path}"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


@pytest.mark.parametrize("name", ["video.mp4", "mit Leerzeichen ä北.mp4", "a:b %d.mp4", "-y.mp4"])
def test_video_has_every_frame_in_its_colours(tmp_path, name):
    """64 x 48, 7 frames: the matrix is tagged and applied, so that colours come back within a few levels."""
    path, frames = tmp_path / "new" / name, smooth_frames(7, height=48, width=64)
    with VideoWriter(path, fps=12.5) as video:
        for frame in frames:
            video.add(frame)
        assert not path.exists()
    assert [p.name for p in path.parent.iterdir()] == [name]
    found = decoded(path, height=48, width=64)
    assert len(found) == 7
    assert np.abs(found.astype(int) - np.stack(frames)).mean() < 2
    line = stream_line(path)
    for part in ("h264", "yuv420p(tv, bt709", "64x48", "12.50 fps"):
        assert part in line


def test_relative_names_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with VideoWriter(Path("-a:b.mp4"), fps=30) as video:
        video.add(np.zeros((2, 2, 3), np.uint8))
    assert [p.name for p in tmp_path.iterdir()] == ["-a:b.mp4"]


@pytest.mark.parametrize(("height", "width"), [(47, 63), (48, 63), (47, 64), (1, 1)])
def test_odd_sizes_are_padded_with_their_edge(tmp_path, height, width):
    path = tmp_path / "odd.mp4"
    (frame,) = smooth_frames(1, height=height, width=width)
    with VideoWriter(path, fps=30) as video:
        video.add(frame)
    even_height, even_width = height + height % 2, width + width % 2
    (found,) = decoded(path, height=even_height, width=even_width).astype(int)
    assert f"{even_width}x{even_height}" in stream_line(path)
    padded = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    assert np.abs(found - padded).max() < 24  # a black edge would differ by up to 255


def test_the_index_stands_before_the_frames(tmp_path):
    """Fast start: a player on the web begins before the whole file is there."""
    path = tmp_path / "a.mp4"
    with VideoWriter(path, fps=30) as video:
        video.add(np.zeros((16, 16, 3), np.uint8))
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("num_frames", [0, 1, 5])
@pytest.mark.parametrize("problem", [KeyError("ours"), KeyboardInterrupt()])
def test_nothing_is_left_after_an_exception(tmp_path, num_frames, problem):
    def interrupted():
        with VideoWriter(tmp_path / "a.mp4", fps=30) as video:
            for frame in smooth_frames(num_frames, height=32, width=32):
                video.add(frame)
            encoders.append(video._encoder)
            raise problem

    encoders = []
    with pytest.raises(type(problem)) as caught:
        interrupted()
    assert caught.value is problem
    assert list(tmp_path.iterdir()) == []
    assert all(encoder is None or encoder.poll() is not None for encoder in encoders)


def test_an_exception_keeps_the_video_that_stood_there(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"the video of yesterday")
    with pytest.raises(ValueError, match="no frame was added"), VideoWriter(path, fps=30):
        pass
    assert path.read_bytes() == b"the video of yesterday"
    assert list(tmp_path.iterdir()) == [path]


def test_frames_must_be_alike(tmp_path):
    def add_all(*frames: np.ndarray) -> None:
        with VideoWriter(tmp_path / "a.mp4", fps=30) as video:
            for frame in frames:
                video.add(frame)

    with pytest.raises(ValueError, match=r"frame must be \(4, 6, 3\) as the first one, got \(6, 4, 3\)"):
        add_all(np.zeros((4, 6, 3), np.uint8), np.zeros((6, 4, 3), np.uint8))
    with pytest.raises(ValueError, match=r"frame must be uint8 \(H, W, 3\), got float64"):
        add_all(np.zeros((4, 6, 3)))
    with pytest.raises(ValueError, match="fps must be positive, got 0"):
        VideoWriter(tmp_path / "a.mp4", fps=0)
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "a.mp4").mkdir()
    with (
        pytest.raises(UserError, match=r"cannot write .*a\.mp4: Is a directory"),
        VideoWriter(tmp_path / "a.mp4", fps=30) as video,
    ):
        video.add(np.zeros((4, 6, 3), np.uint8))
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_an_encoder_that_fails_is_quoted(tmp_path, monkeypatch):
    """ffmpeg cannot open its output; the error names the file that was asked for and the encoder's reason."""
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\necho 'first line' >&2\necho 'No space left on device' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(broken))
    with (
        pytest.raises(UserError, match=r"cannot write .*a\.mp4: No space left on device"),
        VideoWriter(tmp_path / "a.mp4", fps=30) as video,
    ):
        video.add(np.zeros((1024, 1024, 3), np.uint8))  # more than a pipe holds: `add` meets the closed end
    with (
        pytest.raises(UserError, match=r"cannot write .*a\.mp4: No space left on device"),
        VideoWriter(tmp_path / "a.mp4", fps=30) as video,
    ):
        video.add(np.zeros((2, 2, 3), np.uint8))  # less: closing meets the exit status
    assert list(tmp_path.iterdir()) == [broken]


def test_a_missing_encoder_is_told(tmp_path, monkeypatch):
    def nothing():
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", nothing)
    with (
        pytest.raises(UserError, match=r"cannot write .*a\.mp4: there is no ffmpeg"),
        VideoWriter(tmp_path / "a.mp4", fps=30) as video,
    ):
        video.add(np.zeros((4, 4, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
