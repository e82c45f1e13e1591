"""Depth maps as float32 TIFF: one losslessly compressed map, with its definition as JSON in the ImageDescription."""

import json
from pathlib import Path

import numpy as np
import tifffile

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.render.files.depth_pictures import DepthMeta, check_map


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
