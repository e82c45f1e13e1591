"""Photos in formats that cannot be read, so that they are named and not passed over."""

from pathlib import Path

from nerfcli.media.images import list_images

# What phones and cameras write and Pillow does not read.
_UNSUPPORTED_SUFFIXES = frozenset(
    {".heic", ".heif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}
)


def unsupported_photos(folder: Path) -> list[Path]:
    """Return photos of a folder itself in formats that cannot be read (HEIC, raw), sorted by name.

    A raw file is left out if the same photo stands beside it as a picture that can be read.
    """
    read = {path.stem for path in list_images(folder)}
    return sorted(
        (path for path in folder.iterdir() if path.suffix.lower() in _UNSUPPORTED_SUFFIXES and path.stem not in read),
        key=lambda path: path.name,
    )
