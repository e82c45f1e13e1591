"""Facts about a depth, picture or video file: its description, read without the pixels, size, and range of values.

A file of another program is reported as numbers without a stated convention.
"""

import io
import json
import re
import struct
import subprocess
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import tifffile
from PIL import Image

from nerfcli.errors import UserError
from nerfcli.photos.video import ffmpeg_program
from nerfcli.render.files.depth_meta import FORMAT, KEY, DepthMeta, entries_of_text
from nerfcli.render.files.float_maps import CHANNELS, depth_of_levels, read_exr, read_npy, read_tiff

VIDEO_SUFFIXES = (".mp4", ".webm", ".mkv", ".mov", ".gif")

# Exceptions of the readers for damaged files; no common base class is documented.
DAMAGED = (
    *(OSError, EOFError, SyntaxError, ValueError, TypeError, LookupError, RuntimeError, NotImplementedError),
    *(struct.error, zlib.error, tifffile.TiffFileError, Image.DecompressionBombError),
)
_KINDS = {".tif": "TIFF", ".tiff": "TIFF", ".exr": "OpenEXR", ".npy": "NPY", ".png": "PNG"}
# The file in which an export describes itself, beside the folders of its outputs.
RENDERS = "render.json"
NOT_STATED = "definition of depth (mean, median, ...), axis (ray or optical axis), unit, and the length of a level"


def description_of(path: Path) -> dict[str, Any] | None:
    """Return the description in a file that nerfcli wrote, as plain values; None if a file has none.

    Args:
        path: TIFF, OpenEXR, NPY (with its .json beside it), PNG or a video.

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
    """Return the definition of the depth in a file that nerfcli wrote; None if it states none."""
    return _stated(description_of(path))


def _stated(entries: dict[str, Any] | None) -> DepthMeta | None:
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
    found = re.search(r"^comment=((?:\\.|[^\\\n])*)", text, re.IGNORECASE | re.MULTILINE | re.DOTALL)
    return None if found is None else re.sub(r"\\(.)", r"\1", found[1], flags=re.DOTALL)


_READERS: dict[str, Callable[[Path], str | None]] = {
    **dict.fromkeys(VIDEO_SUFFIXES, _of_video),
    ".tif": _of_tiff,
    ".tiff": _of_tiff,
    ".exr": _of_exr,
    ".npy": _of_npy,
    ".png": _of_png,
    ".gif": _of_gif,
}


def file_facts(path: Path) -> dict[str, Any]:
    """Return the facts about one file as plain values.

    The facts are kind ("depth", "levels", "preview", "picture", "video" or "array"), format, width, height, depth (one
    sentence), meaning (`DepthMeta` as plain values), not_stated, maps (dtype, shape, valid_share, min, median, max of
    each map, in the unit of the meaning) and texts (other text chunks of a PNG).
    """
    entries = description_of(path)
    meta = _meta(path, entries)
    suffix = path.suffix.lower()
    maps, texts = {}, {}
    if suffix in VIDEO_SUFFIXES:
        facts = {"kind": "video", "format": suffix[1:], **_video_facts(path)}
    else:
        maps, texts = _read_png(path, meta) if suffix == ".png" else (_read_maps(path, meta), {})
        if "picture" in maps:
            kind = "picture" if meta is None else "preview"
        else:
            kind = "depth" if meta is not None else "levels" if "levels" in maps else "array"
        facts = {"kind": kind, "format": _KINDS[suffix], **_size_of(maps)}
        maps = {name: _range(array) for name, array in maps.items() if name != "picture"}
    facts |= _definition(entries, meta)
    not_stated = NOT_STATED if meta is None and facts["kind"] in ("array", "levels") else None
    return {**facts, "not_stated": not_stated, "maps": maps, "texts": texts}


def renders_facts(folder: Path) -> dict[str, Any]:
    """Return the facts about a folder that `nerfcli render` wrote: kind, frames, outputs, run, depth and meaning."""
    path = folder / RENDERS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        facts = {"kind": "renders", "frames": len(content["frames"]), "outputs": content["settings"].get("outputs")}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise UserError(f"cannot read {path}: {error}", "render again with --overwrite") from error
    entries = content.get("depth_meaning")
    return {**facts, "run": content.get("run"), **_definition(entries, _meta(path, entries))}


def _definition(entries: dict[str, Any] | None, meta: DepthMeta | None) -> dict[str, Any]:
    return {"depth": None if meta is None else meta.in_words(), "meaning": None if meta is None else entries}


def _meta(path: Path, entries: dict[str, Any] | None) -> DepthMeta | None:
    """Return the definition of depth in a description; None if there is none."""
    stated = (entries or {}).get("format", FORMAT)
    if isinstance(stated, str) and stated.startswith("nerfcli depth") and stated > FORMAT:
        raise UserError(f"{path} is of format {stated!r}, but this version reads {FORMAT!r}", "update nerfcli")
    return _stated(entries)


def _read_maps(path: Path, meta: DepthMeta | None) -> dict[str, np.ndarray]:
    """Return the arrays of a TIFF, OpenEXR or NPY file by name."""
    suffix = path.suffix.lower()
    if suffix != ".exr":
        values = read_npy(path) if suffix == ".npy" else read_tiff(path)
        return {meta.quantity if meta else "array": values}
    channels = read_exr(path)
    if meta is None:
        return channels
    named = {name: channels[channel] for name, channel in CHANNELS.items() if channel in channels}
    return named | {name: channels[name] for name in ("R", "G", "B", "A") if name in channels}


def _read_png(path: Path, meta: DepthMeta | None) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the depth, levels or colours of a PNG by name, and its texts without the definition of depth."""
    try:
        with Image.open(path) as image:
            image.load()
            texts = {str(key): value for key, value in image.info.items() if isinstance(value, str)}
            pixels = np.asarray(image)
    except (OSError, SyntaxError, ValueError) as error:
        raise damaged(path, error) from error
    if meta is not None:
        texts.pop(KEY, None)
    if pixels.ndim == 3 or pixels.dtype == np.uint8:
        return {"picture": pixels.astype(np.uint8)}, texts
    if meta is not None and meta.units_per_level is not None:
        return {meta.quantity: depth_of_levels(pixels, meta.units_per_level)}, texts
    return {"levels": pixels}, texts


def _video_facts(path: Path) -> dict[str, Any]:
    if path.suffix.lower() == ".gif":
        with Image.open(path) as image:
            width, height = image.size
            frames, seconds = getattr(image, "n_frames", 1), image.info.get("duration", 0) / 1000
            fps = 1 / seconds if seconds else None
    else:
        video = cv2.VideoCapture(str(path))
        width, height = video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        frames, fps = video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)
        video.release()
    fps = None if fps is None else round(fps, 3)
    return {"width": int(width), "height": int(height), "frames": int(frames), "fps": fps}


def _size_of(maps: dict[str, np.ndarray]) -> dict[str, int]:
    """Return the width and height if all maps have the same; else nothing."""
    sizes = {array.shape[:2] for array in maps.values() if array.ndim >= 2}
    if len(sizes) != 1:
        return {}
    height, width = sizes.pop()
    return {"width": width, "height": height}


def _range(array: np.ndarray) -> dict[str, Any]:
    """Return how values are stored, the fraction that is valid, and their range."""
    facts: dict[str, Any] = {"dtype": str(array.dtype), "shape": list(array.shape)}
    if array.dtype.kind not in "fiu" or array.size == 0:
        return facts
    finite = array[np.isfinite(array)]
    facts["valid_share"] = finite.size / array.size
    if finite.size == 0:
        return facts
    return facts | {"min": float(finite.min()), "median": float(np.median(finite)), "max": float(finite.max())}
