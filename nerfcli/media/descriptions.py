"""Read the description of depth from a file of any format, without the pixels."""

import io
import struct
import subprocess
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import tifffile
from PIL import Image

from nerfcli.errors import UserError
from nerfcli.media.depth_pictures import KEY, DepthMeta, entries_of_text
from nerfcli.media.ffmpeg import ffmpeg_program

VIDEO_SUFFIXES = (".mp4", ".webm", ".mkv", ".mov", ".gif")

# Exceptions of the readers for damaged files; no common base class is documented.
DAMAGED = (
    *(OSError, EOFError, SyntaxError, ValueError, TypeError, LookupError, RuntimeError, NotImplementedError),
    *(struct.error, zlib.error, zipfile.BadZipFile, tifffile.TiffFileError, Image.DecompressionBombError),
)


def description_of(path: Path) -> dict[str, Any] | None:
    """Return the description in a file that nerfcli wrote, as plain values; None if a file has none.

    Args:
        path: TIFF, OpenEXR, NPZ, NPY (with its .json beside it), PNG or a video.

    Raises:
        UserError: the file is missing, damaged, or of another kind.
    """
    suffix = path.suffix.lower()
    reader = _READERS.get(suffix)
    if reader is None:
        suffixes = ", ".join(sorted(_READERS))
        raise UserError(
            f"{path} is not a supported depth, picture or video file", f"give its folder, or one of: {suffixes}"
        )
    try:
        text = reader(path)
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist", "check the path") from error
    except UserError:
        raise
    except DAMAGED as error:
        raise damaged(path, error) from error
    return entries_of_text(text)


def depth_meta_of(path: Path) -> DepthMeta | None:
    """Return the definition of the depth in a file that nerfcli wrote; None if it states none.

    Raises:
        UserError: see `description_of`.
    """
    entries = description_of(path)
    try:
        return None if entries is None else DepthMeta.from_json(entries)
    except (ValueError, TypeError):
        return None


def damaged(path: Path, error: Exception) -> UserError:
    """Return the two-line error for a file that cannot be decoded."""
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return UserError(f"{path} is damaged or truncated: {reason}", "copy it again, or render it again")


def _of_tiff(path: Path) -> str | None:
    with tifffile.TiffFile(path) as tiff:
        return tiff.pages[0].aspage().description


def _of_exr(path: Path) -> str | None:
    with path.open("rb") as stream:
        content = io.BytesIO(stream.read())  # given a path, OpenEXR refuses a file without saying why
    with OpenEXR.File(content, header_only=True) as file:
        return file.header().get(KEY)


def _of_npz(path: Path) -> str | None:
    # Opened here, because NumPy does not close a file that it cannot read.
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        return str(archive["meta"]) if "meta" in archive.files else None


def _of_npy(path: Path) -> str | None:
    path.stat()
    sidecar = path.with_suffix(".json")
    return sidecar.read_text(encoding="utf-8") if sidecar.is_file() else None


def _of_png(path: Path) -> str | None:
    with Image.open(path) as image:
        return image.info.get(KEY)


def _of_gif(path: Path) -> str | None:
    with Image.open(path) as image:
        comment = image.info.get("comment", b"")
        return comment.decode("utf-8", errors="replace") if isinstance(comment, bytes) else str(comment)


def _of_video(path: Path) -> str | None:
    """Return the comment of the container, as ffmpeg prints it."""
    path.stat()
    command = [ffmpeg_program(f"cannot read {path}"), "-v", "error", "-i", f"file:{path}", "-f", "ffmetadata", "-"]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode != 0:
        reason = done.stderr.decode("utf-8", errors="replace").strip().splitlines()
        raise ValueError(reason[-1] if reason else "ffmpeg cannot read it")
    return comment_of_ffmetadata(done.stdout.decode("utf-8", errors="replace"))


def comment_of_ffmetadata(text: str) -> str | None:
    """Return the value of "comment" in ffmpeg's own metadata format, in which =, ;, #, \\ and line ends are escaped."""
    value, inside, escaped = "", False, False
    for line in text.splitlines(keepends=True):
        if not inside:
            if not line.lower().startswith("comment="):
                continue
            inside, line = True, line[len("comment=") :]
        for character in line:
            if escaped:
                value, escaped = value + character, False
            elif character == "\\":
                escaped = True
            elif character == "\n":
                return value
            else:
                value += character
    return value if inside else None


_READERS: dict[str, Callable[[Path], str | None]] = {
    **dict.fromkeys(VIDEO_SUFFIXES, _of_video),
    ".tif": _of_tiff,
    ".tiff": _of_tiff,
    ".exr": _of_exr,
    ".npz": _of_npz,
    ".npy": _of_npy,
    ".png": _of_png,
    ".gif": _of_gif,
}
