"""Look the names of a capture's photos up in the folders that may hold them; `photo_names` chooses one of these."""

import itertools
import os
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Size
from nerfcli.errors import UserError
from nerfcli.photos.images import HEIC_SUFFIXES, IMAGE_SUFFIXES, image_size

# Folders that people and programs put photos into, besides images; none of them is preferred.
OTHER_FOLDERS = ("input", "inputs", "image", "imgs", "photos", "rgb", "color", "frames")
# The end of the name of a folder that holds the photos of another one reduced by this factor.
_REDUCED = re.compile(r"_(\d+)$", re.ASCII)


# The parts of the paths of photos, by their stems and the names of their folders, in plain letters.
Photos = dict[str, dict[str, list[tuple[str, ...]]]]

_DRIVE = re.compile(r"[A-Za-z]:")
_SUFFIX = re.compile(r"\.[A-Za-z]\w{1,4}$", re.ASCII)
# Most photos that are measured to see whether a folder has the photos of the cameras.
_MOST_MEASURED = 16


@dataclass(frozen=True)
class Name:
    """A name as a capture lists it.

    Args:
        plain: with forward slashes, without "./".
        folders: the folders in it, without drives and "..", for comparison.
        stems: the keys by which photos are looked up; the first that has photos counts.
    """

    listed: str
    plain: str
    folders: tuple[str, ...]
    stems: tuple[str, ...]
    is_absolute: bool

    @classmethod
    def of(cls, listed: str) -> "Name":
        pure = PurePosixPath(plain_name(listed))
        is_absolute = pure.is_absolute() or _DRIVE.match(str(pure)) is not None
        parts = [part for part in pure.parts[:-1] if part.strip("/") not in ("", "..") and not _DRIVE.fullmatch(part)]
        whole, stem = folded(pure.name), folded(_SUFFIX.sub("", pure.name))
        # Converters also append a suffix: IMG_1.HEIC becomes IMG_1.HEIC.jpg. But IMG_1.jpg.png is a mask.
        suffix = pure.suffix.lower()
        stems = (stem, whole) if suffix in HEIC_SUFFIXES else (stem,) if suffix in IMAGE_SUFFIXES else (whole, stem)
        return cls(listed, str(pure), tuple(map(folded, parts)), stems, is_absolute)

    @property
    def suffix(self) -> str:
        """The suffix in lower case; empty if the name has none."""
        suffix = PurePosixPath(self.plain).suffix
        return suffix.lower() if _SUFFIX.fullmatch(suffix) else ""


@dataclass(frozen=True)
class Place:
    """A folder in which names are looked up.

    Args:
        home: the folder from which paths are shown.
        is_usual: whether the format, or the user, says that photos are there.
        subfolders: those in which files are looked for, too; None for all.
        is_given: whether the user says that all photos are there, so that no name leads elsewhere.
    """

    path: Path
    home: Path
    is_usual: bool
    subfolders: frozenset[str] | None = None
    is_given: bool = False

    @property
    def is_reduced(self) -> bool:
        return self.path != self.home and _REDUCED.search(self.path.name) is not None

    def exact(self, name: Name) -> Path | None:
        """Return the photo with exactly this name; None if there is none."""
        path = self.path / name.plain  # outside, if the name is absolute or has ".."
        is_allowed = not self.is_given or Path(os.path.abspath(path)).is_relative_to(os.path.abspath(self.path))
        return path if is_allowed and os.path.isfile(path) else None

    def photos(self) -> Photos:
        """Return the parts of the photos' paths by their stems and the names of their folders."""
        found: Photos = {}
        for folder, subfolders, files in os.walk(self.path):
            parts = Path(folder).relative_to(self.path).parts
            if not parts and self.subfolders is not None:
                subfolders[:] = [name for name in subfolders if folded(name) in self.subfolders]
            subfolders[:] = [name for name in subfolders if not name.startswith(".")]
            for file in files:
                stem, suffix = os.path.splitext(file)
                if suffix.lower() in IMAGE_SUFFIXES and not file.startswith("."):
                    of_stem = found.setdefault(folded(stem), {})
                    of_stem.setdefault(folded(parts[-1]) if parts else "", []).append((*parts, file))
        return found


@dataclass(frozen=True)
class Search:
    """What names led to in a folder.

    Args:
        problems: an error for each name that two files fit, or file that fits two names.
        unfit: an error for each photo that was not taken, as its shape is another than that of its camera.
        rank: whether most photos have the shape of their cameras; their number; whether they are not reduced; whether
            they have the cameras' size; how many have exactly the listed name.
    """

    place: Place
    paths: list[Path | None]
    problems: list[UserError] = field(default_factory=list)
    unfit: list[UserError] = field(default_factory=list)
    rank: tuple[bool, int, bool, bool, int] = (False, 0, False, False, 0)


def folded(text: str) -> str:
    """Return a text without what other machines and programs change.

    These are the case of letters, composed accents, spaces at the ends, and the percent-encoding of addresses.
    """
    return unicodedata.normalize("NFC", unquote(text)).casefold().strip()


def places_of(
    names: Sequence[Name], homes: Sequence[Path], folders: Sequence[str], others: Sequence[str], *, is_given: bool
) -> list[Place]:
    """Return the folders that exist: those of the usual names in each home, the home, then those of other names."""
    # Of absolute paths only the last folders: the first, such as home, are not those of a capture.
    in_names = None if is_given else frozenset(part for name in names for part in name.folders[-2:])
    usual, further = [], []
    for home in dict.fromkeys(homes):
        if not home.is_dir():
            continue
        inside = os.listdir(home) if os.access(home, os.R_OK | os.X_OK) else []
        usual += [Place(home / name, home, True) for name in _in_order(inside, folders) if (home / name).is_dir()]
        usual.append(Place(home, home, True, in_names))
        unusual = [name for name in others if name not in folders]
        further += [Place(home / name, home, False) for name in _in_order(inside, unusual) if (home / name).is_dir()]
    return [replace(place, is_given=is_given) for place in (*usual, *further)]


def _in_order(there: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the entries with these names in the order of the names, and after each those with a number at the end."""
    places = {name: index for index, name in enumerate(names)}
    found = []
    for entry in there:
        name = entry.lower()
        number = _REDUCED.search(name)
        if name in places:
            found.append((places[name], 0, entry))
        elif number and name[: number.start()] in places:
            found.append((places[name[: number.start()]], int(number[1]), entry))
    return [entry for *_, entry in sorted(found)]


def search_of(place: Place, names: Sequence[Name], sizes: Sequence[Size | None] | None) -> Search:
    """Look names up in a folder."""
    paths = [place.exact(name) for name in names]
    exact, problems, unfit = len(names) - paths.count(None), [], []
    if exact < len(names):
        photos, taken = place.photos(), {path for path in paths if path is not None}
        claims: dict[Path, list[tuple[tuple[int, ...], int]]] = {}
        for index, (score, best) in _matched(names, paths, photos, place).items():
            name, candidates = names[index], [path for path in best if path not in taken]
            if len(candidates) > 1 and sizes is not None:
                candidates = [path for path in candidates if _fit(path, sizes[index]).has_shape]
            if len(candidates) > 1:
                two = " and ".join(_seen(place, path) for path in candidates[:2])
                problems.append(
                    UserError(f"{name.listed}: both {two} fit this name", "remove or rename the one that is not meant")
                )
            elif candidates and sizes is not None and candidates[0].suffix.lower() != name.suffix:
                fit = _fit(candidates[0], sizes[index])
                if not fit.has_shape:
                    unfit.append(_other_shape(place, candidates[0], fit, sizes[index]))
                    continue
            if len(candidates) == 1:
                claims.setdefault(candidates[0], []).append((score, index))
        for path, claimed in claims.items():
            highest = max(score for score, _ in claimed)
            winners = [index for score, index in claimed if score == highest]
            paths[winners[0]] = path
            others = {names[index].listed for index in winners}
            if len(others) > 1:
                two = " and ".join(sorted(others)[:2])
                hint = "give the folder in which both are, with --images"
                problems.append(UserError(f"{_seen(place, path)} fits two names, {two}", hint))
            for index in winners[1:]:
                paths[index] = path
    found = [index for index, path in enumerate(paths) if path is not None]
    has_shape = has_size = bool(found)
    if sizes is not None and found:
        chosen = np.unique(np.linspace(0, len(found) - 1, _MOST_MEASURED).round().astype(int)).tolist()
        sample = [(found[index], _fit(paths[found[index]], sizes[found[index]])) for index in chosen]
        has_shape = 2 * sum(fit.has_shape for _, fit in sample) > len(sample)
        has_size = all(fit.has_size for _, fit in sample)
        if not has_shape and not place.is_usual:
            index, fit = next((index, fit) for index, fit in sample if not fit.has_shape)
            unfit.append(_other_shape(place, paths[index], fit, sizes[index]))
            paths, found, exact = list[Path | None]([None] * len(names)), [], 0
    return Search(place, paths, problems, unfit, (has_shape, len(found), not place.is_reduced, has_size, exact))


def _matched(
    names: Sequence[Name], exact: Sequence[Path | None], photos: Photos, place: Place
) -> dict[int, tuple[tuple[int, ...], list[Path]]]:
    """Return the best score of photos for each name that has no exact one, and the photos that have it.

    A folder that the names lack holds masks or previews if it has further files of the names of photos that lie as they
    are listed.
    """
    missing = [index for index, path in enumerate(exact) if path is None]
    found = {index: _matches(names[index], photos, place, has_exact=len(missing) < len(names)) for index in missing}
    there = {folded(path.stem) for score, best in found.values() if score[1:2] == (True,) for path in best}
    of_there = (parts for stem in there & photos.keys() for parts in itertools.chain(*photos[stem].values()))
    copies = {place.path.joinpath(*parts[:-1]) for parts in of_there}
    return {
        index: (score, [path for path in best if score[1] or path.parent not in copies])
        for index, (score, best) in found.items()
    }


def _matches(name: Name, photos: Photos, place: Place, *, has_exact: bool) -> tuple[tuple[int, ...], list[Path]]:
    """Return the best score of photos for a name, and the photos that have it."""
    by_folder = next((photos[stem] for stem in name.stems if stem in photos), {})
    # The last folder decides first. With a folder for each photo, all photos may have the same name.
    in_last = by_folder.get(name.folders[-1] if name.folders else "", [])
    scored: dict[tuple[int, ...], list[Path]] = {}
    for candidates in (in_last, itertools.chain.from_iterable(by_folder.values())):
        for parts in candidates:
            if (score := _score(name, parts, has_exact=has_exact)) is not None:
                scored.setdefault(score, []).append(place.path.joinpath(*parts))
        if scored:
            break
    best = max(scored, default=())
    return best, scored.get(best, [])


def _score(name: Name, parts: tuple[str, ...], *, has_exact: bool) -> tuple[int, ...] | None:
    """Return how well the parts of a photo's path fit a name, to compare with others; None if they do not."""
    folders = [folded(part) for part in parts[:-1]]
    common = 0
    while common < min(len(folders), len(name.folders)) and folders[-1 - common] == name.folders[-1 - common]:
        common += 1
    left = name.folders[: len(name.folders) - common]
    may_lie_deeper = name.is_absolute or all(map(_is_image_folder, left))
    # A folder that the name lacks may be that of rejected photos, where others lie exactly as they are listed.
    if len(folders) > common and (has_exact or not may_lie_deeper):
        return None
    file = PurePosixPath(parts[-1])
    suffix, listed = file.suffix.lower(), name.plain.rpartition("/")[2]
    is_listed = listed in (file.name, file.stem)
    return common, len(folders) == common, suffix == name.suffix, suffix not in HEIC_SUFFIXES, is_listed


def _is_image_folder(name: str) -> bool:
    return _REDUCED.sub("", name) in ("images", *OTHER_FOLDERS)


@dataclass(frozen=True)
class _Fit:
    """The size of a photo, and how it fits that of its camera, as stored or upright."""

    size: Size
    has_shape: bool
    has_size: bool


def _fit(path: Path, size: Size | None) -> _Fit:
    if size is None:
        return _Fit((0, 0), True, True)
    try:
        width, height = image_size(path)
    except UserError:  # whoever reads the photo says what is wrong with it
        return _Fit(size, True, True)
    camera = Camera.pinhole(*size, 1.0)
    has_shape = camera.has_shape(width, height) or camera.has_shape(height, width)
    return _Fit((width, height), has_shape, size in ((width, height), (height, width)))


def _seen(place: Place, path: Path) -> str:
    return path.relative_to(place.home).as_posix() if path.is_relative_to(place.home) else str(path)


def _other_shape(place: Place, path: Path, fit: _Fit, size: Size | None) -> UserError:
    assert size is not None
    return UserError(
        f"{_seen(place, path)} has {fit.size[0]}x{fit.size[1]} pixels, which is not the shape of its camera, "
        f"{size[0]}x{size[1]}",
        "restore the photos that the cameras are for; these were cropped, undistorted or are of another capture",
    )


def plain_name(listed: str) -> str:
    """Return a name with forward slashes and without "./", the scheme of an address, and spaces at its ends."""
    return str(PurePosixPath(listed.strip().replace("\\", "/").removeprefix("file://")))
