"""Masks that select the pixels of a photo to use: white pixels are used, black ones are not.

A mask is a picture in any format, named after its photo. It has the size of the photo, either upright or as stored in
the file: tools that ignore the EXIF orientation write the latter, and the mask is then turned like the photo.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerfcli.errors import UserError
from nerfcli.photos.exif import read_exif
from nerfcli.photos.images import HEIC_SUFFIXES, IMAGE_SUFFIXES, read_image, upright

# Formats whose compression leaves artefacts around an edge, in both the black and the white areas.
_LOSSY_SUFFIXES = frozenset({".jpg", ".jpeg", ".webp"}) | HEIC_SUFFIXES
_MIDDLE = 128
_FOLDERS = ("masks", "mask")
_HINT = "resize it to the size of its photo, upright or as stored"


def find_mask(name: str, masks: Path) -> Path | None:
    """Find the mask of the photo `name` in the folder `masks`; None if it has none.

    The order of preference is photo.jpg.png (COLMAP's name), photo.png, the photo's own name, then other formats, and
    last photo_mask.png (OpenDroneMap's name) in any format.
    """
    whole, stem = masks / name, (masks / name).with_suffix("")
    named_mask = stem.with_name(f"{stem.name}_mask")
    lower = (".png", *sorted(IMAGE_SUFFIXES - {".png"}))
    suffixes = (*lower, *(suffix.upper() for suffix in lower))
    candidates = [
        whole.with_name(whole.name + ".png"),
        stem.with_name(stem.name + ".png"),
        whole,
        *(base.with_name(base.name + suffix) for base in (whole, stem, named_mask) for suffix in suffixes),
    ]
    return next(filter(os.path.isfile, candidates), None)  # names may be too long for Path.is_file


def masks_inside(folder: Path, names: Sequence[str]) -> Path | None:
    """Return folder/masks or folder/mask if it has a mask for every photo; None if neither does."""
    for masks in (folder / name for name in _FOLDERS):
        if masks.is_dir() and names and all(mask_of(name, masks) for name in names):
            return masks
    return None


def mask_of(name: str, masks: Path) -> Path | None:
    """Find the mask of a photo as `find_mask`, by the longest end of its path that has one; None if none has."""
    parts = [part for part in name.split("/") if part != ".."]  # which would lead out of the folder, to the photo
    found = (find_mask("/".join(parts[start:]), masks) for start in range(len(parts)))
    return next(filter(None, found), None)


def read_mask(path: Path, photo: Path) -> np.ndarray:
    """Read the mask of a photo.

    Args:
        path: the mask. If its largest level is 1, then 1 means white.

    Returns:
        uint8 (height, width), upright: 0 for pixels to ignore, 255 for pixels to use, values in between on edges.

    Raises:
        UserError: one of the two cannot be read, or their sizes do not match.
    """
    levels = read_image(path)[..., :3].max(axis=-1)
    exif = read_exif(photo)
    size, wanted = (levels.shape[1], levels.shape[0]), (exif.width, exif.height)
    if size != wanted and exif.orientation >= 5 and size == wanted[::-1]:
        levels = upright(levels, exif.orientation)
    elif size != wanted:
        raise UserError(f"{path} is {size[0]}x{size[1]}, but its photo is {wanted[0]}x{wanted[1]}", _HINT)
    if path.suffix.lower() in _LOSSY_SUFFIXES:
        return np.where(levels >= _MIDDLE, np.uint8(255), np.uint8(0))
    return levels * np.uint8(255) if levels.max() == 1 else levels
