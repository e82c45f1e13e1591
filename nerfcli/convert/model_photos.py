"""The photos of a COLMAP model, which names them without saying where they are."""

from dataclasses import replace
from pathlib import Path

from nerfcli.cameras.formats.colmap import parse_colmap
from nerfcli.cameras.formats.llff import IMAGE_FOLDERS
from nerfcli.cameras.frame import Capture


def parse_model(path: Path, *, images: Path | None = None) -> Capture:
    """Read a COLMAP model, with its photos in the first folder in which its names lead to one.

    The folders tried are the given one (`images`); or images/ and the like in the model's folder or up to three folders
    above it, then these folders themselves.
    """
    capture = parse_colmap(path)
    homes = (path, *path.resolve().parents[:3])
    folders = [home / name for home in homes for name in IMAGE_FOLDERS if (home / name).is_dir()]
    places = [images] if images is not None else [*folders, *homes]
    leading = [place for place in places if any((place / frame.name).is_file() for frame in capture.frames[:100])]
    place = next(iter([*leading, *folders]), None)
    if place is None:
        return capture
    return replace(capture, frames=tuple(replace(frame, image=place / frame.name) for frame in capture.frames))
