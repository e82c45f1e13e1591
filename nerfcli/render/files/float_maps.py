"""Depth maps as files of floating-point numbers: NumPy arrays, TIFF and OpenEXR."""

import contextlib
import io
import json
import os
import sys
import tempfile
import tokenize
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import OpenEXR
import tifffile

from nerfcli.atomic import atomic_path, write_json
from nerfcli.errors import UserError
from nerfcli.photos.colours import linear_light
from nerfcli.render.files.depth_pictures import CONVENTION_OF, KEY, DepthMeta, check_map
from nerfcli.version import __version__


def write_npy(path: Path, depth: np.ndarray, meta: DepthMeta) -> None:
    """Write a map as .npy, and `meta` beside it under the same name with .json; each file atomically.

    Raises:
        UserError: a file cannot be written.
        ValueError: depth is not float32 (height, width), or meta holds a number that is not finite.
    """
    check_map(depth)
    # The sidecar first, so that a depth map never exists without its definition, even if the command is killed.
    write_json(path.with_suffix(".json"), meta.to_json())
    with atomic_path(path) as partial, partial.open("wb") as file:
        np.save(file, depth)


def read_npy(path: Path) -> np.ndarray:
    """Read the array of a .npy file; nothing in the file is run as code.

    Raises:
        UserError: the file is missing, damaged, or contains anything but numbers and text.
    """
    try:
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    except FileNotFoundError as error:
        raise UserError(f"cannot read {path}: {error.strerror}", "give a .npy file") from error
    except (OSError, ValueError, EOFError, tokenize.TokenError) as error:
        raise UserError(
            f"{path} is damaged or does not contain an array of numbers: {error}", "render the depth map again"
        ) from error


def write_tiff(path: Path, depth: np.ndarray, meta: DepthMeta) -> None:
    """Write a depth map as float TIFF; atomic.

    Args:
        depth: float32 (height, width); every bit is preserved, including NaN.

    Raises:
        UserError: the file cannot be written.
        ValueError: depth is not float32 (height, width), or meta holds a number that is not finite.
    """
    check_map(depth)
    description = meta.to_text()  # only ASCII, as the tag requires
    with atomic_path(path) as partial:
        tifffile.imwrite(
            partial,
            depth,
            photometric="minisblack",
            compression="zlib",
            compressionargs={"level": 1},  # more takes twice the time and saves 0.5 %: the lower bits are noise
            description=description,
            metadata=None,  # else tifffile appends a description of its own
        )


def read_tiff(path: Path) -> tuple[np.ndarray, DepthMeta]:
    """Read a file of `write_tiff`: the depth, float32 (height, width), and its definition.

    Raises:
        UserError: the file is missing, damaged, not a float32 map, or does not describe its convention.
    """
    depth, description = read_any_tiff(path)
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise UserError(
            f"{path} contains {depth.dtype} {depth.shape}, not a float32 depth map",
            "give a file that nerfcli wrote",
        )
    try:
        return depth, DepthMeta.from_json(json.loads(description))
    except ValueError as error:
        raise UserError(
            f"{path} does not state its definition of depth (ImageDescription: {description[:40]!r})",
            "give a file that nerfcli wrote",
        ) from error


def read_any_tiff(path: Path) -> tuple[np.ndarray, str]:
    """Read the first page of a TIFF and its ImageDescription, written by any program.

    Raises:
        UserError: missing or damaged.
    """
    try:
        with tifffile.TiffFile(path) as tiff:
            page = tiff.pages[0].aspage()
            return page.asarray(), page.description
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}", "give a depth TIFF") from error
    except Exception as error:  # tifffile passes on any exception of its decoders
        raise UserError(f"{path} is damaged or not a TIFF file: {error}", "render the depth map again") from error


CHANNELS = {"depth": "Z", **{name: f"{name}.V" for name in ("opacity", *CONVENTION_OF)}}


def write_exr(path: Path, maps: Mapping[str, np.ndarray], meta: DepthMeta) -> None:
    """Write the maps of a picture into one file, losslessly compressed; atomic.

    Args:
        maps: float32 arrays by name: those of `CHANNELS` (H, W), every bit of which is preserved, and rgb
            (H, W, 3 or 4), sRGB in [0, 1] with straight alpha.
        meta: the definition of the depth, or of another map if depth is not among them.

    Raises:
        UserError: the file cannot be written.
        ValueError: a map is not float32, or meta holds a number that is not finite.
    """
    channels: dict[str, np.ndarray] = {}
    for name, values in maps.items():
        check_map(values, channels=name == "rgb")
        if name == "rgb":
            channels |= _colour_channels(values)
        else:
            channels[CHANNELS[name]] = np.ascontiguousarray(values)
    if "Z" in channels and "R" not in channels:
        channels["Y"] = channels["Z"]
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": f"nerfcli {__version__}",
        "comments": meta.in_words(),
        KEY: meta.to_text(),
    }
    encoded = io.BytesIO()  # OpenEXR's own write errors do not say what is wrong with the disk
    OpenEXR.File(header, channels).write(encoded)
    with atomic_path(path) as partial:
        partial.write_bytes(encoded.getbuffer())


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """Read every channel of the first part by its name, as stored.

    Raises:
        UserError: missing or damaged.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}", "give an OpenEXR file") from error
    with _captured_stderr() as message:
        try:
            file = OpenEXR.File(io.BytesIO(content), separate_channels=True)
            return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        except (RuntimeError, ValueError, TypeError) as error:
            reason = message() or str(error)
            raise UserError(
                f"{path} is damaged or not an OpenEXR file: {reason}", "render the picture again"
            ) from error


@contextlib.contextmanager
def _captured_stderr() -> Iterator[Callable[[], str]]:
    """Capture OpenEXR's messages about a damaged file, better than its exceptions; yield what returns the last line."""
    sys.stderr.flush()
    terminal = os.dup(2)
    with tempfile.TemporaryFile() as log, contextlib.redirect_stdout(io.StringIO()):

        def last_line() -> str:
            log.seek(0)
            lines = log.read().decode("utf-8", errors="replace").strip().splitlines()
            return lines[-1].rpartition(") ")[2] if lines else ""

        os.dup2(log.fileno(), 2)
        try:
            yield last_line
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)


def _colour_channels(srgb: np.ndarray) -> dict[str, np.ndarray]:
    """Return R, G, B in linear light and, if there is alpha, A, by which they are then multiplied."""
    linear = linear_light(srgb[..., :3])
    if srgb.shape[2] == 3:
        return {name: np.ascontiguousarray(linear[..., index]) for index, name in enumerate("RGB")}
    alpha = srgb[..., 3]
    colours = {name: linear[..., index] * alpha for index, name in enumerate("RGB")}
    return colours | {"A": np.ascontiguousarray(alpha)}
