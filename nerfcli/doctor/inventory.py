"""Check the files: readability, number, size, cameras, orientation, duplicates."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

import numpy as np

from nerfcli.doctor.compared_pairs import Pair
from nerfcli.doctor.photo_facts import PhotoFacts
from nerfcli.errors import several
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding, finding, verdict_above, verdict_below
from nerfcli.photos.focal_evidence import focal_evidence, same_focal
from nerfcli.poses.input.photos import MIN_PHOTOS

ENOUGH_PHOTOS = 20
SMALL_PX = 640
# Two pictures show the same view if their thumbnails are at least this similar (cosine) and their matches moved by less
# than this fraction of the diagonal.
_ALIKE = 0.985
_SAME_PLACE = 0.004
# Likewise for the same picture stored again in another format or quality.
_SAME_PICTURE = 0.999
_SAME_PIXELS = 0.0003


def readable(unreadable: Mapping[str, str], photos: Sequence[PhotoFacts], skipped: str = "") -> Finding:
    """Check whether all files can be read; `skipped` counts those that are no photos, as text."""
    bad, total = len(unreadable), len(unreadable) + len(photos)
    paged = [photo.name for photo in photos if photo.exif.pages > 1]
    notes = f"; other files, not used: {skipped}" if skipped else ""
    notes += f"; only the largest page of {several(len(paged), 'file')} is used, such as {paged[0]}" if paged else ""
    threshold = "look from 1, bad from 10 % of the photos"
    if not bad:
        return Finding("files", GOOD, f"all {several(total, 'photo')} can be read{notes}", 0, threshold)
    summary, verdict = f"{bad} of {several(total, 'photo')} cannot be read{notes}", BAD if bad >= 0.1 * total else LOOK
    advice = "convert these files to JPEG, copy them again, or remove them"
    return Finding("files", verdict, summary, bad, threshold, advice, tuple(unreadable.items()))


def enough(count: int) -> Finding:
    """Check whether there are enough photos for a reconstruction with held-out photos."""
    verdict = verdict_below(count, look=ENOUGH_PHOTOS, bad=MIN_PHOTOS)
    advice = {
        GOOD: "",
        LOOK: "more photos with two-thirds overlap give better results",
        BAD: "take more photos from other positions: 20 or more with two-thirds overlap work well",
    }
    threshold = f"look below {ENOUGH_PHOTOS}, bad below {MIN_PHOTOS}"
    return Finding("count", verdict, several(count, "readable photo"), count, threshold, advice[verdict])


def size(photos: Sequence[PhotoFacts]) -> Finding:
    """Check whether the photos have enough pixels."""
    longer = [max(photo.exif.width, photo.exif.height) for photo in photos]
    smallest = min(longer)
    sizes = Counter(f"{photo.exif.width} x {photo.exif.height}" for photo in photos)
    listed = ", ".join(f"{text} ({number})" for text, number in sizes.most_common(3))
    listed += f" and {len(sizes) - 3} other sizes" if len(sizes) > 3 else ""
    verdict = verdict_below(smallest, look=SMALL_PX, bad=SMALL_PX // 2)
    small = sorted((side, photo.name) for photo, side in zip(photos, longer, strict=True) if side < SMALL_PX)
    remarks = ((name, f"{side} px") for side, name in small)
    threshold = f"longer side: look below {SMALL_PX} px, bad below {SMALL_PX // 2} px"
    advice = "use the original files, not previews or downloads from a messenger"
    return finding("size", verdict, listed, smallest, threshold, advice=advice, photos=remarks)


def cameras(photos: Sequence[PhotoFacts]) -> Finding:
    """Check whether one camera with one lens and zoom took all photos of each folder, as far as EXIF shows."""
    folders: dict[PurePosixPath, list[PhotoFacts]] = {}
    for photo in photos:
        folders.setdefault(PurePosixPath(photo.name).parent, []).append(photo)
    groups = [_camera_groups(members) for members in folders.values()]
    main = [max(found, key=lambda optics: len(found[optics])) for found in groups]
    others = [
        (name, optics)
        for found, usual in zip(groups, main, strict=True)
        for optics, names in found.items()
        if optics != usual
        for name in names
    ]
    most = max(len(found) for found in groups)
    many = any(len(g) > max(2, len(members) / 4) for g, members in zip(groups, folders.values(), strict=True))
    verdict = GOOD if most == 1 else BAD if many else LOOK
    kinds = f"{most} different combinations of camera, lens, zoom and image size"
    if len(folders) > 1:
        kinds = f"up to {kinds} in each of {len(folders)} folders"
    if most == 1:
        kinds = "one camera" if len(folders) == 1 else f"one camera in each of {len(folders)} folders"
    summary = f"{kinds}{'; most photos' if most > 1 else ''}: {'; '.join(dict.fromkeys(main))}"
    threshold = "combinations: look from 2, bad from one per four photos"
    advice = "use one lens and one zoom setting, without cropping; each combination is calibrated separately"
    return finding("cameras", verdict, summary, most, threshold, advice=advice, photos=others)


def focal_length(photos: Sequence[PhotoFacts]) -> Finding:
    """Check whether the focal lengths in EXIF fit the files; they do not after cropping."""
    found = [(photo, focal_evidence(photo.exif)) for photo in photos if not photo.is_panorama]
    doubtful = [(photo.name, evidence.doubt) for photo, evidence in found if evidence.doubt]
    fractions = [
        evidence.focal_px / evidence.whole_px[0]
        for _, evidence in found
        if evidence.focal_px is not None and evidence.holds
    ]
    if doubtful:
        summary = f"EXIF does not match {several(len(doubtful), 'file')}: {doubtful[0][1]}"
    elif not found:
        summary = "not needed for panoramas of the whole sphere"
    elif fractions:
        summary = f"{np.median(fractions):.2f} times the longer side, from EXIF ({several(len(fractions), 'photo')})"
    elif any(photo.exif.focal_mm is not None for photo, _ in found):
        summary = "in EXIF in millimetres, without the size of the sensor; structure from motion will estimate it"
    else:
        summary = "not in EXIF; structure from motion will estimate it"
    verdict, threshold = LOOK if doubtful else GOOD, "look from 1 photo whose EXIF is for another aspect ratio"
    advice = (
        "use the original files, or give --intrinsics: EXIF's focal length is not used, and a crop may shift the "
        "principal point"
    )
    return finding("focal length", verdict, summary, len(doubtful), threshold, advice=advice, photos=doubtful)


def orientation(photos: Sequence[PhotoFacts]) -> Finding:
    """Check whether all photos have the same orientation."""
    portrait = [photo.name for photo in photos if photo.exif.height > photo.exif.width]
    landscape = [photo.name for photo in photos if photo.exif.height < photo.exif.width]
    turned = Counter(photo.exif.orientation for photo in photos)
    fewer = min(portrait, landscape, key=len)
    kind = "portrait" if fewer is portrait else "landscape"
    tags = ", ".join(f"{tag} ({number})" for tag, number in sorted(turned.items()))
    by_tag = any(tag >= 5 for tag in turned)  # of these, width and height are swapped
    why = (
        "nerfcli turns photos upright; other programs may ignore the tag" if by_tag else "the two get separate cameras"
    )
    summary = f"{len(portrait)} portrait, {len(landscape)} landscape; EXIF orientation {tags}"
    threshold, advice = "look from 1 photo with another orientation", f"nothing to do: {why}" if fewer else ""
    remarks = tuple((name, kind) for name in fewer)
    return Finding("orientation", LOOK if fewer else GOOD, summary, len(fewer), threshold, advice, remarks)


def duplicates(photos: Sequence[PhotoFacts], pairs: Sequence[Pair]) -> Finding:
    """Find photos that are stored twice, or were taken twice from the same place."""
    remarks: dict[str, str] = {}
    exact = 0
    first_of: dict[str, str] = {}
    for photo in photos:
        if photo.digest in first_of:
            remarks[photo.name] = f"same file as {first_of[photo.digest]}"
            exact += 1
        first_of.setdefault(photo.digest, photo.name)
    for pair in pairs:
        one, other = photos[pair.first], photos[pair.second]
        likeness = float((one.tiny * other.tiny).sum())
        if not pair.linked or other.name in remarks:
            continue
        if pair.shift < _SAME_PIXELS and likeness > _SAME_PICTURE:
            remarks[other.name] = f"same picture as {one.name}"
            exact += 1
        elif pair.shift < _SAME_PLACE and likeness > _ALIKE:
            remarks[other.name] = f"nearly the same as {one.name}"
    threshold = "look from 1 duplicate file or 10 % from the same place, bad from 30 % of the photos"
    if not remarks:
        return Finding("duplicates", GOOD, "none", 0, threshold)
    fraction = len(remarks) / len(photos)
    verdict = verdict_above(fraction, look=1e-9, bad=0.3) if exact or fraction > 0.1 else GOOD
    summary = f"{exact} exact duplicates, {len(remarks) - exact} taken from the same place as another"
    advice = "remove them: they cost time, and a held-out photo tests nothing if its duplicate is used for training"
    return Finding("duplicates", verdict, summary, len(remarks), threshold, advice, tuple(remarks.items()))


def _camera_groups(photos: Sequence[PhotoFacts]) -> dict[str, list[str]]:
    """Group names by camera, lens, focal length and image size, regardless of orientation."""
    groups: dict[str, list[str]] = {}
    focals: list[float] = []
    for photo in photos:
        exif = photo.exif
        longer, shorter = max(exif.width, exif.height), min(exif.width, exif.height)
        body = " ".join(text for text in (exif.make, exif.model) if text)
        parts = [body, exif.lens] if body or exif.lens else ["unknown (no EXIF)"]
        if focal := same_focal(exif.focal_mm or exif.focal_35mm, focals):
            parts.append(f"{focal:.3g} mm")
        if exif.focal_mm and exif.focal_35mm:  # also shows digital zoom
            parts.append(f"({exif.focal_35mm:.3g} mm on film)")
        parts.append(f"{longer} x {shorter}")
        groups.setdefault(", ".join(dict.fromkeys(part for part in parts if part)), []).append(photo.name)
    return groups
