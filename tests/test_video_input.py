"""nerfcli.photos.video: frames come back upright, whole in number, at their times; other files are refused."""

import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from clips import LOSSLESS, encode, ffmpeg, pan
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


def hdr_clip(path: Path, signal: np.ndarray, transfer: str) -> Path:
    """Write a video of grey patches with these signal values, 0...1, as a phone does: 10 bits, BT.2020."""
    picture = np.repeat(np.rint(65535 * signal).astype("<u2"), 16)[None, :, None].repeat(16, 0).repeat(3, 2)
    tags = f"setparams=color_primaries=bt2020:color_trc={transfer}:colorspace=bt2020nc:range=tv"
    to_yuv = f"scale=out_color_matrix=bt2020:out_range=tv,format=yuv444p10,{tags}"
    source = ("-f", "rawvideo", "-pix_fmt", "rgb48le", "-s", f"{picture.shape[1]}x16", "-i", "-")
    ffmpeg(*source, "-vf", to_yuv, "-c:v", "ffv1", str(path), raw=np.ascontiguousarray(picture).tobytes())
    return path


def hlg_signal(nits: np.ndarray) -> np.ndarray:
    """ITU-R BT.2100: the light of a scene that a screen of 1,000 cd/m2 shows with these luminances."""
    light = (nits / 1000) ** (1 / 1.2)
    log = 0.17883277 * np.log(np.maximum(12 * light - 0.28466892, 1e-9)) + 0.55991073
    return np.where(light <= 1 / 12, np.sqrt(3 * light), log)


def pq_signal(nits: np.ndarray) -> np.ndarray:
    """SMPTE ST 2084."""
    power = (nits / 10_000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


@pytest.mark.parametrize(("transfer", "signal"), [("arib-std-b67", hlg_signal), ("smpte2084", pq_signal)])
def test_hdr_video_becomes_srgb_with_paper_white_at_203_nits(tmp_path, transfer, signal):
    """Closed form below 0.7 of white, which is not compressed; above, brighter light stays brighter."""
    linear = np.array([0.01, 0.05, 0.18, 0.4, 0.65, 1.0, 2.0])
    video = open_video(hdr_clip(tmp_path / "a.mkv", signal(203 * linear), transfer))
    assert video.hdr
    (frame,) = read_frames(video, [0])
    levels = frame[8, 8::16].astype(float)
    assert (np.abs(levels - levels[:, :1]) <= 1).all()  # grey stays grey
    srgb = 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(levels[:5, 0], srgb[:5], atol=3)
    assert levels[4, 0] + 10 < levels[5, 0] < levels[6, 0] <= 255


FIELDS = ("-vf", "tinterlace=mode=interleave_top,setfield=mode={}", "-c:v", "ffv1")


def swing(count: int) -> list[np.ndarray]:
    """Views of a camera that moves sideways by 3 pixels a frame."""
    return pan([3.0 * number for number in range(count)])


@pytest.mark.parametrize("stated", ["tff", "prog"])
def test_the_fields_of_interlaced_frames_are_taken_apart(tmp_path, stated):
    """Each frame of the result is like the view at its first field, whatever the header says; combed ones are not."""
    views = swing(48)
    path = encode(tmp_path / "a.mkv", views, codec=[part.format(stated) for part in FIELDS], fps=60)
    video = open_video(path)
    measured = measure_frames(video, lambda f: 0, longer_side=999, progress=lambda fraction: None)
    assert (video.fields, measured.fields) == (("auto", "auto") if stated == "tff" else ("", "tff"))
    inner = np.s_[4:-4, 4:-4]

    def off(video: Video) -> float:
        found, expected = read_frames(video, [8, 12, 15]), [views[2 * number] for number in (8, 12, 15)]
        return np.mean([np.abs(a[inner] - b[inner].astype(float)) for a, b in zip(found, expected, strict=True)]).item()

    assert off(replace(video, fields=measured.fields)) < 0.5 * off(replace(video, fields=""))


def test_whole_frames_stay_whole_even_if_the_header_says_fields(tmp_path):
    path = encode(tmp_path / "a.mkv", swing(24), codec=("-vf", "setfield=mode=tff", "-c:v", "ffv1"))
    video = open_video(path)
    assert video.fields == "auto"
    assert measure_frames(video, lambda f: 0, longer_side=999, progress=lambda fraction: None).fields == ""


def two_streams(folder: Path, sizes: tuple[str, str]) -> Path:
    sources = [part for size in sizes for part in ("-f", "lavfi", "-i", f"testsrc2=s={size}:d=1")]
    ffmpeg(*sources, "-map", "0:v", "-map", "1:v", "-c:v", "ffv1", str(folder / "two.mkv"))
    return folder / "two.mkv"


def test_of_two_streams_the_larger_is_read(tmp_path):
    video = open_video(two_streams(tmp_path, ("64x48", "160x120")))
    assert (video.width, video.height, video.stream, video.num_streams) == (160, 120, 1, 2)
    assert next(read_frames(video, [3])).shape == (120, 160, 3)
    with pytest.raises(UserError, match=r"two\.mkv has 2 video streams of 64x48 pixels") as caught:
        open_video(two_streams(tmp_path, ("64x48", "64x48")))
    assert "-map 0:0 -c copy" in caught.value.hint


@pytest.mark.parametrize(("name", "hint"), [("VID_1.insv", "equirectangular MP4"), ("GX01.LRV", "give that video")])
def test_videos_of_360_cameras_and_previews_say_what_to_give(clip, tmp_path, name, hint):
    (tmp_path / name).write_bytes(clip.read_bytes())
    with pytest.raises(UserError, match=name) as caught:
        open_video(tmp_path / name)
    assert hint in caught.value.hint
