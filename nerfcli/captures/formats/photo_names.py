"""Find the photos on disk that a capture lists by name, in one way for all formats.

Captures are moved, copied and converted: names have separators of another system, absolute paths of another machine,
letters of another case or suffixes of another format, and the folder of the photos has another name. `find_photos`
finds a photo that is meant beyond doubt, and says what it did.
"""

import filecmp
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from nerfcli.cameras.frame import Size
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import malformed, shown
from nerfcli.captures.formats.photo_search import OTHER_FOLDERS, Name, Place, Search, places_of, search_of
from nerfcli.errors import UserError, several

# Hints for a capture without photos, and without cameras.
GIVE_PHOTOS = "give their folder: nerfcli convert IN SCENE --to nerfcli --images FOLDER"
GIVE_CAMERA = "give the camera: nerfcli convert IN SCENE --to nerfcli --images FOLDER --intrinsics FILE"


@dataclass(frozen=True)
class FoundPhotos:
    """The photos that names lead to; all sequences are in the order of the names.

    Args:
        listed: the names as the capture has them.
        names: the names with forward slashes; of an absolute path, the path in `folder`, or the file's name.
        paths: the photos; None for those that are missing.
        folder: the folder that the photos are in, or should be in; None if there is no folder of photos.
        notes: what was done to find them, each a line for people.
    """

    listed: tuple[str, ...]
    names: tuple[str, ...]
    paths: tuple[Path | None, ...]
    folder: Path | None
    notes: tuple[str, ...]

    @property
    def places(self) -> tuple[Path | None, ...]:
        """The photos; of those that are missing, where they should be, or None without a folder of photos."""
        inside = ([part for part in PurePosixPath(name).parts if part != ".."] for name in self.names)
        expected = (None if self.folder is None else self.folder.joinpath(*parts) for parts in inside)
        return tuple(path or place for path, place in zip(self.paths, expected, strict=True))

    @property
    def missing(self) -> tuple[str, ...]:
        """The names of photos that are not on disk."""
        return tuple(name for name, path in zip(self.listed, self.paths, strict=True) if path is None)

    def required(self, capture: Path) -> "FoundPhotos":
        """Return these photos, for a format that cannot do without them: some must be on disk."""
        if self.listed and not any(self.paths):
            raise malformed(
                capture,
                f"none of the {len(self.listed)} listed photos exists in {self.folder}, such as "
                f"{shown(self.listed[0])}",
                f"the photos are needed, as the capture lacks some of their names or sizes; {GIVE_PHOTOS}",
            )
        return self


def find_photos(
    listed: Sequence[str],
    homes: Sequence[Path],
    *,
    given: Path | None = None,
    folders: Sequence[str] = ("images",),
    others: Sequence[str] = OTHER_FOLDERS,
    sizes: Sequence[Size | None] | None = None,
) -> FoundPhotos:
    r"""Find the photos of a capture by the names that it lists, with or without suffix.

    All photos come from one folder: the one whose photos have the shape of the cameras, and then, that has most of
    them. In a folder, a photo is the one with the longest common end of its path, where separators and the case of
    letters mean nothing, then with the same suffix, then with the same case. Parts of a name are left out if it is an
    absolute path, or if only they, or only parts of the file's path, remain. With another suffix, or in a folder other
    than `folders` and `homes`, only photos that have the shape of their camera are found.

    Example:
        >>> found = find_photos(["C:\\trip\\images\\IMG_1.JPG"], [Path("capture")], sizes=[(4000, 3000)])
        >>> found.paths, found.notes  # with capture/images_4/img_1.jpg of 1000 x 750 pixels
        ((PosixPath('capture/images_4/img_1.jpg'),),
         ('1 photo found under another name: images_4/img_1.jpg for C:\\trip\\images\\IMG_1.JPG',))

    Args:
        homes: folders that names may be relative to, and that hold folders of photos; the nearest first.
        given: the folder of the photos by the user, in which alone they are looked for.
        folders: the usual names of folders of photos, in the order of preference; NAME_2, NAME_4 hold them reduced.
        others: further names of folders.
        sizes: width and height of the pictures that the cameras are for; None where the capture does not state them.

    Raises:
        UserError: two files fit a name, a file fits two names, or two folders have other photos of these names; both
            are named. Or `given` is no folder.
    """
    if given is not None and not given.is_dir():
        raise UserError(f"the folder of photos {given} does not exist", "give the folder that holds the photos")
    names = [Name.of(text) for text in listed]
    places = places_of(names, homes if given is None else [given], folders, others, is_given=given is not None)
    tried = list[Search]()
    for place in places:
        tried.append(search_of(place, names, sizes))
        if place.is_usual and tried[-1].rank == (True, len(names), True, True, len(names)):
            break
    best = max(tried, key=lambda search: search.rank, default=None)  # the first of equal ones
    if best is None or not any(best.paths):
        for search in tried:
            for problem in (*search.problems, *search.unfit):
                raise problem
        usual = next((place for place in places if place.is_usual and (given or place.path not in homes)), None)
        return _described(names, Search(usual, [None] * len(names)) if usual else None)
    for problem in best.problems:
        raise problem
    for other in tried:
        _refuse_other(best, other)
    return _described(names, best)


def with_photos(
    capture: Capture, *homes: Path, given: Path | None = None, folders: Sequence[str] = ("images",)
) -> Capture:
    """Return the capture with its photos found by the frames' names, see `find_photos`; what was done is noted."""
    sizes = [frame.camera.size for frame in capture.frames]
    found = find_photos([frame.name for frame in capture.frames], homes, given=given, folders=folders, sizes=sizes)
    frames = tuple(
        replace(frame, name=name, image=place or frame.image)
        for frame, name, place in zip(capture.frames, found.names, found.places, strict=True)
    )
    return replace(capture, frames=frames, notes=(*capture.notes, *found.notes))


def seen_from(folder: Path, path: Path | None) -> str:
    """Return a path relative to a folder, with forward slashes; absolute if on another drive, empty for None."""
    if path is None:
        return ""
    try:
        return Path(os.path.relpath(path.parent.resolve() / path.name, folder.resolve())).as_posix()
    except ValueError:
        return path.absolute().as_posix()


def _refuse_other(best: Search, other: Search) -> None:
    """Refuse a second folder of an unusual name that has other photos of the same names."""
    if best is other or best.rank != other.rank or best.place.is_usual:
        return
    for one, two in zip(best.paths, other.paths, strict=True):
        if one is not None and two is not None and not filecmp.cmp(one, two, shallow=False):
            seen = " and ".join(seen_from(best.place.home, path) for path in (one, two))
            hint = "give the one that is meant with --images"
            raise UserError(f"two folders hold photos of these names: {seen}", hint)


def _described(names: Sequence[Name], search: Search | None) -> FoundPhotos:
    """Return the photos of a search, with their names in its folder and what was done."""
    listed = tuple(name.listed for name in names)
    if search is None:
        return FoundPhotos(listed, tuple(_relative(name, None) for name in names), (None,) * len(names), None, ())
    place, notes = search.place, []
    inside = [
        None if path is None or not path.is_relative_to(place.path) else path.relative_to(place.path).as_posix()
        for path in search.paths
    ]
    renamed = [
        index
        for index, (name, seen) in enumerate(zip(names, inside, strict=True))
        if seen is not None and search.paths[index] != Path(name.plain) and not _is_expected(name, seen, place)
    ]
    if renamed:
        index = renamed[0]
        notes.append(
            f"{several(len(renamed), 'photo')} found under {'another name' if len(renamed) == 1 else 'other names'}: "
            f"{seen_from(place.home, search.paths[index])} for {listed[index]}"
        )
    notes += [f"{search.unfit[0].message}; {several(len(search.unfit), 'photo')} left out"] if search.unfit else []
    plain = tuple(_relative(name, seen) for name, seen in zip(names, inside, strict=True))
    if len(set(plain)) < len(set(listed)):
        plain = tuple(name.plain.lstrip("/") for name in names)
    return FoundPhotos(listed, plain, tuple(search.paths), place.path, tuple(notes))


def _relative(name: Name, seen: str | None) -> str:
    return name.plain if not name.is_absolute else seen or name.plain.rpartition("/")[2]


def _is_expected(name: Name, seen: str, place: Place) -> bool:
    """Return whether a path in a folder is the one that a name says, or with the suffix that it leaves open."""
    if not place.is_usual or place.is_reduced:
        return False
    return seen == name.plain or (not name.suffix and seen.rpartition(".")[0] == name.plain)
