"""nerfcli.photos.video: frames come back upright, whole in number, at their times; other files are refused."""

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from clips import LOSSLESS, encode, ffmpeg
from PIL import Image

from nerfcli.errors import UserError
from nerfcli.photos.video import Video, _Decoder, measure_frames, open_video, read_frames

COUNT, HEIGHT, WIDTH = 40, 48, 64


def level_of(number: int) -> int:
    return 20 + 5 * number


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """A red, a green, a blue and a grey quarter; the grey level encodes the number of the frame."""
    frames = []
    for number in range(COUNT):
        frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        frame[:24, :32, 0] = frame[:24, 32:, 1] = frame[24:, :32, 2] = 255
        frame[24:, 32:] = level_of(number)
        frames.append(frame)
    return frames


@pytest.fixture(scope="module")
def clip(frames, tmp_path_factory) -> Path:
    """The frames as MP4 with its index at the front, 30 per second."""
    return encode(tmp_path_factory.mktemp("clip") / "clip.mp4", frames, codec=(*LOSSLESS, "-movflags", "+faststart"))


def measured_levels(video: Video) -> tuple[np.ndarray, list[float]]:
    """Return the time of each frame and the mean grey of its fourth quarter."""
    found = measure_frames(
        video, lambda f: float(f[26:-2, 34:-2].mean()), longer_side=999, progress=lambda fraction: None
    )
    assert found.errors == 0
    return found.seconds, found.values


@pytest.mark.parametrize("name", ["b.mkv", "ü北 c.mov", "a:%d.mp4", "d.ts"])
def test_every_frame_comes_once_in_order_at_its_time(clip, tmp_path, name):
    """Closed form: frame n has level 20 + 5 n and the time n / 30, in whichever container."""
    ffmpeg("-i", str(clip), "-c", "copy", f"file:{tmp_path / name}")
    seconds, levels = measured_levels(open_video(tmp_path / name))
    np.testing.assert_allclose(seconds, np.arange(COUNT) / 30, atol=1e-3)  # Matroska's clock ticks in milliseconds
    np.testing.assert_allclose(levels, [level_of(number) for number in range(COUNT)], atol=1.5)


@pytest.mark.parametrize(("name", "codec"), [("e.avi", ("-c:v", "mjpeg", "-q:v", "2")), ("f.gif", ())])
def test_old_containers_are_read_too(frames, tmp_path, name, codec):
    seconds, levels = measured_levels(open_video(encode(tmp_path / name, frames, codec=codec, fps=25)))
    np.testing.assert_allclose(seconds, np.arange(COUNT) / 25, atol=1e-3)
    np.testing.assert_allclose(levels, [level_of(number) for number in range(COUNT)], atol=4)


def test_chosen_frames_are_those_that_were_measured(clip, frames):
    numbers = [0, 1, 7, 8, 19, 39]
    found = list(read_frames(open_video(clip), numbers))
    assert np.abs(np.stack(found).astype(int) - np.stack([frames[number] for number in numbers])).max() <= 3


def test_times_of_a_variable_frame_rate(clip, tmp_path):
    """Every third frame of the first half, all of the second: none is repeated or dropped, and times are kept."""
    path = tmp_path / "vfr.mp4"
    ffmpeg("-i", str(clip), "-vf", "select='if(lt(n,20),not(mod(n,3)),1)'", "-fps_mode", "vfr", *LOSSLESS, str(path))
    expected = [*range(0, 20, 3), *range(20, COUNT)]
    video = open_video(path)
    seconds, levels = measured_levels(video)
    np.testing.assert_allclose(seconds, np.array(expected) / 30, atol=1e-3)
    np.testing.assert_allclose(levels, [level_of(number) for number in expected], atol=1.5)
    (eighth,) = read_frames(video, [8])
    assert abs(int(eighth[-5, -5, 0]) - level_of(21)) <= 2


@pytest.mark.parametrize("codec", [("-c:v", "libx265", "-x265-params", "log-level=error", "-pix_fmt", "yuv420p10le")])
def test_ten_bits_become_eight(frames, tmp_path, codec):
    video = open_video(encode(tmp_path / "ten.mp4", frames, codec=codec))
    _, levels = measured_levels(video)
    np.testing.assert_allclose(levels, [level_of(number) for number in range(COUNT)], atol=4)
    assert next(read_frames(video, [3])).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize(
    ("metadata", "upright"),
    [
        (("-display_rotation", "90"), np.rot90),
        (("-display_rotation", "180"), lambda frame: np.rot90(frame, 2)),
        (("-display_rotation", "-90"), lambda frame: np.rot90(frame, 3)),
        (("-display_hflip",), np.fliplr),
    ],
)
def test_turned_and_mirrored_as_the_metadata_say_and_once(clip, frames, tmp_path, metadata, upright):
    """NumPy's rotation is the truth (counter-clockwise, as ffmpeg documents -display_rotation)."""
    path = tmp_path / "turned.mp4"
    ffmpeg(*metadata, "-i", str(clip), "-c", "copy", str(path))
    video, expected = open_video(path), upright(frames[5])
    assert (video.height, video.width) == expected.shape[:2]
    (found,) = read_frames(video, [5])
    assert np.abs(found.astype(int) - expected).max() <= 3
    grey = measure_frames(video, np.copy, longer_side=32, progress=lambda fraction: None).values[5]
    assert grey.shape == tuple(size // 2 for size in expected.shape[:2])
    luma = expected.astype(float) @ [0.299, 0.587, 0.114]  # BT.601, as the clip was encoded
    assert np.abs(grey - luma[::2, ::2]).max() <= 2


def test_pixels_become_square(clip, tmp_path):
    path = tmp_path / "anamorphic.mp4"
    ffmpeg("-i", str(clip), "-vf", "setsar=2", *LOSSLESS, str(path))
    video = open_video(path)
    (found,) = read_frames(video, [0])
    assert found.shape == (HEIGHT, 2 * WIDTH, 3) == (video.height, video.width, 3)


def test_progress_rises_to_the_end(clip):
    fractions: list[float] = []
    measure_frames(open_video(clip), np.mean, longer_side=64, progress=fractions.append)
    assert fractions == sorted(fractions)
    assert len(fractions) == COUNT
    assert fractions[-1] == pytest.approx(1, abs=0.05)


def test_frames_come_one_at_a_time(clip):
    """A measure that stops at the third frame has seen three: nothing was decoded ahead of it into memory."""
    seen = []

    def stop(frame: np.ndarray) -> None:
        seen.append(frame)
        if len(seen) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure_frames(open_video(clip), stop, longer_side=64, progress=lambda fraction: None)
    assert len(seen) == 3


@pytest.mark.parametrize("name", ["front.mp4", "front.mkv"])
def test_a_truncated_video_is_reported(clip, tmp_path, name):
    whole = tmp_path / f"whole-{name}"
    ffmpeg("-i", str(clip), "-c", "copy", "-movflags", "+faststart", str(whole))
    content = whole.read_bytes()
    (tmp_path / name).write_bytes(content[: int(0.7 * len(content))])
    with pytest.raises(UserError, match=r"truncated: it can be read up to 0\.\d s of 1\.3 s"):
        measured_levels(open_video(tmp_path / name))


def test_what_a_thread_says_amid_the_line_of_another_is_heard():
    """Seen from ffmpeg in 74 of 2,000 runs with eight at once, and in 3 of 400 beside other work."""
    torn = b"[Parsed_showinfo_0 @ 0x7f68] [info] n: 11 pts_time:0.366667 stream 0, offset 0x17d0: partial file\n"
    decoder = _Decoder(cast(Any, SimpleNamespace(stderr=io.BytesIO(torn), wait=lambda: 0)))
    decoder.finish()
    assert decoder.cut_short
    assert decoder.times == ["0.366667"]


def test_a_video_without_its_index_is_cut_short(clip, tmp_path):
    whole = tmp_path / "whole.mp4"
    ffmpeg("-i", str(clip), "-c", "copy", str(whole))  # the index comes last
    (tmp_path / "cut.mp4").write_bytes(whole.read_bytes()[:-2000])
    with pytest.raises(UserError, match=r"cut\.mp4 is truncated"):
        open_video(tmp_path / "cut.mp4")


def test_what_is_no_video_is_reported(tmp_path):
    ffmpeg("-f", "lavfi", "-i", "sine=duration=0.2", str(tmp_path / "sound.m4a"))
    Image.new("RGB", (32, 32)).save(tmp_path / "photo.jpg")
    (tmp_path / "notes.txt").write_text("no video\n" * 100)
    (tmp_path / "empty.mp4").touch()
    for name, said in {
        "sound.m4a": "contains no video stream",
        "photo.jpg": "is a single photo",
        "notes.txt": r"no video stream|is not a readable video",
        "empty.mp4": r"empty \(0 bytes\)",
        "absent.mp4": "does not exist",
    }.items():
        with pytest.raises(UserError, match=said):
            open_video(tmp_path / name)


def test_a_frame_that_is_not_there(clip):
    with pytest.raises(UserError, match="is not a readable video"):
        list(read_frames(open_video(clip), [3, COUNT]))
