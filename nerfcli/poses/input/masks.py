"""Masks for feature extraction: found by the photos' names, checked, and laid out for the worker."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image

from nerfcli.errors import UserError, listed
from nerfcli.photos.masks import find_mask, read_mask
from nerfcli.poses.input.job import WorkMask
from nerfcli.poses.input.photos import Photos
from nerfcli.poses.input.stages import stage_key

_READERS = 4


def lay_out_masks(
    photos: Photos, files: Sequence[str], masks: Path, *, folder: Path, notify: Callable[[str], None]
) -> tuple[WorkMask, ...]:
    """Write a mask for each photo, upright, for pycolmap: 00000.jpg.png for the photo 00000.jpg, black where not used.

    `files` are the photos' names below the worker's folder of photos, `masks` is the user's folder.

    Raises:
        UserError: no such folder, no mask in it for any photo, or masks that cannot be read or do not fit.
    """
    _check_folder(photos, masks)
    found = [find_mask(name, masks) for name in photos.names]
    if not any(found):
        raise UserError(
            f"{masks} contains no mask for any photo of {photos.folder}",
            f"name them after the photos: {photos.names[0]}.png or {Path(photos.names[0]).stem}.png",
        )
    folder.mkdir(parents=True, exist_ok=True)

    def one(index: int) -> WorkMask | str:
        path, photo = found[index], photos.photos[index]
        if path is None:
            return write_no_mask(folder / f"{files[index]}.png", (photo.width, photo.height))
        try:
            used = read_mask(path, photos.folder / photo.name) > 0
        except UserError as error:
            return error.message
        return write_mask(folder / f"{files[index]}.png", used)

    with ThreadPoolExecutor(_READERS) as readers:
        laid_out = list(readers.map(one, range(len(found))))
    wrong = [text for text in laid_out if isinstance(text, str)]
    if wrong:
        hint = "masks must have the size of their photos, upright or as stored; black is ignored"
        raise UserError(f"{len(wrong)} masks have the wrong size: {listed(wrong)}", hint)
    without = [name for name, mask in zip(photos.names, found, strict=True) if mask is None]
    if without:
        notify(f"{len(without)} of {len(photos.names)} photos have no mask and are used completely: {listed(without)}")
    done = tuple(mask for mask in laid_out if isinstance(mask, WorkMask))
    hidden = [name for name, mask in zip(photos.names, done, strict=True) if mask.used_fraction == 0]
    if hidden:
        notify(f"{len(hidden)} masks are completely black, so their photos are not used: {listed(hidden)}")
    return done


def write_mask(path: Path, used: np.ndarray) -> WorkMask:
    """Write a mask for pycolmap from the used pixels of the upright photo, bool (height, width)."""
    Image.fromarray(used).save(path)
    return WorkMask(stage_key(used.shape, np.packbits(used).tobytes().hex()), float(used.mean()))


def write_no_mask(path: Path, size: tuple[int, int]) -> WorkMask:
    """Write a white mask for a photo of (width, height), since pycolmap leaves out a photo whose mask is missing."""
    Image.new("1", size, 1).save(path)
    return WorkMask()


def _check_folder(photos: Photos, masks: Path) -> None:
    if not masks.is_dir():
        raise UserError(f"the mask folder {masks} does not exist", "give a folder with a mask for each photo")
    folder = photos.folder.resolve()
    inside = [name for name in photos.names if (folder / name).is_relative_to(masks.resolve())]
    if inside and masks.resolve().is_relative_to(folder):  # a folder above that of the photos may have the masks
        raise UserError(
            f"{masks} contains photos, such as {inside[0]}",
            "put the masks into a separate folder, outside of that of the photos",
        )
