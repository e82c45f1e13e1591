"""Photos in formats that cannot be read, so that they are reported instead of silently skipped."""

from pathlib import Path

from nerfcli.media.images import list_images

# Formats of phones and cameras that are not read.
_UNSUPPORTED_SUFFIXES = frozenset({".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"})


def unsupported_photos(folder: Path) -> list[Path]:
    """Return the photos directly in a folder whose formats cannot be read (raw, JPEG XL), sorted by name.

    A file is left out if a readable picture of the same name, apart from the suffix, is beside it.
    """
    read = {path.stem for path in list_images(folder)}
    return sorted(
        (path for path in folder.iterdir() if path.suffix.lower() in _UNSUPPORTED_SUFFIXES and path.stem not in read),
        key=lambda path: path.name,
    )
