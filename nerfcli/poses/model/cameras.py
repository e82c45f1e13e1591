"""Groups of photos with a common camera, and initial intrinsics: from EXIF and size, or as given."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nerfcli.captures.calibration import Calibration, PhotoCalibration, calibrated
from nerfcli.captures.orientation import Picture, describe_rescaling, rescaled_sizes
from nerfcli.errors import UserError, listed, several
from nerfcli.photos.exif import Exif
from nerfcli.photos.focal_evidence import focal_evidence
from nerfcli.photos.panoramas import MOST_OF_A_CAMERA, PANORAMA
from nerfcli.poses.input.job import CameraGroup
from nerfcli.poses.input.photos import Photo, Photos, camera_groups
from nerfcli.poses.model.intrinsics import START_FISHEYE, START_MODEL

# More reasons to doubt EXIF than this are only counted.
_MOST_DOUBTS = 4


@dataclass(frozen=True)
class PhotoGroups:
    """Photos by camera, notes on them for the user, and the given intrinsics for the report (None without any)."""

    groups: tuple[CameraGroup, ...]
    notes: tuple[str, ...]
    given: dict[str, Any] | None = None


def group_photos(photos: Photos, *, model: str) -> PhotoGroups:
    """Group photos by EXIF and upright size; model: COLMAP's name, or "auto" to start from the one that EXIF suggests.

    If EXIF describes another picture than the file, its focal length is only the start of the adjustment, not a prior.

    Raises:
        UserError: a photo that is to be a panorama is not twice as wide as high.
    """
    groups: list[CameraGroup] = []
    doubted: dict[str, list[str]] = {}
    for numbers in camera_groups(photos.photos):
        members = [photos.photos[number] for number in numbers]
        first = members[0]
        look_like_it = sum(photo.is_panorama for photo in members) > MOST_OF_A_CAMERA * len(members)
        if model == PANORAMA or (model == "auto" and look_like_it):
            groups.append(_panoramas(numbers, first))
            continue
        evidence = focal_evidence(first.exif)
        if evidence.doubt and (first.exif.focal_mm or first.exif.focal_35mm):
            doubted.setdefault(evidence.doubt, []).extend(photo.name for photo in members)
        groups.append(
            CameraGroup(
                photos=numbers,
                model=start_model(first.exif) if model == "auto" else model,
                width=first.width,
                height=first.height,
                choose=model == "auto",
                focal_px=evidence.focal_px,
                focal_is_prior=evidence.focal_px is not None and evidence.holds,
            )
        )
    notes = (*_panorama_notes(groups, chosen=model != "auto"), *_doubts(doubted))
    if len(groups) == 1:
        return PhotoGroups(tuple(groups), notes)
    by = "folder, EXIF and size" if any("/" in name for name in photos.names) else "EXIF and size"
    return PhotoGroups(tuple(groups), (f"{len(groups)} cameras, by {by}: {_each(groups)}", *notes))


def _each(groups: Sequence[CameraGroup]) -> str:
    """List the cameras, alike ones together, and those of rare models first: a long list is cut."""
    alike: dict[tuple[str, int, int], list[int]] = {}
    for group in groups:
        alike.setdefault((group.model, group.width, group.height), []).append(len(group.photos))
    models = Counter(group.model for group in groups)
    by_rarity = sorted(alike.items(), key=lambda item: models[item[0][0]])
    return listed([f"{several(sum(counts), 'photo')} of {w}x{h} ({model})" for (model, w, h), counts in by_rarity])


def _panoramas(photos: tuple[int, ...], first: Photo) -> CameraGroup:
    """Return the group of photos that show the whole sphere: their size determines the camera."""
    if first.width != 2 * first.height:
        raise UserError(
            f"{first.name} is not a panorama of the whole sphere: {first.width}x{first.height} pixels",
            "equirectangular pictures are twice as wide as high; choose another --camera-model for these photos",
        )
    size = (float(first.width), float(first.height))
    return CameraGroup(photos, PANORAMA, first.width, first.height, params=size, fixed=True)


def group_by_given(photos: Photos, calibration: Calibration) -> PhotoGroups:
    """Group photos by the cameras of a file. Photos that it does not list share a camera only if their EXIF agrees.

    Raises:
        UserError: a photo has no camera in the file, or one that cannot be.
    """
    pictures = [Picture(photos.folder / p.name, p.width, p.height, p.exif.orientation) for p in photos.photos]
    found = calibrated(calibration, pictures)
    for one in found:
        if one.camera.is_spherical and one.camera.width != 2 * one.camera.height:
            raise UserError(
                f"{calibration.path} has a spherical camera of {one.camera.width}x{one.camera.height} pixels",
                "panoramas of the whole sphere are twice as wide as high",
            )
    optics = {number: numbers[0] for numbers in camera_groups(photos.photos) for number in numbers}
    members: dict[tuple[Any, ...], list[int]] = {}
    for number, one in enumerate(found):
        key = (one.number, one.camera, one.by_name, None if one.by_name else optics[number])
        members.setdefault(key, []).append(number)
    groups = tuple(
        CameraGroup(tuple(numbers), camera.model, camera.width, camera.height, params=camera.params, fixed=True)
        for (_, camera, *_), numbers in members.items()
    )
    described = [
        {"photos": len(numbers), "matched_by": "name" if by_name else "size", **camera.to_json()}
        for (_, camera, by_name, _), numbers in members.items()
    ]
    return PhotoGroups(groups, _notes(calibration, found), calibration.to_json() | {"cameras": described})


def start_model(exif: Exif) -> str:
    """Return the initial COLMAP camera model: one distortion term, or a fisheye if the lens suggests it."""
    return START_FISHEYE if "fisheye" in (exif.lens or "").lower() else START_MODEL


def _panorama_notes(groups: Sequence[CameraGroup], *, chosen: bool) -> tuple[str, ...]:
    """Return a note on photos that were recognized as panoramas, unless the user chose the camera model."""
    count = sum(len(group.photos) for group in groups if group.is_panorama)
    if chosen or not count:
        return ()
    return (
        f"{several(count, 'photo')} recognized as 360-degree panoramas (equirectangular); if this is wrong, give "
        "--camera-model SIMPLE_RADIAL",
    )


def _doubts(doubted: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return a note for each reason to doubt EXIF; if there are many, for the first ones and the number of the rest."""
    notes = []
    for doubt, names in list(doubted.items())[:_MOST_DOUBTS]:
        which = names[0] if len(names) == 1 else f"{names[0]} and {several(len(names) - 1, 'more photo')}"
        notes.append(f"EXIF's focal length is only a starting value for {which}: {doubt}")
    rest = sum(len(names) for names in list(doubted.values())[_MOST_DOUBTS:])
    return (*notes, f"and for {several(rest, 'more photo')}, for reasons like these") if rest else tuple(notes)


def _notes(calibration: Calibration, found: Sequence[PhotoCalibration]) -> tuple[str, ...]:
    named = sum(one.by_name for one in found)
    ways = [f"{count} by {how}" for count, how in ((named, "name"), (len(found) - named, "size")) if count]
    used = len({one.number for one in found})
    first = f"intrinsics of {calibration.path}: {several(used, 'camera')} for {len(found)} photos, {' and '.join(ways)}"
    other_sizes = rescaled_sizes((calibration.cameras[one.number], one.camera) for one in found)
    return (first, *describe_rescaling(other_sizes))
