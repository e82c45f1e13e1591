"""Depth maps as NumPy files: .npy with its definition beside it, .npz with the maps of a picture and their definition.

An archive holds one array per map under the names of `exr.CHANNELS` or "rgb", and "meta", the description as JSON:

    archive = np.load("a.npz"); depth = archive["depth"]; meta = json.loads(str(archive["meta"]))
"""

import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nerfcli.atomic import atomic_path, write_json
from nerfcli.errors import UserError
from nerfcli.media.depth_pictures import DepthMeta, check_map

META = "meta"

# Exceptions of NumPy for damaged files.
_DAMAGED = (
    *(OSError, ValueError, EOFError, KeyError, NotImplementedError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)


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


def write_npz(path: Path, maps: Mapping[str, np.ndarray], meta: DepthMeta) -> None:
    """Write the maps of a picture and their definition into one archive, losslessly compressed; atomic.

    Args:
        maps: float32 arrays by name: those of `exr.CHANNELS` (H, W) and rgb (H, W, 3 or 4).
        meta: the definition of the depth, or of another map if depth is not among them.

    Raises:
        UserError: the file cannot be written.
        ValueError: a map is not float32, or meta holds a number that is not finite.
    """
    for name, values in maps.items():
        check_map(values, channels=name == "rgb")
    text = np.array(meta.to_text())
    with atomic_path(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **maps, **{META: text})


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a .npz file by name, without the description, or the array of a .npy file as "array".

    Nothing in the file is run as code.

    Raises:
        UserError: the file is missing, damaged, or contains anything but numbers and text.
    """
    try:
        # Opened here, because NumPy does not close a file that it cannot read.
        with path.open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return {"array": loaded}
            with loaded:
                return {name: loaded[name] for name in loaded.files if name != META}
    except FileNotFoundError as error:
        raise UserError(f"cannot read {path}: {error.strerror}", "give a .npy or .npz file") from error
    except _DAMAGED as error:
        raise UserError(
            f"{path} is damaged or does not contain arrays of numbers: {error}", "render the depth map again"
        ) from error
