"""Paths of the photos that a capture lists, and their stored sizes, for formats that do not give them."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import malformed, shown
from nerfcli.captures.orientation import Measure, stored_size
from nerfcli.photos.images import list_images

# Folders of photos beside a file of cameras, in the order of preference; the numbers are factors of reduction.
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8")

# Hints for a capture without photos, and without cameras.
GIVE_PHOTOS = "give their folder: nerfcli convert IN SCENE --to nerfcli --images FOLDER"
GIVE_CAMERA = "give the camera: nerfcli convert IN SCENE --to nerfcli --images FOLDER --intrinsics FILE"

# Returns the image files of a folder, sorted by name.
ListImages = Callable[[Path], list[Path]]


class PhotoOfStem:
    """The photos in a folder by their names without suffix, for formats that leave the suffix open.

    Args:
        images: the folder, which may be absent; None for the first of the folders `names` in `home`, or else `home`.
    """

    def __init__(self, images: Path | None, list_images: ListImages, *, home: Path, names: Sequence[str] = ()):
        places = (home / name for name in names)
        self._folder = images or next((place for place in places if place.is_dir()), home)
        photos = list_images(self._folder) if self._folder.is_dir() else []
        self._photos = {photo.stem: photo for photo in reversed(photos)}  # of a.jpg and a.png, the first
        self._any_found, self._missing = False, list[str]()

    def find(self, stem: str, *others: str) -> Path | None:
        """Return the photo with the first of these names that there is; without any, `stem` is missing."""
        image = next((self._photos[name] for name in (stem, *others) if name in self._photos), None)
        if image is None:
            self._missing.append(stem)
        self._any_found |= image is not None
        return image

    def missing(self, where: str) -> tuple[str, ...]:
        """Return the names without suffix that were not found.

        Raises:
            UserError: none was found; the message begins with `where`.
        """
        if not self._any_found:
            raise malformed(
                where,
                f"none of its {len(self._missing)} photos exists in {self._folder}, such as {shown(self._missing[0])}",
                f"the photos are needed, as they give the names; {GIVE_PHOTOS}",
            )
        return tuple(self._missing)


def seen_from(folder: Path, path: Path | None) -> str:
    """Return a path relative to a folder, with forward slashes; absolute if on another drive, empty for None."""
    if path is None:
        return ""
    try:
        return Path(os.path.relpath(path.parent.resolve() / path.name, folder.resolve())).as_posix()
    except ValueError:
        return path.absolute().as_posix()


def measured_sizes(
    names: Iterable[str], folder: Path, measure: Measure, path: Path
) -> tuple[dict[str, tuple[tuple[int, int], Path]], tuple[str, ...]]:
    """Return the width and height of each photo on disk, with its path, and the names of the missing ones.

    Args:
        names: of the photos, relative to `folder`.

    Raises:
        UserError: none of them is on disk, or one is not a readable photo.
    """
    sizes, missing = {}, []
    for name in names:
        image = folder / name
        if os.path.isfile(image):  # False, not an error, for a name that no file can have
            sizes[name] = (stored_size(image, measure), image)
        else:
            missing.append(name)
    if not sizes:
        raise malformed(
            str(path),
            f"none of the {len(missing)} listed photos exists in {folder}, such as {shown(missing[0])}",
            f"the photos are needed, as the file does not give their sizes; {GIVE_PHOTOS}",
        )
    return sizes, tuple(missing)


def with_photos(capture: Capture, *folders: Path) -> Capture:
    """Return the capture with its photos looked up in folders, by their names, file names alone, or without suffix."""
    stems = [{photo.stem: photo for photo in reversed(list_images(folder))} for folder in folders if folder.is_dir()]
    frames = []
    for frame in capture.frames:
        name = Path(frame.name).name
        paths = [*(folder / frame.name for folder in folders), *(folder / name for folder in folders)]
        named = next((path for path in paths if path.is_file()), None)
        image = named or next((photos[name] for photos in stems if name in photos), frame.image)
        frames.append(replace(frame, image=image))
    return replace(capture, frames=tuple(frames))
