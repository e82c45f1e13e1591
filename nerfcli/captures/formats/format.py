"""What a format of captures is: how it is recognised, parsed and written, and what it cannot hold.

Each format is a file of this folder with one `Format` at its end; `registry` lists them. A folder is recognised by the
names of files in it, a file by its suffix and its beginning.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import check_unique_names, malformed, opened, read_json_object, shown
from nerfcli.errors import UserError


@dataclass(frozen=True)
class UserInputs:
    """Additional input of the user besides the capture's own files.

    Args:
        images: the folder of the photos, to which names are relative.
        camera: the camera of all frames, for formats without cameras.
        masks: a folder of masks named after the photos, see `photos.masks.mask_of`.
    """

    images: Path | None = None
    camera: Camera | None = None
    masks: Path | None = None


@dataclass(frozen=True)
class Format:
    """A format of captures.

    Args:
        of: what it is, or which programs write it.
        find: returns where such a capture is in a file or folder; None if there is none.
        read: reads what `find` found, or what `write` wrote, with the further input of the user; what is damaged is a
            `UserError` that names file and field.
        axes: the camera axes of its poses, as three letters or a name.
        open_axes: whether poses with other axes are found in such files, so that --axes makes sense.
        open_centre: whether principal points with other pixel centres are found in such files.
        default_name: the name of its file if the target is a folder; "" for formats that fill a folder.
        files: the names of all files that it may write or replace; "*" stands for that file's name without its suffix.
        lacks: which of "cameras", "poses" and "points" it has no place for.
        takes_camera: whether the user may give the camera of the frames.
        is_unordered: whether the order of frames in its files means nothing, so that photos are sorted by name.
        has_split: whether its files say which photos are held out, for all photos.
        unused_splits: splits whose photos are neither for training nor for evaluation.
        listed_by: the order of frames in its files, as a key to sort by; by default, that of the capture.
        write: writes a capture, each file atomically; what cannot be held or written is a `UserError`.
        losses: lists what a file cannot hold. Both are None for formats that are only read.
        video: returns the video whose frames are the photos of what `find` found; None where the photos are files.
    """

    name: str
    of: str
    find: Callable[[Path], Path | None]
    read: Callable[[Path, UserInputs], Capture]
    axes: str = "opencv"
    open_axes: bool = False
    open_centre: bool = False
    default_name: str = ""
    files: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    takes_camera: bool = False
    is_unordered: bool = False
    has_split: bool = False
    unused_splits: tuple[str, ...] = ()
    listed_by: Callable[[Frame], Any] = lambda frame: 0
    write: Callable[[Capture, Path], None] | None = None
    losses: Callable[[Capture], tuple[str, ...]] | None = None
    video: Callable[[Path], Path | None] = lambda path: None

    def parse(self, found: Path, given: UserInputs = UserInputs()) -> Capture:
        """Read what `find` found, or what `write` wrote.

        Raises:
            UserError: it cannot be read, it has no frames, or two frames have one name or photo.
        """
        capture = self.read(found, given)
        if "poses" not in self.lacks:
            check_unique_names((frame.name for frame in capture.frames), found)
            _check_unique_photos(capture, found)
        return capture


def _check_unique_photos(capture: Capture, found: Path) -> None:
    """Check that no photo has two cameras, under names such as a.jpg and x/../a.jpg."""
    names: dict[str, str] = {}
    for frame in capture.frames:
        other = names.setdefault(os.path.abspath(frame.image), frame.name) if frame.image else frame.name
        if other != frame.name and frame.has_photo:
            what = f"{shown(other)} and {shown(frame.name)} are the same photo"
            raise malformed(found, what, "remove one of these two entries")


def named(*names: str) -> Callable[[Path], Path | None]:
    """Return a finder of the first of these files in a folder."""

    def find(path: Path) -> Path | None:
        return next((path / name for name in names if (path / name).is_file()), None)

    return find


def by_suffix(suffix: str, *names: str) -> Callable[[Path], Path | None]:
    """Return a finder of a file by its suffix, or of the first of these files in a folder."""
    in_folder = named(*names)
    return lambda path: path if path.is_file() and path.suffix.lower() == suffix else in_folder(path)


def folder_with(*names: str) -> Callable[[Path], Path | None]:
    """Return a finder of the folder that holds all of these files, given the folder or one of them."""

    def find(path: Path) -> Path | None:
        folder = path.parent if path.is_file() and path.name in names else path
        return folder if all((folder / name).is_file() for name in names) else None

    return find


def only_file(folder: Path, pattern: str, begins: str) -> Path | None:
    """Return the file in a folder that matches a pattern and begins with a text, if there is only one."""
    found = [path for path in sorted(folder.glob(pattern)) if path.is_file() and _begins_with(path, begins)]
    return found[0] if len(found) == 1 else None


def _begins_with(path: Path, text: str) -> bool:
    with opened(path) as stream:
        return stream.read(len(text)) == text


def find_json(path: Path, *, opening: str, name: str) -> Path | None:
    """Find a JSON file that begins with a bracket or a brace, or the one with this name in a folder."""
    if not path.is_file():
        return path / name if (path / name).is_file() else None
    if path.suffix.lower() != ".json":
        return None
    with opened(path) as stream:
        return path if stream.read(1000).lstrip().startswith(opening) else None


def has_keys(path: Path, *keys: str) -> bool:
    """Return whether a file is a JSON object with these keys; it is parsed only if it contains the first of them."""
    try:
        letters = path.read_bytes().replace(b"\0", b"")  # of UTF-16, too
        return f'"{keys[0]}"'.encode() in letters and set(keys) <= set(read_json_object(path))
    except UserError:  # damaged, or another program's file of this name
        return False
