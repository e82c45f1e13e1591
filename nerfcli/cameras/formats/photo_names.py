"""Measure the stored sizes of the photos that a capture lists, for formats that do not give them."""

import os
from collections.abc import Iterable
from pathlib import Path

from nerfcli.cameras.formats.fields import malformed, shown
from nerfcli.cameras.orientation import Measure, stored_size


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
