"""Videos of rendered frames: H.264 that every player reads, written whole or not at all."""

import subprocess
import tempfile
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import imageio_ffmpeg
import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError

# Constant quality of x264: 0 is lossless, 18 is taken for visually lossless, 23 is the default.
_CRF = 16
# Left alone, ffmpeg converts by the matrix of standard television and tags nothing; players guess another.
_COLOURS = [
    *("-vf", "scale=out_color_matrix=bt709:out_range=tv"),
    *(
        "-colorspace",
        "bt709",
        "-color_primaries",
        "bt709",
        "-color_trc",
        "iec61966-2-1",
        "-color_range",
        "tv",
    ),
]


class VideoWriter:
    """A context that encodes frames (H.264, yuv420p, fast start) and puts the video in place when it closes.

        with VideoWriter(path, fps=30) as video:
            for frame in frames:
                video.add(frame)

    Frames of odd width or height get their last column or row twice, because the format stores colour for
    pairs of pixels. If an exception leaves the block, no file remains and one that stood at `path` is kept.

    Args:
        path: the file to write, ending in .mp4.
        fps: frames per second, > 0.

    Raises:
        UserError: the file cannot be written, or there is no ffmpeg.
        ValueError: fps is not positive, or the block ended without a frame.
    """

    def __init__(self, path: Path, *, fps: float):
        if not fps > 0:
            raise ValueError(f"fps must be positive, got {fps}")
        self._path = path
        self._fps = fps
        self._shape: tuple[int, ...] = ()
        self._encoder: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._partial = stack.enter_context(atomic_path(self._path))
            self._log = stack.enter_context(tempfile.TemporaryFile())
            stack.callback(self._stop)
            self._closing = stack.pop_all()
        return self

    def add(self, image: np.ndarray) -> None:
        """Append a frame.

        Args:
            image: uint8 (height, width, 3) sRGB, all frames of one size.

        Raises:
            UserError: the encoder stopped, for example because the disk is full.
            ValueError: another shape or type than that.
        """
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"frame must be uint8 (H, W, 3), got {image.dtype} {image.shape}")
        height, width = image.shape[:2]
        if self._encoder is None:
            self._shape = image.shape
            self._encoder = self._start(width + width % 2, height + height % 2)
        if image.shape != self._shape:
            raise ValueError(f"frame must be {self._shape} as the first one, got {image.shape}")
        even = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        assert self._encoder.stdin is not None
        try:
            self._encoder.stdin.write(even.tobytes())
        except OSError as error:  # a broken pipe: the encoder's own words are in its log
            self._encoder.wait()
            raise self._failure() from error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is None:
            self._closing.callback(self._finish)
        return self._closing.__exit__(kind, error, trace)

    def _start(self, width: int, height: int) -> subprocess.Popen[bytes]:
        try:
            ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError as error:
            hint = "install ffmpeg, or name its program in the variable IMAGEIO_FFMPEG_EXE"
            raise UserError(f"cannot write {self._path}: there is no ffmpeg", hint) from error
        command = [
            *(ffmpeg, "-hide_banner", "-loglevel", "error", "-y"),
            *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-framerate", f"{self._fps}"),
            *("-i", "-", *_COLOURS, "-c:v", "libx264", "-crf", f"{_CRF}", "-pix_fmt", "yuv420p"),
            # "file:", because a colon in a name would read as a protocol.
            *("-movflags", "+faststart", f"file:{self._partial}"),
        ]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._log)

    def _finish(self) -> None:
        if self._encoder is None:
            raise ValueError(f"no frame was added to {self._path}")
        self._encoder.communicate()
        if self._encoder.returncode != 0:
            raise self._failure()

    def _stop(self) -> None:
        """End the encoder where it has not ended by itself."""
        if self._encoder is None:
            return
        self._encoder.kill()
        assert self._encoder.stdin is not None
        with suppress(OSError):
            self._encoder.stdin.close()
        self._encoder.wait()

    def _failure(self) -> UserError:
        self._log.seek(0)
        lines = self._log.read().decode("utf-8", errors="replace").strip().splitlines()
        reason = lines[-1] if lines else "the encoder stopped"
        return UserError(f"cannot write {self._path}: {reason}", "free space on the disk, or write elsewhere")
