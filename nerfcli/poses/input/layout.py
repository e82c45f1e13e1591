"""Lay out the photos and masks for the worker: upright, under permanent numbers, repeating only what has changed."""

import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from nerfcli.errors import UserError, listed, several
from nerfcli.photos.images import read_image
from nerfcli.photos.masks import find_mask, read_mask
from nerfcli.poses.input.job import WorkMask, file_key, read_stage, stage_key, write_stage
from nerfcli.poses.input.photos import Photo, Photos

# Formats that pycolmap reads as we do, if stored upright. For all others (CMYK, 16 bit, alpha, TIFF) it gets JPEGs.
_PLAIN = {("JPEG", ".jpg"), ("JPEG", ".jpeg"), ("MPO", ".jpg"), ("MPO", ".jpeg"), ("PNG", ".png")}
# Change this whenever copies are made differently.
_VERSION = "JPEG 97"
_THREADS = 4  # each holds a decoded photo in memory


@dataclass(frozen=True)
class WorkPhoto:
    """A photo's file below work/photos, whose stem is its number, and a hash of the original's content."""

    file: str
    key: str


def lay_out_photos(photos: Photos, work: Path) -> tuple[WorkPhoto, ...]:
    """Give the worker each photo, upright, under its number: a link if the file can be used directly, else a copy.

    A photo keeps the number that it got when it was first laid out, and numbers are not reused, so that stored results
    stay with their photo when others are added or removed.
    """
    folder, stage = work / "photos", work / "photos.json"
    folder.mkdir(parents=True, exist_ok=True)
    content = read_stage(stage, _VERSION) or {"next": 0, "photos": {}}
    earlier = {name: WorkPhoto(**laid_out) for name, laid_out in content["photos"].items()}
    new = [name for name in photos.names if name not in earlier]
    numbers = {name: int(Path(found.file).stem) for name, found in earlier.items()}
    numbers |= {name: number for number, name in enumerate(new, start=content["next"])}

    def lay_out_one(photo: Photo) -> WorkPhoto:
        return _laid_out(photos.folder, photo, folder, number=numbers[photo.name], earlier=earlier.get(photo.name))

    with ThreadPoolExecutor(_THREADS) as copiers:
        laid_out = tuple(copiers.map(lay_out_one, photos.photos))
    listed = {photo.name: asdict(found) for photo, found in zip(photos.photos, laid_out, strict=True)}
    write_stage(stage, _VERSION, {"next": content["next"] + len(new), "photos": listed})
    return laid_out


def _laid_out(photos: Path, photo: Photo, folder: Path, *, number: int, earlier: WorkPhoto | None) -> WorkPhoto:
    original = (photos / photo.name).absolute()
    key = file_key(original)
    plain = _is_plain(original, photo)
    laid_out = WorkPhoto(f"{number:05d}{original.suffix.lower() if plain else '.jpg'}", key)
    target = folder / laid_out.file
    if earlier == laid_out and target.exists() and not (target.is_symlink() and target.readlink() != original):
        return laid_out
    partial = folder / f".{laid_out.file}"
    partial.unlink(missing_ok=True)
    if plain:
        try:
            partial.symlink_to(original)
        except OSError:  # Windows without the right to make links
            shutil.copyfile(original, partial)
    else:
        Image.fromarray(read_image(original)).convert("RGB").save(partial, "JPEG", quality=97, subsampling=0)
    os.replace(partial, target)
    return laid_out


def _is_plain(path: Path, photo: Photo) -> bool:
    with Image.open(path) as image:
        as_stored = (image.format, path.suffix.lower()) in _PLAIN and image.mode in ("L", "RGB")
    return as_stored and photo.exif.orientation == 1


def lay_out_masks(
    photos: Photos, files: Sequence[str], masks: Path, *, folder: Path, notify: Callable[[str], None]
) -> tuple[WorkMask, ...]:
    """Write the mask of each photo that has one, upright: 00000.jpg.png for the photo 00000.jpg, black where not used.

    `files` are the photos' names below the worker's folder of photos, `masks` is the user's folder.

    Raises:
        UserError: as for `find_masks`, or masks that cannot be read or do not fit.
    """
    found = find_masks(photos, masks)
    folder.mkdir(parents=True, exist_ok=True)

    def one(index: int) -> WorkMask | str:
        path = found[index]
        if path is None:
            return WorkMask()
        try:
            used = read_mask(path, photos.folder / photos.names[index]) > 0
        except UserError as error:
            return error.message
        return write_mask(folder / f"{files[index]}.png", used)

    with ThreadPoolExecutor(_THREADS) as readers:
        laid_out = list(readers.map(one, range(len(found))))
    wrong = [text for text in laid_out if isinstance(text, str)]
    if wrong:
        hint = "use pictures of the size of their photos, upright or as stored; black is ignored"
        raise UserError(f"{several(len(wrong), 'mask')} cannot be used: {listed(wrong)}", hint)
    without = [name for name, mask in zip(photos.names, found, strict=True) if mask is None]
    if without:
        notify(f"{len(without)} of {len(photos.names)} photos have no mask and are used completely: {listed(without)}")
    done = tuple(mask for mask in laid_out if isinstance(mask, WorkMask))
    hidden = [name for name, mask in zip(photos.names, done, strict=True) if mask.used_fraction == 0]
    if hidden:
        notify(f"photos whose masks are completely black are not used ({len(hidden)}): {listed(hidden)}")
    return done


def write_mask(path: Path, used: np.ndarray) -> WorkMask:
    """Write a mask from the used pixels of the upright photo, bool (height, width)."""
    Image.fromarray(used).save(path)
    return WorkMask(stage_key(used.shape, np.packbits(used).tobytes().hex()), float(used.mean()))


def find_masks(photos: Photos, masks: Path) -> list[Path | None]:
    """Find the mask of each photo in the user's folder.

    Raises:
        UserError: no mask in it for any photo, or the photos themselves.
    """
    folder = photos.folder.resolve()
    inside = [name for name in photos.names if (folder / name).is_relative_to(masks.resolve())]
    if inside and masks.resolve().is_relative_to(folder):  # a folder above that of the photos may have the masks
        raise UserError(
            f"{masks} contains photos, such as {inside[0]}",
            "put the masks into a separate folder, outside of that of the photos",
        )
    found = [find_mask(name, masks) for name in photos.names]
    if not any(found):
        raise UserError(
            f"{masks} contains no mask for any photo of {photos.folder}",
            f"name them after the photos: {photos.names[0]}.png or {Path(photos.names[0]).stem}.png",
        )
    return found
