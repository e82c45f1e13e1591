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
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Generic, TypeVar

import imageio_ffmpeg
import numpy as np

from nerfcli.errors import UserError
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
# Numbers of channels of PGM and PPM, picture formats that state their own size.
_CHANNELS = {b"P5": 1, b"P6": 3}
_LINES_KEPT = 60
ANOTHER_FFMPEG = "install ffmpeg, and set the environment variable IMAGEIO_FFMPEG_EXE to its path"


@dataclass(frozen=True)
class Video:
    """Header of a video.

    width and height are those of its frames, upright and with square pixels. seconds (stated duration) and fps (stated
    mean frame rate) are NaN where nothing is stated. hdr: the colours are stored for HDR screens (PQ or HLG).
    """

    path: Path
    width: int
    height: int
    seconds: float
    fps: float
    hdr: bool


@dataclass(frozen=True)
class MeasuredFrames(Generic[T]):
    """The measured value of each frame, its time since the first one, (frames,), and the number of decoding errors."""

    seconds: np.ndarray
    values: list[T]
    errors: int


def ffmpeg_program(purpose: str, *, instead: str = "") -> str:
    """Return the path of ffmpeg.

    Args:
        purpose: what fails without it, such as "cannot write videos".
        instead: what else the user can do, for the end of the hint.

    Raises:
        UserError: ffmpeg is not found, or IMAGEIO_FFMPEG_EXE names no program.
    """
    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise UserError(f"{purpose}: ffmpeg not found", ANOTHER_FFMPEG + instead) from error
    if shutil.which(program) is None:
        raise UserError(f"{purpose}: {program} is not a program", ANOTHER_FFMPEG + instead)
    return program


def open_video(path: Path) -> Video:
    """Read the header of a video and decode its first frame.

    Raises:
        UserError: the file does not exist, contains no video, or cannot be decoded.
    """
    if not path.is_file():
        raise UserError(f"{path} does not exist", "give a video file, or a folder of photos")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise UserError(f"{path} is a single photo", f"give the folder of the photos: {path.parent}")
    if path.stat().st_size == 0:
        raise UserError(f"{path} is empty (0 bytes)", "copy the video again")
    with _decoding(path, _UPRIGHT, "ppm", more=("-frames:v", "1")) as decoder:
        first = next(decoder.frames(), None)
        decoder.finish()
    head = "\n".join(decoder.head)
    if _NO_VIDEO.search(head) or "matches no streams" in decoder.last_errors:
        raise UserError(f"{path} contains no video stream", "give a video file, or a folder of photos")
    if first is None:
        raise _unreadable(path, decoder)
    stream = next((line for line in decoder.head if re.search(r"Stream #0:.* Video: ", line)), "")
    duration = re.search(r"Duration: (\d+):(\d+):([\d.]+)", head)
    fps = re.search(r"([\d.]+) fps", stream)
    return Video(
        path=path,
        width=first.shape[1],
        height=first.shape[0],
        seconds=int(duration[1]) * 3600 + int(duration[2]) * 60 + float(duration[3]) if duration else math.nan,
        fps=float(fps[1]) if fps else math.nan,
        hdr=bool(_HDR.search(stream)),
    )


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
    with _decoding(video.path, f"showinfo=checksum=0,scale={size}:flags=area,format=gray", "pgm") as decoder:
        for frame in decoder.frames():
            values.append(measure(frame))
            if video.seconds * video.fps > 0:
                progress(min(1.0, len(values) / (video.seconds * video.fps)))
        decoder.finish()
    if decoder.cut_short:
        raise _cut_short(video, decoder)
    if not values or decoder.returncode != 0:
        raise _unreadable(video.path, decoder)
    return MeasuredFrames(_times(decoder.times, len(values), video.fps), values, decoder.errors)


def read_frames(video: Video, numbers: Sequence[int]) -> Iterator[np.ndarray]:
    """Yield some frames in full size, one at a time.

    Args:
        numbers: indices of the frames, from 0, in ascending order.

    Yields:
        uint8 (height, width, 3) RGB, upright, with square pixels.

    Raises:
        UserError: a frame is missing, as the video has changed since it was measured.
    """
    given = 0
    with _decoding(video.path, f"select='{_one_of(numbers)}',{_UPRIGHT}", "ppm") as decoder:
        for frame in decoder.frames():
            given += 1
            yield frame
        decoder.finish()
    if given != len(numbers):
        raise _unreadable(video.path, decoder)


class _Decoder:
    """A running ffmpeg: its pictures come from stdout, and a separate thread sorts its messages on stderr.

    Of a possibly endless log only this is kept: the first lines (head), the last errors, their number (errors), the
    seconds that showinfo prints (times), and whether the file is truncated (cut_short).
    """

    def __init__(self, process: "subprocess.Popen[bytes]"):
        self._process = process
        self.head: list[str] = []
        self.times: list[str] = []
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
            if len(self.head) < _LINES_KEPT:
                self.head.append(line)
            if error := _ERROR.search(line):
                self.errors += 1
                self._last_errors.append(error[2])


@contextmanager
def _decoding(path: Path, filters: str, codec: str, *, more: Sequence[str] = ()) -> Iterator[_Decoder]:
    """Run ffmpeg on the first video stream, without covers and thumbnails; it is killed when the block ends."""
    command = [
        *(ffmpeg_program(f"cannot read {path}"), "-hide_banner", "-nostats", "-nostdin", "-loglevel", "level+info"),
        # "file:", because a colon in a name would be read as a protocol. The whitelist keeps inputs on this machine.
        *("-protocol_whitelist", "file,pipe", "-i", f"file:{path}", "-map", "0:V:0"),
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
