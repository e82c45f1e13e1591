"""nerfcli.render.files.film: what ffmpeg and Pillow read back, and nothing left after an exception."""

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from commands import error_of, nerfcli
from PIL import Image

from nerfcli.errors import BAD_INPUT, UserError
from nerfcli.render.files.film import ENCODERS, check_encoders, write_video


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
    command += ["-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


def write(path: Path, frames: list[np.ndarray], *, fps: float = 30, comment: str = "what it shows") -> None:
    write_video(path, lambda: frames, fps=fps, comment=comment)


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("video.mp4", ("h264", "yuv420p(tv, bt709/bt709/iec61966-2-1", "12.50 fps")),
        ("mit Leerzeichen ä北.mp4", ("h264",)),
        ("a:b %d.mp4", ("h264",)),
        ("-y.mp4", ("h264",)),
        ("a:b %d.gif", ("gif", "12.50 fps")),
    ],
)
def test_video_has_every_frame_in_its_colours(tmp_path, name, parts):
    """64 x 48, 7 frames: the matrix is tagged and applied, so that colours come back within a few levels."""
    path, frames = tmp_path / "new" / name, smooth_frames(7, height=48, width=64)

    def source() -> Iterator[np.ndarray]:
        yield from frames
        assert not path.exists()

    write_video(path, source, fps=12.5, comment="what it shows")
    assert [p.name for p in path.parent.iterdir()] == [name]
    found = decoded(path, height=48, width=64)
    assert len(found) == 7
    # The gif has 256 colours for all of it.
    assert np.abs(found.astype(int) - np.stack(frames)).mean() < {".gif": 15, ".mp4": 2}[path.suffix]
    assert all(part in stream_line(path) for part in ("64x48", *parts))


@pytest.mark.parametrize("kind", ENCODERS)
def test_the_comment_is_in_the_file(tmp_path, kind):
    comment = json.dumps({"axis": "z", "run": "Küche = 1; #2", "text": 300 * "long "}, ensure_ascii=False)
    frames = smooth_frames(3, height=16, width=16)
    path = tmp_path / f"a.{kind}"
    write(path, frames, comment=comment)
    assert len(decoded(path, height=16, width=16)) == 3
    if kind == "gif":
        with Image.open(path) as image:
            assert image.info["comment"].decode() == comment
    else:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", path, "-f", "ffmetadata", "-"]
        reported = subprocess.run(command, capture_output=True, check=True).stdout.decode()
        (line,) = re.findall("^comment=(.*)$", reported, flags=re.MULTILINE | re.IGNORECASE)
        assert re.sub(r"\\(.)", r"\1", line) == comment


def test_the_same_frames_give_the_same_gif(tmp_path):
    """An mp4 reproduces pictures but not bytes: x264 changes a few bits in one of 1,000 files."""
    paths = [tmp_path / f"{name}.gif" for name in "ab"]
    for path in paths:
        write(path, smooth_frames(3, height=16, width=16), comment="of both")
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_gif_repeats_for_ever(tmp_path):
    """Pillow reads the Netscape extension: the number of repetitions, 0 for ever."""
    write(tmp_path / "a.gif", smooth_frames(2, height=8, width=8))
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info.get("loop") == 0


def test_relative_names_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("-a:b.mp4"), [np.zeros((2, 2, 3), np.uint8)])
    assert [p.name for p in tmp_path.iterdir()] == ["-a:b.mp4"]


@pytest.mark.parametrize(("height", "width"), [(47, 63), (48, 63), (47, 64), (1, 1)])
def test_odd_sizes_are_padded_with_their_edge(tmp_path, height, width):
    path = tmp_path / "odd.mp4"
    (frame,) = smooth_frames(1, height=height, width=width)
    write(path, [frame])
    even_height, even_width = height + height % 2, width + width % 2
    (found,) = decoded(path, height=even_height, width=even_width).astype(int)
    assert f"{even_width}x{even_height}" in stream_line(path)
    padded = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    assert np.abs(found - padded).max() < 24  # a black edge would differ by up to 255


def test_the_index_stands_before_the_frames(tmp_path):
    """Fast start: a web player begins before the whole file has arrived."""
    path = tmp_path / "a.mp4"
    write(path, [np.zeros((16, 16, 3), np.uint8)])
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("num_frames", [0, 1, 5])
@pytest.mark.parametrize("problem", [KeyError("ours"), KeyboardInterrupt()])
@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_nothing_is_left_after_an_exception(tmp_path, num_frames, problem, kind, monkeypatch):
    imageio_ffmpeg.get_ffmpeg_exe()  # starts a process of its own the first time
    encoders = []
    start = subprocess.Popen

    def started(*args: Any, **options: Any) -> subprocess.Popen[Any]:
        encoders.append(start(*args, **options))
        return encoders[-1]

    monkeypatch.setattr(subprocess, "Popen", started)

    def interrupted() -> Iterator[np.ndarray]:
        yield from smooth_frames(num_frames, height=32, width=32)
        raise problem

    with pytest.raises(type(problem)) as caught:
        write_video(tmp_path / f"a.{kind}", interrupted, fps=30, comment="what it shows")
    assert caught.value is problem
    assert list(tmp_path.iterdir()) == []
    assert len(encoders) == (num_frames > 0)
    assert all(encoder.poll() is not None for encoder in encoders)


def test_an_exception_keeps_the_video_that_stood_there(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"the video of yesterday")
    with pytest.raises(ValueError, match="there are no frames"):
        write(path, [])
    assert path.read_bytes() == b"the video of yesterday"
    assert list(tmp_path.iterdir()) == [path]


def test_frames_must_be_alike(tmp_path):
    path = tmp_path / "a.mp4"
    with pytest.raises(ValueError, match=r"frame must be \(4, 6, 3\) as the first one, got \(6, 4, 3\)"):
        write(path, [np.zeros((4, 6, 3), np.uint8), np.zeros((6, 4, 3), np.uint8)])
    with pytest.raises(ValueError, match=r"frame must be uint8 \(H, W, 3\), got float64"):
        write(path, [np.zeros((4, 6, 3))])
    with pytest.raises(ValueError, match="fps must be positive, got 0"):
        write(path, [], fps=0)
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_reported(tmp_path):
    (tmp_path / "a.mp4").mkdir()
    with pytest.raises(UserError, match=r"cannot write .*a\.mp4: Is a directory"):
        write(tmp_path / "a.mp4", [np.zeros((4, 6, 3), np.uint8)])
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


@pytest.fixture
def broken_ffmpeg(tmp_path, monkeypatch) -> Callable[[str], Path]:
    """Put a shell script in place of ffmpeg."""

    def put(script: str) -> Path:
        program = tmp_path / "ffmpeg"
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
        return program

    return put


def test_an_encoder_that_fails_is_quoted(tmp_path, broken_ffmpeg):
    """ffmpeg cannot open its output; the error names the file that was asked for and the encoder's reason."""
    program = broken_ffmpeg("echo 'first line' >&2\necho 'No space left on device' >&2\nexit 1")
    for side in (1024, 2):  # more than a pipe holds: writing fails; less: closing finds the status
        with pytest.raises(UserError, match=r"cannot write .*a\.mp4: No space left on device"):
            write(tmp_path / "a.mp4", [np.zeros((side, side, 3), np.uint8)])
    assert list(tmp_path.iterdir()) == [program]


def test_all_encoders_are_in_the_ffmpeg_that_comes_along():
    check_encoders(ENCODERS)


def test_a_missing_encoder_is_reported_with_those_available(broken_ffmpeg):
    broken_ffmpeg("echo ' V....D gif GIF'")
    check_encoders(["gif"])
    with pytest.raises(UserError, match=r"cannot write mp4 videos: .*ffmpeg has no encoder libx264") as caught:
        check_encoders(["mp4", "gif"])
    assert caught.value.hint.startswith("it supports gif; use one of these, or install ffmpeg")
    broken_ffmpeg("exit 3")
    with pytest.raises(UserError, match="does not run"):
        check_encoders(["mp4"])


def test_a_missing_ffmpeg_is_reported(tmp_path, monkeypatch):
    def nothing():
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", nothing)
    with pytest.raises(UserError, match="cannot write videos: ffmpeg not found"):
        check_encoders(["mp4"])
    with pytest.raises(UserError, match="cannot write videos: ffmpeg not found"):
        write(tmp_path / "a.mp4", [np.zeros((4, 4, 3), np.uint8)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [("info",), ("poses", "--frames", "4")])
def test_a_video_is_not_called_damaged_where_ffmpeg_is_missing(command, tmp_path, monkeypatch):
    """Regression: if IMAGEIO_FFMPEG_EXE was a missing file, poses ended with a traceback and info missed the video."""
    video = tmp_path / "a.mp4"
    write(video, [np.zeros((16, 16, 3), np.uint8)] * 4)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "none"))
    result = nerfcli(command[0], video, *command[1:])
    assert result.exit_code == BAD_INPUT
    error, hint = error_of(result)
    assert error == f"Error: cannot read {video}: {tmp_path / 'none'} is not a program"
    assert hint.startswith("Hint:  install ffmpeg, and set the environment variable IMAGEIO_FFMPEG_EXE")
