"""Depth maps as files of numbers: floats in NumPy arrays, TIFF and OpenEXR; integer levels in 16-bit PNG.

A level has a stated length, a millimetre where possible; 0 means no depth: value = level * units_per_level, rounded to
the nearest level. Nothing wraps and nothing is clipped: a depth that does not fit raises an error before a file is
written.
"""

import contextlib
import io
import math
import os
import sys
import tempfile
import threading
import tokenize
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import tifffile
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from nerfcli import __version__
from nerfcli.atomic import atomic_path, write_json
from nerfcli.errors import UserError
from nerfcli.photos.colours import linear_light
from nerfcli.render.files.depth_meta import CONVENTION_OF, KEY, DepthMeta, check_map


def write_npy(path: Path, depth: np.ndarray, meta: DepthMeta) -> None:
    """Write a map as .npy, and `meta` beside it under the same name with .json; each file atomically.

    Raises:
        ValueError: depth is not float32 (height, width), or meta holds a number that is not finite.
    """
    check_map(depth)
    # The sidecar first, so that a depth map never exists without its definition, even if the command is killed.
    write_json(path.with_suffix(".json"), meta.to_json())
    with atomic_path(path) as partial, partial.open("wb") as file:
        np.save(file, depth)


def read_npy(path: Path) -> np.ndarray:
    """Read the array of a .npy file; nothing in the file is run as code."""
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


def read_tiff(path: Path) -> np.ndarray:
    """Read the first page of a TIFF, written by any program."""
    try:
        with tifffile.TiffFile(path) as tiff:
            return tiff.pages[0].aspage().asarray()
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
    """Read every channel of the first part by its name, as stored."""
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


_CAPTURING = threading.Lock()  # the descriptor and sys.stdout belong to all threads


@contextlib.contextmanager
def _captured_stderr() -> Iterator[Callable[[], str]]:
    """Capture OpenEXR's messages about a damaged file, better than its exceptions; yield what returns the last line."""
    with _CAPTURING, tempfile.TemporaryFile() as log, contextlib.redirect_stdout(io.StringIO()):
        sys.stderr.flush()
        terminal = os.dup(2)

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


LARGEST_LEVEL = 65535
MILLIMETRE = 1e-3


def chosen_scale(largest: float, unit: str) -> float:
    """Return the finest length of a level that fits a whole clip: 1, 2 or 5 times a power of ten, in scene units.

    In metres it is never finer than a millimetre, so that files are in millimetres whenever that fits.

    Args:
        largest: the largest depth of the clip, >= 0; 0 if there is none.
        unit: "metre" or "arbitrary".

    Raises:
        ValueError: largest is not finite.
    """
    if not 0 <= largest < math.inf:
        raise ValueError(f"largest must be finite and not negative, got {largest}")
    finest = largest / LARGEST_LEVEL
    if unit == "metre":
        finest = max(finest, MILLIMETRE)
    if finest == 0:
        return 1.0
    decade = math.floor(math.log10(finest)) - 1
    # float("2e-5") is exactly the number that people write; 2 * 10.0**-5 may be the next float.
    steps = [float(f"{digit}e{power}") for power in range(decade, decade + 4) for digit in (1, 2, 5)]
    return next(step for step in steps if step >= finest * (1 - 1e-12) and largest <= LARGEST_LEVEL * step * (1 + 1e-9))


def write_png16(path: Path, depth: np.ndarray, meta: DepthMeta, *, units_per_level: float) -> None:
    """Write a depth map as 16-bit grey PNG with its definition in the text chunk "nerfcli"; atomic.

    Args:
        depth: float32 (height, width), NaN where there is none.
        meta: the definition of the values; the scale, the invalid value and the largest rounding error are added.
        units_per_level: the length of a level in the unit of `meta`, > 0.

    Raises:
        UserError: a depth does not fit into 16 bits, is negative or so small that it would read as no depth; or the
            file cannot be written.
        ValueError: depth is not float32 (height, width), units_per_level is not positive, or meta is not of a depth.
    """
    check_map(depth)
    if not 0 < units_per_level < math.inf or meta.quantity != "depth":
        raise ValueError(f"cannot write {meta.quantity} in levels of {units_per_level}")
    levels, rounding = _levels(path, depth, units_per_level)
    bounds = {**meta.error_bounds, "rounding_max": rounding}
    stated = replace(meta, invalid="0", units_per_level=units_per_level, error_bounds=bounds)
    chunks = PngInfo()
    chunks.add_text("Comment", f"{stated.in_words()}; {scale_in_words(stated)}")
    chunks.add_text(KEY, stated.to_text())
    with atomic_path(path) as partial:
        Image.fromarray(levels).save(partial, format="PNG", pnginfo=chunks)


def scale_in_words(meta: DepthMeta) -> str:
    """Describe the levels: "one level is 1 mm, 0 means no value"."""
    if meta.units_per_level is None:
        return "NaN means no value"
    if meta.unit == "metre":
        return f"one level is {meta.units_per_level / MILLIMETRE:g} mm, 0 means no value"
    return f"one level is {meta.units_per_level:g} {meta.unit} units, 0 means no value"


def depth_of_levels(levels: np.ndarray, units_per_level: float) -> np.ndarray:
    """Return float32 depth with NaN for level 0."""
    return np.where(levels == 0, np.nan, levels * units_per_level).astype(np.float32)


def _levels(path: Path, depth: np.ndarray, units_per_level: float) -> tuple[np.ndarray, float]:
    """Return uint16 levels, and the largest rounding error in the unit of the depth."""
    valid = ~np.isnan(depth)
    exact = np.where(valid, depth, 0).astype(np.float64) / units_per_level
    levels = np.rint(exact)
    if levels.max(initial=0) > LARGEST_LEVEL:
        largest, reach = float(depth[valid].max()), LARGEST_LEVEL * units_per_level
        raise UserError(
            f"{path}: 16 bits hold depth up to {reach:.6g} at {units_per_level:g} per level, but the maximum is "
            f"{largest:.6g}",
            "use a float format (--depth-format tiff)",
        )
    if (valid & (levels < 1)).any():
        smallest = float(depth[valid].min())
        raise UserError(
            f"{path}: a depth of {smallest:.6g} would become 0 (no value) in levels of {units_per_level:g}",
            "use --depth-axis ray, or a float format (--depth-format tiff)",
        )
    rounding = float(np.abs(exact - levels).max(initial=0)) * units_per_level
    return levels.astype(np.uint16), rounding
