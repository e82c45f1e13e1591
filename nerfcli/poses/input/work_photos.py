"""Lay out the photos for the worker: upright, under permanent numbers, repeating only what has changed."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from PIL import Image

from nerfcli.photos.images import read_image
from nerfcli.poses.input.photos import Photo, Photos
from nerfcli.poses.input.stages import file_key, read_stage, write_stage

# Formats that pycolmap reads as we do, if stored upright. For all others (CMYK, 16 bit, alpha, TIFF) it gets JPEGs.
_PLAIN = {("JPEG", ".jpg"), ("JPEG", ".jpeg"), ("MPO", ".jpg"), ("MPO", ".jpeg"), ("PNG", ".png")}
# Change this whenever copies are made differently.
_VERSION = "JPEG 97"


@dataclass(frozen=True)
class WorkPhoto:
    """A photo's file below work/photos, whose stem is its number, and a hash of the original's content."""

    file: str
    key: str


def lay_out(photos: Photos, work: Path) -> tuple[WorkPhoto, ...]:
    """Give the worker each photo, upright, under its number: a link if the file can be used directly, else a copy.

    A photo keeps the number that it got when it was first laid out, and numbers are not reused, so that stored results
    stay with their photo when others are added or removed.
    """
    folder, stage = work / "photos", work / "photos.json"
    folder.mkdir(parents=True, exist_ok=True)
    content = read_stage(stage, _VERSION) or {"next": 0, "photos": {}}
    earlier = {name: WorkPhoto(**laid_out) for name, laid_out in content["photos"].items()}
    following = content["next"]
    numbers: dict[str, int] = {}
    for photo in photos.photos:
        if photo.name in earlier:
            numbers[photo.name] = int(Path(earlier[photo.name].file).stem)
        else:
            numbers[photo.name], following = following, following + 1

    def lay_out_one(photo: Photo) -> WorkPhoto:
        return _laid_out(photos.folder, photo, folder, number=numbers[photo.name], earlier=earlier.get(photo.name))

    with ThreadPoolExecutor(4) as copiers:  # each holds a decoded photo in memory
        laid_out = tuple(copiers.map(lay_out_one, photos.photos))
    listed = {photo.name: asdict(found) for photo, found in zip(photos.photos, laid_out, strict=True)}
    write_stage(stage, _VERSION, {"next": following, "photos": listed})
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
