"""Find the photos that a capture lists, and measure their stored sizes, for formats that do not give them."""

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from nerfcli.cameras.formats.fields import malformed, shown
from nerfcli.cameras.orientation import Measure, stored_size
from nerfcli.errors import UserError


class PhotoOfStem:
    """The photos in a folder by their names without suffix, for formats that leave the suffix open.

    Args:
        folder: the folder; it may be absent.
        list_images: returns the image files of a folder, sorted by name.
    """

    def __init__(self, folder: Path, list_images: Callable[[Path], list[Path]]):
        self.folder = folder
        photos = list_images(folder) if folder.is_dir() else []
        self._photos = {photo.stem: photo for photo in reversed(photos)}  # of a.jpg and a.png, the first

    def find(self, *stems: str) -> Path | None:
        """Return the photo with the first of these names that there is."""
        return next((self._photos[stem] for stem in stems if stem in self._photos), None)


def photos_missing(names: Sequence[str], folder: Path, where: str) -> UserError:
    """Create the error for a capture without any of its photos; `names` lists them without suffix."""
    return malformed(
        where,
        f"none of its {len(names)} photos exists in {folder}, such as {shown(names[0])}",
        "the photos are needed, as they give the names; give their folder with --images",
    )


def measured_sizes(
    names: Iterable[str], folder: Path, measure: Measure, path: Path
) -> tuple[dict[str, tuple[tuple[int, int], Path]], tuple[str, ...]]:
    """Return the width and height of each photo on disk, with its path, and the names of the missing ones.

    Args:
        names: of the photos, relative to `folder`.
        measure: returns an image's upright size and EXIF orientation.
        path: the file that lists them, for the error.

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
            "the file does not give image sizes, so the photos are needed, with the listed names",
        )
    return sizes, tuple(missing)
