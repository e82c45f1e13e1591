"""Photos of a folder or of its subfolders: their names, and the files in formats that cannot be read."""

from pathlib import Path

from nerfcli.media.images import IMAGE_SUFFIXES, list_images

# Formats of phones and cameras that are not read.
_UNSUPPORTED_SUFFIXES = frozenset({".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"})


def list_photos(folder: Path, *, subfolders: bool = False) -> list[Path]:
    """Return the picture files directly in a folder and, on request, in all of its subfolders, sorted by `name_in`.

    Raises:
        UserError: see `list_images`.
    """
    paths = [path for each in _folders(folder, subfolders=subfolders) for path in list_images(each)]
    return sorted(paths, key=lambda path: name_in(folder, path))


def list_unsupported(folder: Path, *, subfolders: bool = False) -> list[Path]:
    """Return the photos in formats that cannot be read (raw, JPEG XL), as `list_photos` does.

    A file is left out if a readable picture of the same name, apart from the suffix, is beside it.
    """
    paths = [path for each in _folders(folder, subfolders=subfolders) for path in _unsupported(each)]
    return sorted(paths, key=lambda path: name_in(folder, path))


def name_in(folder: Path, path: Path) -> str:
    """Return the name of a photo: its path from the folder of photos, with forward slashes."""
    return path.relative_to(folder).as_posix()


def where_photos_may_be(folder: Path) -> str:
    """Return a hint for a folder without photos: which of its subfolders have some, or what is expected."""
    with_photos = [child for child in sorted(folder.iterdir()) if child.is_dir() and list_images(child)]
    if len(with_photos) == 1:
        return f"there are photos in {with_photos[0]}; give that folder"
    if with_photos:
        more = f" and {len(with_photos) - 1} more folders" if len(with_photos) > 2 else f" and {with_photos[1]}"
        return f"there are photos in {with_photos[0]}{more}; give one of them, or use all with --subfolders"
    return f"expected files ending in {', '.join(sorted(IMAGE_SUFFIXES))}"


def _folders(folder: Path, *, subfolders: bool) -> list[Path]:
    """Return a folder and, on request, all of its subfolders; hidden ones are left out."""
    if not subfolders:
        return [folder]
    below = (path for path in folder.rglob("*") if path.is_dir())
    return [folder, *(path for path in below if not any(p.startswith(".") for p in path.relative_to(folder).parts))]


def _unsupported(folder: Path) -> list[Path]:
    read = {path.stem for path in list_images(folder)}
    files = (path for path in folder.iterdir() if not path.name.startswith("."))
    return [path for path in files if path.suffix.lower() in _UNSUPPORTED_SUFFIXES and path.stem not in read]
