"""Depth maps as NumPy files: .npy with its definition beside it."""

import tokenize
from pathlib import Path

import numpy as np

from nerfcli.atomic import atomic_path, write_json
from nerfcli.errors import UserError
from nerfcli.render.files.depth_pictures import DepthMeta, check_map


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
