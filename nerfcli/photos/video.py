"""Videos as input: their frames in order, decoded by ffmpeg, upright, with square pixels and their time stamps.

The ffmpeg program is used instead of OpenCV's VideoCapture because it both rotates and mirrors frames as the metadata
require, continues after a damaged section, and reports what is damaged or missing; VideoCapture merely ends early.
Frames are yielded one at a time, so that a long video needs no more memory than a short one.
"""

import math
import re
import shutil
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import IO, Generic, TypeVar

import imageio_ffmpeg
import numpy as np

from nerfcli.errors import UserError, in_shell
from nerfcli.photos.images import IMAGE_SUFFIXES

T = TypeVar("T")

# ffmpeg rotates and mirrors frames according to the metadata before it filters them.
_UPRIGHT = "scale=w='max(1,round(iw*if(gt(sar,0),sar,1)))':h=ih,setsar=1,format=rgb24"
# ffmpeg's messages about a truncated file, in any container.
_CUT_SHORT = re.compile(r"ended prematurely|partial file|moov atom not found", re.IGNORECASE)
_ERROR = re.compile(r"\[(error|fatal)\] (.*)")
_TIME = re.compile(r" pts_time:(\S+)")
# Inputs that ffmpeg would decode although they are not videos: text as screen art, photos, lists of other files.
_NO_VIDEO = re.compile(r"Input #0, (tty|image2|concat|hls|dash|sdp|ico|\w+_pipe)\b")
_HDR = re.compile(r"smpte2084|arib-std-b67")
_STREAM = re.compile(r"Stream #0:(\d+)\D.* Video: .*?, (\d+)x(\d+)")
_COVER = re.compile(r"\((attached pic|timed thumbnails|still image)\)")
# HDR video to sRGB: its reference white, paper at 203 cd/m2 (ITU-R BT.2408), becomes white, and brighter light is
# compressed from 0.7 of white on.
_SRGB_FROM_HDR = (
    "zscale=transfer=linear:npl=203:primariesin=bt2020:matrixin=bt2020nc,format=gbrpf32le,zscale=primaries=bt709,"
    "tonemap=mobius:param=0.7,zscale=transfer=iec61966-2-1:matrix=gbr:range=full,format=gbrp,"
)
# What ffmpeg says of a stream whose frames hold two fields, the lines of which were filmed one after the other.
_INTERLACED = re.compile(r"(top|bottom) (coded )?first")
# idet's count of frames by what it sees in them. If one kind is this many times the other, that counts, not the header.
_FIELDS = re.compile(r"Multi frame detection: TFF:\s*(\d+) BFF:\s*(\d+) Progressive:\s*(\d+)")
_CLEARLY, _FEWEST_SEEN = 4, 10
# Files of 360-degree cameras.
_UNREAD = {
    ".insv": (
        "holds the circles of two lenses of a 360-degree camera",
        "export it as an equirectangular MP4 with the program of the camera's maker, and give that",
    ),
    ".lrv": ("is a camera's small preview of another video", "give that video, which is beside it on the card"),
}
# Numbers of channels of PGM and PPM, picture formats that state their own size.
_CHANNELS = {b"P5": 1, b"P6": 3}
_LINES_KEPT = 60
# Frames of one call of ffmpeg: systems limit the length of a command line, Windows to 32,767 characters.
_MOST_NUMBERS = 1000
ANOTHER_FFMPEG = "install ffmpeg, and set the environment variable IMAGEIO_FFMPEG_EXE to its path"


@dataclass(frozen=True)
class Video:
    """Header of a video.

    width and height are those of its frames, upright and with square pixels. seconds (stated duration) and fps (stated
    mean frame rate) are NaN where nothing is stated. hdr: the colours are stored for HDR screens (PQ or HLG). stream:
    its number in the file, of num_streams with a video. fields: the parity of a video whose frames hold two fields, as
    ffmpeg's bwdif takes it; "" for whole frames.
    """

    path: Path
    width: int
    height: int
    seconds: float
    fps: float
    hdr: bool
    stream: int
    num_streams: int
    fields: str

    @property
    def _whole_frames(self) -> str:
        """The filter that interpolates each frame's lines of the later field."""
        return f"bwdif=mode=send_frame:parity={self.fields}," if self.fields else ""

    @property
    def _upright(self) -> str:
        """The filters from a decoded frame to upright sRGB with square pixels."""
        return f"{self._whole_frames}{_SRGB_FROM_HDR if self.hdr else ''}{_UPRIGHT}"


@dataclass(frozen=True)
class MeasuredFrames(Generic[T]):
    """The measured value of each frame, its time since the first one, (frames,), and the number of decoding errors.

    fields: as of the video, but by what most frames show, if that is clear: headers are often wrong.
    """

    seconds: np.ndarray
    values: list[T]
    errors: int
    fields: str


def ffmpeg_program(purpose: str, *, instead: str = "") -> str:
    """Return the path of ffmpeg.

    Args:
        purpose: what fails without it, such as "cannot write videos".
        instead: what else the user can do, for the end of the hint.
    """
    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise UserError(f"{purpose}: ffmpeg not found", ANOTHER_FFMPEG + instead) from error
    if shutil.which(program) is None:
        raise UserError(f"{purpose}: {program} is not a program", ANOTHER_FFMPEG + instead)
    return program


def open_video(path: Path) -> Video:
    """Read the header of a video and decode its first frame."""
    if not path.is_file():
        raise UserError(f"{path} does not exist", "give a video file, or a folder of photos")
    suffix = path.suffix.lower()
    if suffix in _UNREAD:
        what, hint = _UNREAD[suffix]
        raise UserError(f"{path} {what}", hint)
    if suffix in IMAGE_SUFFIXES - {".gif"}:
        raise UserError(f"{path} is a single photo", f"give the folder of the photos: {path.parent}")
    if path.stat().st_size == 0:
        raise UserError(f"{path} is empty (0 bytes)", "copy the video again")
    first, decoder = _first_frame(path, "0:V:0", _UPRIGHT)
    head = "\n".join(decoder.head)
    if _NO_VIDEO.search(head) or "matches no streams" in decoder.last_errors:
        raise UserError(f"{path} contains no video stream", "give a video file, or a folder of photos")
    if first is None:
        raise _unreadable(path, decoder)
    duration = re.search(r"Duration: (\d+):(\d+):([\d.]+)", head)
    seconds = int(duration[1]) * 3600 + int(duration[2]) * 60 + float(duration[3]) if duration else math.nan
    stream, line, num_streams = _largest_stream(path, decoder.head)
    fps = re.search(r"([\d.]+) fps", line)
    video = Video(
        path,
        *first.shape[1::-1],
        seconds=seconds,
        fps=float(fps[1]) if fps else math.nan,
        hdr=bool(_HDR.search(line)),
        stream=stream,
        num_streams=num_streams,
        fields="auto" if _INTERLACED.search(line) else "",
    )
    if num_streams > 1 or video.hdr:
        first, decoder = _first_frame(path, f"0:{stream}", video._upright)
        if "No such filter" in decoder.last_errors:
            raise UserError(
                f"{path} is an HDR video, and this ffmpeg cannot convert its colours: {decoder.last_errors}",
                f"unset IMAGEIO_FFMPEG_EXE to use the ffmpeg that came with nerfcli, or {ANOTHER_FFMPEG}",
            )
        if first is None:
            raise _unreadable(path, decoder)
        video = replace(video, width=first.shape[1], height=first.shape[0])
    return video


def _first_frame(path: Path, stream: str, filters: str) -> "tuple[np.ndarray | None, _Decoder]":
    with _decoding(path, filters, "ppm", stream=stream, more=("-frames:v", "1")) as decoder:
        first = next(decoder.frames(), None)
        decoder.finish()
    return first, decoder


def _largest_stream(path: Path, head: Sequence[str]) -> tuple[int, str, int]:
    """Return the number of the one video stream with most pixels, ffmpeg's line on it, and how many there are."""
    inputs = takewhile(lambda line: "Output #0" not in line, head)
    found = [(line, match) for line in inputs if (match := _STREAM.search(line)) and not _COVER.search(line)]
    if not found:
        return 0, "", 1
    pixels = [int(match[2]) * int(match[3]) for _, match in found]
    line, match = found[pixels.index(max(pixels))]
    if pixels.count(max(pixels)) > 1:
        one = path.with_name(f"{path.stem}-1.mp4")
        raise UserError(
            f"{path} has {pixels.count(max(pixels))} video streams of {match[2]}x{match[3]} pixels, such as the lenses "
            "of one camera",
            f"save the one to use as a file: ffmpeg -i {in_shell(path)} -map 0:{match[1]} -c copy {in_shell(one)}",
        )
    return int(match[1]), line, len(found)


def measure_frames(
    video: Video, measure: Callable[[np.ndarray], T], *, longer_side: int, progress: Callable[[float], None]
) -> MeasuredFrames[T]:
    """Apply `measure` to every frame, in order.

    Args:
        measure: gets uint8 (height, width): the frame in grey, averaged down where it is larger than `longer_side`.
        progress: called with the fraction that is done, 0...1, if the video states its duration and frame rate.

    Raises:
        UserError: the video is truncated, or cannot be decoded.
    """
    factor = max(1.0, max(video.width, video.height) / longer_side)
    size = f"{max(1, round(video.width / factor))}:{max(1, round(video.height / factor))}"
    values: list[T] = []
    filters = f"idet,{video._whole_frames}showinfo=checksum=0,scale={size}:flags=area,format=gray"
    with _decoding(video.path, filters, "pgm", stream=f"0:{video.stream}") as decoder:
        for frame in decoder.frames():
            values.append(measure(frame))
            if video.seconds * video.fps > 0:
                progress(min(1.0, len(values) / (video.seconds * video.fps)))
        decoder.finish()
    if decoder.cut_short:
        raise _cut_short(video, decoder)
    if not values or decoder.returncode != 0:
        raise _unreadable(video.path, decoder)
    times = _times(decoder.times, len(values), video.fps)
    return MeasuredFrames(times, values, decoder.errors, _shown_fields(decoder.counts, video.fields))


def _shown_fields(counts: tuple[int, int, int], stated: str) -> str:
    """Return the fields of a video by idet's counts of frames: top field first, bottom field first, whole."""
    top, bottom, whole = counts
    if max(top + bottom, whole) < max(_FEWEST_SEEN, _CLEARLY * min(top + bottom, whole)):
        return stated
    if whole > top + bottom:
        return ""
    return stated or ("tff" if top > bottom else "bff")


def read_frames(video: Video, numbers: Sequence[int]) -> Iterator[np.ndarray]:
    """Yield some frames in full size, one at a time.

    Args:
        numbers: indices of the frames, from 0, in ascending order.

    Yields:
        uint8 (height, width, 3) RGB, upright, with square pixels.

    Raises:
        UserError: a frame is missing, as the video has changed since it was measured.
    """
    for first in range(0, len(numbers), _MOST_NUMBERS):
        some, given = numbers[first : first + _MOST_NUMBERS], 0
        # The fields of a frame are interpolated with those of its neighbours, so before the choice.
        filters = f"{video._whole_frames}select='{_one_of(some)}',{_SRGB_FROM_HDR if video.hdr else ''}{_UPRIGHT}"
        with _decoding(video.path, filters, "ppm", stream=f"0:{video.stream}") as decoder:
            for frame in decoder.frames():
                given += 1
                yield frame
            decoder.finish()
        if given != len(some):
            raise _unreadable(video.path, decoder)


class _Decoder:
    """A running ffmpeg: its pictures come from stdout, and a separate thread sorts its messages on stderr.

    Of a possibly endless log only this is kept: the first lines (head), the last errors, their number (errors), the
    seconds that showinfo prints (times), idet's counts of frames by their fields (counts), and whether the file is
    truncated (cut_short).
    """

    def __init__(self, process: "subprocess.Popen[bytes]"):
        self._process = process
        self.head: list[str] = []
        self.times: list[str] = []
        self.counts = (0, 0, 0)
        self.errors = 0
        self.cut_short = False
        self._last_errors: deque[str] = deque(maxlen=_LINES_KEPT)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    @property
    def last_errors(self) -> str:
        """The last errors."""
        return "\n".join(self._last_errors)

    @property
    def returncode(self) -> int | None:
        return self._process.returncode

    def frames(self) -> Iterator[np.ndarray]:
        """Yield the pictures as they come."""
        assert self._process.stdout is not None
        while (picture := _read_picture(self._process.stdout)) is not None:
            yield picture

    def finish(self) -> None:
        """Wait until ffmpeg has ended and all its messages are read."""
        self._process.wait()
        self._listener.join()

    def _listen(self) -> None:
        assert self._process.stderr is not None
        for raw in self._process.stderr:
            line = raw.decode("utf-8", errors="replace").rstrip()
            # First, and in every line: showinfo prints its lines in pieces, between which other messages may appear.
            self.cut_short = self.cut_short or bool(_CUT_SHORT.search(line))
            if time := _TIME.search(line):
                self.times.append(time[1])
                continue
            if counts := _FIELDS.search(line):
                self.counts = (int(counts[1]), int(counts[2]), int(counts[3]))
            if len(self.head) < _LINES_KEPT or _STREAM.search(line):  # chapters and tags come before the streams
                self.head.append(line)
            if error := _ERROR.search(line):
                self.errors += 1
                self._last_errors.append(error[2])


@contextmanager
def _decoding(path: Path, filters: str, codec: str, *, stream: str, more: Sequence[str] = ()) -> Iterator[_Decoder]:
    """Run ffmpeg on a stream, "0:V:0" for the first that is no cover or thumbnail; it is killed when the block ends."""
    command = [
        *(ffmpeg_program(f"cannot read {path}"), "-hide_banner", "-nostats", "-nostdin", "-loglevel", "level+info"),
        # "file:", because a colon in a name would be read as a protocol. The whitelist keeps inputs on this machine.
        *("-protocol_whitelist", "file,pipe", "-i", f"file:{path}", "-map", stream),
        # Pass each frame exactly once: otherwise ffmpeg repeats and drops frames to make the rate constant.
        *("-fps_mode", "passthrough", "-vf", filters, *more, "-c:v", codec, "-f", "image2pipe", "-"),
    ]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    decoder = _Decoder(process)
    try:
        yield decoder
    finally:
        process.kill()
        decoder.finish()
        for pipe in (process.stdout, process.stderr):
            assert pipe is not None
            with suppress(OSError):
                pipe.close()


def _read_picture(pipe: IO[bytes]) -> np.ndarray | None:
    """Read the next 8-bit PGM or PPM picture; None at the end of the stream, even if it is inside a picture."""
    magic = pipe.readline().strip()
    if not magic:
        return None
    channels = _CHANNELS[magic]
    width, height = (int(text) for text in pipe.readline().split())
    assert pipe.readline().strip() == b"255"
    shape = (height, width) if channels == 1 else (height, width, channels)
    pixels = pipe.read(width * height * channels)
    return np.frombuffer(pixels, np.uint8).reshape(shape) if len(pixels) == width * height * channels else None


def _one_of(numbers: Sequence[int]) -> str:
    """Return ffmpeg's expression for "n is one of `numbers`": a search tree, since sums of 100 terms are too deep."""
    if len(numbers) == 1:
        return f"eq(n,{numbers[0]})"
    half = len(numbers) // 2
    return f"if(lt(n,{numbers[half]}),{_one_of(numbers[:half])},{_one_of(numbers[half:])})"


def _times(stamps: Sequence[str], count: int, fps: float) -> np.ndarray:
    """Return seconds since the first frame; from the frame rate if time stamps are missing or do not increase."""
    with suppress(ValueError):
        seconds = np.array([float(stamp) for stamp in stamps])
        if len(seconds) == count and np.isfinite(seconds).all() and (np.diff(seconds) > 0).all():
            return seconds - seconds[0]
    return np.arange(count) / (fps if fps > 0 else 30.0)


def _cut_short(video: Video, decoder: _Decoder) -> UserError:
    readable = _times(decoder.times, len(decoder.times), video.fps)
    until = f"{readable[-1]:.1f} s" if len(readable) else "the start"
    stated = f" of {video.seconds:.1f} s" if video.seconds > 0 else ""
    return UserError(
        f"{video.path} is truncated: it can be read up to {until}{stated}",
        "copy the video again, or save the readable part as a new file: ffmpeg -i OLD.mp4 -c copy NEW.mp4",
    )


def _unreadable(path: Path, decoder: _Decoder) -> UserError:
    errors = decoder.last_errors.splitlines()
    reason = errors[0] if errors else "no frame can be decoded"
    if decoder.cut_short:
        return UserError(f"{path} is truncated: {reason}", "copy the video again")
    hint = "give a video or a folder of photos; copy a damaged video again, or convert it to MP4 (H.264)"
    return UserError(f"{path} is not a readable video: {reason}", hint)
