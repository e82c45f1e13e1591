"""The photos that poses are estimated from: readability, upright size, groups with a common camera."""

import re
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from nerfcli.errors import TOO_FEW_PHOTOS, UserError, several
from nerfcli.photos.exif import Exif, read_exif
from nerfcli.photos.focal_evidence import focal_evidence, same_focal, with_digital_zoom
from nerfcli.photos.images import list_photos, name_in, read_image, where_photos_may_be
from nerfcli.photos.panoramas import is_panorama

# Three views determine a scene up to scale, but leave nothing to check them with; four are the fewest that do.
MIN_PHOTOS = 4


@dataclass(frozen=True)
class Photo:
    """A photo that was decoded from beginning to end. width and height are those of the upright picture.

    name: of the file; in a subfolder its path from the folder of photos, with forward slashes. is_panorama: whether it
    looks like a picture of the whole sphere, or says so.
    """

    name: str
    width: int
    height: int
    exif: Exif
    is_panorama: bool = False


@dataclass(frozen=True)
class Photos:
    """The photos of a folder, sorted by name, and why each of the others could not be read (by name).

    skipped: how many files are no photos, by suffix, as text for people.
    """

    folder: Path
    photos: tuple[Photo, ...]
    unreadable: dict[str, str]
    skipped: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """The readable photos' names, sorted."""
        return tuple(photo.name for photo in self.photos)


def find_photos(
    folder: Path, progress: Callable[[int, int], None] | None = None, *, subfolders: bool = False
) -> Photos:
    """Read every photo of `folder` once, so that a damaged one is found here and not by a solver an hour later.

    `progress` receives (photos read, photos in all) after each photo.

    Raises:
        UserError: no such folder, a file instead of a folder, no photos in it, fewer than `MIN_PHOTOS` readable, or
            `refuse_odd_names`.
    """
    if not folder.exists():
        raise UserError(f"the folder {folder} does not exist", "give a folder of photos, or a video file")
    if not folder.is_dir():
        raise UserError(f"{folder} is a file, not a folder of photos", "give the folder that contains the photos")
    listed = list_photos(folder, subfolders=subfolders)
    paths = [*listed.pictures, *listed.unreadable]
    if not paths:
        raise UserError(f"no photos in {folder}", where_photos_may_be(folder))
    refuse_odd_names(folder, paths)
    photos: list[Photo] = []
    unreadable: dict[str, str] = {}
    with ThreadPoolExecutor(4) as readers:  # each holds a decoded photo in memory
        for index, found in enumerate(readers.map(lambda path: _examine(path, name_in(folder, path)), paths)):
            if isinstance(found, Photo):
                photos.append(found)
            else:
                unreadable[name_in(folder, paths[index])] = found
            if progress:
                progress(index + 1, len(paths))
    if len(photos) < MIN_PHOTOS:
        raise _too_few(folder, photos, unreadable)
    exifs = with_digital_zoom([photo.exif for photo in photos])
    zoomed = tuple(replace(photo, exif=exif) for photo, exif in zip(photos, exifs, strict=True))
    return Photos(folder, zoomed, unreadable, listed.skipped)


def refuse_odd_names(folder: Path, paths: Iterable[Path]) -> None:
    """Refuse photos of a folder whose name, or its own, is not text: neither pages nor models of COLMAP can hold it.

    Raises:
        UserError: a name has bytes that are not UTF-8, for which Python has the stand-ins that are searched for here.
    """
    for name in (folder.absolute().name, *(name_in(folder, path) for path in paths)):
        if re.search("[\udc80-\udcff]", name):
            raise UserError(f"the name {name!r} is not in UTF-8", "rename it; old archives have such names")


def camera_groups(photos: Iterable[Photo]) -> tuple[tuple[int, ...], ...]:
    """Group the numbers of photos that may share intrinsics.

    They have the same subfolder, make, model, lens, focal length, upright size and crop. Focal lengths within 2 % count
    as the same: autofocus changes them a little. Photos without EXIF are distinguished by their size alone. Groups and
    the numbers in them are in the order of `photos`.
    """
    groups: dict[tuple[object, ...], list[int]] = {}
    focals: list[float] = []
    for number, photo in enumerate(photos):
        exif = photo.exif
        evidence = focal_evidence(exif)
        crop = evidence.whole_px if evidence.doubt else None
        zoom = same_focal(exif.focal_mm, focals), same_focal(exif.focal_35mm, focals)
        optics = (exif.make, exif.model, exif.lens, *zoom, crop, photo.width, photo.height)
        groups.setdefault((PurePosixPath(photo.name).parent, *optics), []).append(number)
    return tuple(tuple(numbers) for numbers in groups.values())


def _examine(path: Path, name: str) -> Photo | str:
    """Return the photo, or why it cannot be read."""
    try:
        picture = read_image(path)
        height, width = picture.shape[:2]
        return Photo(name, width, height, exif=read_exif(path), is_panorama=is_panorama(path, picture))
    except UserError as error:
        return error.message.replace(str(path), "").removeprefix(" is ").strip(" :")


def _too_few(folder: Path, photos: list[Photo], unreadable: dict[str, str]) -> UserError:
    add = "20 or more that overlap by two thirds work well"
    if not unreadable:
        text = f"{folder} has only {several(len(photos), 'photo')}; at least {MIN_PHOTOS} are needed"
        return UserError(text, f"add photos from other viewpoints; {add}", TOO_FEW_PHOTOS)
    name, reason = next(iter(unreadable.items()))
    few = f"only {len(photos)}" if photos else "none"
    readable = f"{few} of {len(photos) + len(unreadable)} photos in {folder} can be read"
    return UserError(
        f"{readable}; at least {MIN_PHOTOS} are needed ({name}: {reason})",
        f"convert these files to JPEG or copy them again, or add photos; {add}",
        TOO_FEW_PHOTOS,
    )
