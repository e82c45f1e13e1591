"""Small videos with known content for tests of video input, encoded by the ffmpeg that also reads them."""

import subprocess
from collections.abc import Sequence
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np

# Lossless, so that levels can be compared; yuv444p, so that a pixel has a colour of its own.
LOSSLESS = ("-c:v", "libx264", "-qp", "0", "-preset", "ultrafast", "-pix_fmt", "yuv444p")


def ffmpeg(*arguments: str, raw: bytes = b"") -> None:
    """Run ffmpeg; it must succeed."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", *arguments]
    subprocess.run(command, input=raw, check=True, capture_output=True)


def encode(path: Path, frames: Sequence[np.ndarray], *, codec: Sequence[str] = LOSSLESS, fps: int = 30) -> Path:
    """Write a video of uint8 (height, width, 3) frames and return its path."""
    height, width = frames[0].shape[:2]
    source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-framerate", str(fps), "-i", "-")
    ffmpeg(*source, *codec, f"file:{path}", raw=b"".join(np.ascontiguousarray(frame).tobytes() for frame in frames))
    return path


def wallpaper(*, height: int = 240, width: int = 900, seed: int = 0) -> np.ndarray:
    """Return a picture with detail everywhere and at every scale, to move a camera over."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.uniform(0, 255, (max(2, height // size), max(2, width // size), 3)), (width, height))
        for size in (2, 6, 20, 60)
    ]
    return np.mean(layers, axis=0).round().astype(np.uint8)


def pan(
    offsets: Sequence[float | np.integer], *, height: int = 120, width: int = 160, blurred: Sequence[int] = ()
) -> list[np.ndarray]:
    """Return views of the wallpaper shifted by `offsets` pixels; those in `blurred` have sideways motion blur."""
    paper = wallpaper()
    frames = []
    for number, offset in enumerate(offsets):
        view = cv2.getRectSubPix(paper, (width, height), (width / 2 + 20 + offset, 120.0))
        frames.append(cv2.blur(view, (9, 1)) if number in blurred else view)
    return frames
