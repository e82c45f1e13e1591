"""Videos of frames, streamed to ffmpeg: H.264 in mp4, or gif; written whole or not at all."""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import IO

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.photos.video import ANOTHER_FFMPEG, ffmpeg_program

# By default ffmpeg converts with the matrix of standard-definition television and writes no tags, and players assume
# another matrix. Pictures are sRGB, so its transfer curve is used; "setparams" tags the frames, where encoders look.
_COLOURS = (
    "scale=out_color_matrix=bt709:out_range=tv,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1:range=tv"
)
# Visually close to the pictures. Compared with preset medium: three quarters of the time, files 1 % (photos) to 15 %
# (depth) larger, 0.05 dB less.
_H264 = ("-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p", "-preset", "fast", "-movflags", "+faststart")
# Formats, which are also the suffixes of the files, and the names of their encoders in `ffmpeg -encoders`.
ENCODERS = {"mp4": "libx264", "gif": "gif"}
# Players treat a delay below 2 hundredths of a second as 10 hundredths.
GIF_FASTEST_FPS = 50.0
# Ordered dither does not crawl over static areas, as error diffusion does.
_DITHER = "[0:v][1:v]paletteuse=dither=bayer:bayer_scale=4"


def check_encoders(formats: Iterable[str]) -> None:
    """Check that this machine's ffmpeg supports these of `ENCODERS`, before hours of rendering."""
    ffmpeg = _ffmpeg()
    try:
        listed = subprocess.run([ffmpeg, "-hide_banner", "-encoders"], capture_output=True, check=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise UserError(f"{ffmpeg} does not run: {error}", ANOTHER_FFMPEG) from error
    there = set(re.findall(r"^ V\S+ +(\S+)", listed.stdout, flags=re.MULTILINE))
    for name in formats:
        if ENCODERS[name] not in there:
            able = ", ".join(other for other, encoder in ENCODERS.items() if encoder in there) or "no videos"
            raise UserError(
                f"cannot write {name} videos: {ffmpeg} has no encoder {ENCODERS[name]}",
                f"it supports {able}; use one of these, or {ANOTHER_FFMPEG}",
            )


def write_video(path: Path, frames: Callable[[], Iterable[np.ndarray]], *, fps: float, comment: str) -> None:
    """Encode frames one by one, with memory independent of their number. The file appears when it is complete.

    The last column or row of frames with odd width or height is doubled, because H.264 stores colour for pairs of
    pixels (a gif does not, and frames stay unchanged). A gif repeats forever. The same frames give the same gif; an mp4
    may differ in a few bits on a busy machine.

    Args:
        path: the file to write, .mp4 or .gif.
        frames: returns the frames from the first to the last, uint8 (height, width, 3) sRGB, all of one size; called
            for each pass over them (a gif takes one for its palette and one for its pixels).
        fps: frames per second, > 0.
        comment: a text for the file's metadata, not empty.

    Raises:
        UserError: the file cannot be written, there is no ffmpeg, or it fails.
        ValueError: fps is not positive, there are no frames, or a frame has the wrong shape or type.
    """
    if not fps > 0:
        raise ValueError(f"fps must be positive, got {fps}")
    with atomic_path(path) as partial:
        if path.suffix == ".gif":
            _write_gif(partial, frames, fps=fps, comment=comment, target=path)
            return
        arguments = ["-vf", _COLOURS, *_H264, "-metadata", f"comment={comment}"]
        _encode(map(_even, frames()), partial, arguments, fps=fps, target=path)


def _write_gif(
    partial: Path, frames: Callable[[], Iterable[np.ndarray]], *, fps: float, comment: str, target: Path
) -> None:
    """Write one palette for the clip, then the pixels: in a single pass, ffmpeg would keep all frames in memory."""
    with tempfile.TemporaryDirectory(prefix=f"{partial.name}-", dir=partial.parent) as folder:
        palette, plain = Path(folder) / "palette.png", Path(folder) / "plain.gif"
        _encode(frames(), palette, ["-vf", "palettegen=reserve_transparent=0", "-update", "1"], fps=fps, target=target)
        arguments = ["-i", f"file:{palette}", "-lavfi", _DITHER, "-loop", "0"]  # forever
        _encode(frames(), plain, arguments, fps=fps, target=target)
        _add_gif_comment(plain, partial, comment)


def _add_gif_comment(plain: Path, commented: Path, comment: str) -> None:
    """Copy a gif with a comment extension before the first picture (GIF89a, section 24); ffmpeg writes none."""
    text = comment.encode()
    blocks = b"".join(bytes([len(part)]) + part for part in (text[i : i + 255] for i in range(0, len(text), 255)))
    with plain.open("rb") as source, commented.open("wb") as target:
        header = source.read(13)
        colours = 3 * 2 ** ((header[10] & 7) + 1) if header[10] & 0x80 else 0
        target.write(header + source.read(colours) + b"\x21\xfe" + blocks + b"\x00")
        shutil.copyfileobj(source, target)


def _encode(frames: Iterable[np.ndarray], output: Path, arguments: list[str], *, fps: float, target: Path) -> None:
    """Run ffmpeg with `frames` on its standard input; `target` is the path that errors name."""
    ffmpeg, process, shape = _ffmpeg(), None, (0, 0, 0)
    with tempfile.TemporaryFile() as log:
        try:
            for frame in frames:
                if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
                    raise ValueError(f"frame must be uint8 (H, W, 3), got {frame.dtype} {frame.shape}")
                if process is None:
                    shape = frame.shape
                    command = [
                        *(ffmpeg, "-hide_banner", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"),
                        *("-s", f"{shape[1]}x{shape[0]}", "-framerate", f"{fps}", "-i", "-", *arguments),
                        # No random numbers and no dates; "file:", because a colon would be read as a protocol.
                        *("-bitexact", f"file:{output}"),
                    ]
                    # In a separate session, so that Ctrl-C does not reach it: this process handles it.
                    process = subprocess.Popen(
                        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True
                    )
                if frame.shape != shape:
                    raise ValueError(f"frame must be {shape} as the first one, got {frame.shape}")
                assert process.stdin is not None
                try:
                    process.stdin.write(frame.tobytes())
                except OSError as error:  # a broken pipe: the encoder's message is in its log
                    process.wait()
                    raise _failure(target, log) from error
            if process is None:
                raise ValueError(f"there are no frames for {target}")
            process.communicate()
            if process.returncode != 0:
                raise _failure(target, log)
        finally:
            if process is not None:
                process.kill()
                assert process.stdin is not None
                with suppress(OSError):
                    process.stdin.close()
                process.wait()


def _even(frame: np.ndarray) -> np.ndarray:
    return np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")


def _ffmpeg() -> str:
    return ffmpeg_program("cannot write videos", instead=", or remove the video options")


def _failure(target: Path, log: IO[bytes]) -> UserError:
    log.seek(0)
    lines = log.read().decode("utf-8", errors="replace").strip().splitlines()
    reason = lines[-1] if lines else "the encoder stopped"
    full = not lines or any("No space left" in line for line in lines)
    hint = "free some disk space, or write elsewhere" if full else "try another size, or another --video-format"
    return UserError(f"cannot write {target}: {reason}", hint)
