"""Projections that are stored as pictures: numbered files, or pages of a TIFF."""

import glob
import re
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path
from tokenize import TokenError

import numpy as np

from nerfcli.errors import UserError, listed

SUFFIXES = (".tif", ".tiff", ".png", ".bmp")


def numbered(folder: Path, pattern: str = "*", *, without: str | None = None) -> list[Path]:
    """Return the pictures in a folder whose names match a pattern, in the order of the last number in their names.

    Args:
        pattern: shell pattern of the file names.
        without: regular expression of names to skip.

    Raises:
        UserError: a number between the first and the last one is missing, or is listed twice.
    """
    paths = [
        path
        for path in sorted(folder.glob("*"))  # a stated name with a slash is no pattern that glob takes
        if fnmatch(path.name, pattern)
        and path.suffix.lower() in SUFFIXES
        and not (without and re.search(without, path.name, re.IGNORECASE))
    ]
    numbers = [re.findall(r"\d+", path.stem) for path in paths]
    if len(paths) < 2 or not all(numbers):
        return paths
    present = [int(found[-1]) for found in numbers]
    twice = sorted(paths[k].name for k in range(len(present)) if present.count(present[k]) > 1)
    if twice:
        raise UserError(
            f"{folder} has several pictures with the same number: {listed(twice)}",
            "keep the projections of each scan in a folder of their own",
        )
    steps = np.diff(sorted(present))
    if (steps != np.median(steps)).any():
        first = sorted(present)[int(np.argmax(steps != np.median(steps)))]
        raise UserError(
            f"{folder}: after number {first} the numbering of the pictures has a gap",
            "a projection is missing; without it the angles of the others are wrong",
        )
    return [path for _, path in sorted(zip(present, paths, strict=True))]


def stated_projections(
    file: Path, folder: Path, stem: str, counts: Sequence[int], *, without: str | None = None
) -> list[Path]:
    """Return the pictures named after a stem, or else all; raise unless their number is one of `counts`, as stated."""
    paths = numbered(folder, f"{glob.escape(stem)}*", without=without) or numbered(folder, without=without)
    if not paths or len(paths) not in counts:
        raise UserError(
            f"{folder} holds {len(paths)} projections; {file.name} states {counts[0]}",
            f"expected all of the numbered pictures, whose names begin with {stem}",
        )
    return paths


def read_stack(paths: Sequence[Path]) -> np.ndarray:
    """Read pictures as (views, rows, columns) float32, with all pages of TIFF files and without scaling the values.

    Raises:
        UserError: a picture cannot be read, has colours, or differs in size from the first.
    """
    frames: list[np.ndarray] = []
    for path in paths:
        for frame in _pages(path):
            if frames and frame.shape != frames[0].shape:
                raise UserError(
                    f"{path} has {frame.shape[1]} x {frame.shape[0]} pixels, the first projection "
                    f"{frames[0].shape[1]} x {frames[0].shape[0]}",
                    "all projections of a scan have the same size: remove other pictures",
                )
            frames.append(frame)
    return np.stack(frames)


def read_npy(path: Path, *, hint: str) -> np.ndarray:
    """Read the array of a .npy file; `hint` says what to do where it is missing or damaged."""
    try:
        return np.load(path, allow_pickle=False)
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist", hint) from error
    except (OSError, ValueError, EOFError, SyntaxError, TokenError) as error:
        raise UserError(f"{path} cannot be read: {error}", hint) from error


def _pages(path: Path) -> np.ndarray:
    """Read one picture as (pages, rows, columns) float32."""
    try:
        if path.suffix.lower() in (".tif", ".tiff"):
            import tifffile

            array = tifffile.imread(path)
        else:
            import cv2

            read = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
            if read is None:
                raise ValueError("no picture that OpenCV knows")
            array = np.asarray(read)
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist", "it is listed in the description of the scan: restore it") from error
    except Exception as error:  # tifffile raises what its decoders raise
        raise UserError(f"{path} cannot be read: {error}", "it is damaged or not a picture: export it again") from error
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[-1] in (3, 4):
        raise UserError(f"{path} has the shape {array.shape}", "projections are grey: rows x columns, or pages of them")
    return array.astype(np.float32)
