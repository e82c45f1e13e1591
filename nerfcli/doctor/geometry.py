"""Check from pairs, without poses: do matches connect all photos, does the camera move enough for depth, is the scene
flat, does anything move?
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nerfcli.doctor.compared_pairs import FEWEST_PAIRS, Pair, Patch
from nerfcli.doctor.photo_facts import PhotoFacts
from nerfcli.errors import several
from nerfcli.matching.graph import connected_groups
from nerfcli.matching.stationary import LEAST_FRACTION, together
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding, finding, verdict_above, verdict_below, worst
from nerfcli.poses.model.reasons import FEW_MATCHES

# Baseline over depth: 0.1 is an angle of 6 degrees between two rays to the same point.
BASELINE_LOOK, BASELINE_BAD = 0.08, 0.03
_FLAT_LOOK = 0.8


def apart(count: int, pairs: Sequence[Pair]) -> set[int]:
    """Return the photos outside the largest connected group."""
    parts = connected_groups(range(count), [(pair.first, pair.second) for pair in pairs if pair.linked])
    return {photo for part in parts[1:] for photo in part}


def connectivity(photos: Sequence[PhotoFacts], pairs: Sequence[Pair]) -> Finding:
    """Check whether matches connect all photos, and which photos are only weakly connected."""
    linked = [pair for pair in pairs if pair.linked]
    parts = connected_groups(range(len(photos)), [(pair.first, pair.second) for pair in linked])
    best, partners = np.zeros(len(photos), dtype=int), np.zeros(len(photos), dtype=int)
    for pair in linked:
        for photo in (pair.first, pair.second):
            best[photo] = max(best[photo], pair.inliers)
            partners[photo] += 1
    remarks = [
        (photos[i].name, "matches no other photo" if len(part) == 1 else f"in a part of {len(part)} photos")
        for part in parts[1:]
        for i in part
    ]
    weak = [
        i
        for i in sorted(parts[0], key=lambda photo: (best[photo], partners[photo]))
        if len(photos) > 2 and (best[i] < FEW_MATCHES or partners[i] < 2)
    ]
    remarks += [(photos[i].name, f"{several(partners[i], 'partner')}, best {best[i]} matches") for i in weak]
    fraction = len(parts[0]) / len(photos)
    verdict = worst([GOOD if len(parts) == 1 else BAD if fraction < 0.9 else LOOK, LOOK if weak else GOOD])
    sizes = " + ".join(str(len(part)) for part in parts[:6]) + (" + ..." if len(parts) > 6 else "")
    separate = f"{len(parts)} groups of photos that do not match each other: {sizes}"
    summary = separate if len(parts) > 1 else "all photos are connected"
    if weak:
        summary += f"; {several(len(weak), 'photo')} only weakly"
    threshold = (
        f"fraction of photos in the largest part: look below 1, bad below 0.9; per photo: look below {FEW_MATCHES} "
        f"matches with its best partner or fewer than 2 partners"
    )
    advice = "add photos in between, so that each overlaps its neighbours by two thirds"
    return finding("connectivity", verdict, summary, fraction, threshold, advice=advice, photos=remarks)


def baselines(count: int, pairs: Sequence[Pair]) -> np.ndarray:
    """Return each photo's largest baseline over depth, of three or more the second largest, (count,); NaN for none."""
    found: list[list[float]] = [[] for _ in range(count)]
    for pair in pairs:
        if pair.views is not None:
            for photo in (pair.first, pair.second):
                found[photo].append(pair.views.baseline_over_depth)
    # One wrong pair must not decide for a photo.
    return np.array([sorted(values)[-min(2, 1 + len(values) // 3)] if values else np.nan for values in found])


def movement(photos: Sequence[PhotoFacts], pairs: Sequence[Pair]) -> Finding | None:
    """Check whether the camera moved between photos, or only turned; None without usable pairs."""
    largest = baselines(len(photos), pairs)
    measured = ~np.isnan(largest)
    if not measured.any():
        return None
    middle = float(np.median(largest[measured]))
    standing = [i for i in np.argsort(np.where(measured, largest, np.inf)) if measured[i] and largest[i] < BASELINE_BAD]
    fraction = len(standing) / int(measured.sum())
    verdict = worst([verdict_below(middle, look=BASELINE_LOOK, bad=BASELINE_BAD), LOOK if fraction > 0.1 else GOOD])
    summary = f"median baseline / depth {middle:.2f}"
    if verdict == BAD:
        summary = f"the camera only turned or hardly moved: median baseline / depth {middle:.3f}"
    elif fraction > 0.1:
        summary += f"; {several(len(standing), 'photo')} without sideways movement to any other"
    threshold = f"baseline / depth with the best partner: look below {BASELINE_LOOK}, bad below {BASELINE_BAD}"
    advice = "step sideways between photos by a tenth of the distance to the scene; turning shows no depth"
    remarks = [(photos[i].name, f"baseline / depth {largest[i]:.3f}") for i in standing]
    return finding("movement", verdict, summary, middle, threshold, advice=advice, photos=remarks)


def flatness(pairs: Sequence[Pair]) -> Finding | None:
    """Check whether the scene is flat; None if too few pairs have a large enough baseline."""
    moved = [pair.views for pair in pairs if pair.views is not None and pair.views.baseline_over_depth > BASELINE_LOOK]
    if len(moved) < FEWEST_PAIRS:
        return None
    fraction = float(np.mean([views.flat for views in moved]))
    summary = f"{100 * fraction:.0f} % of {len(moved)} pairs with movement show only a single plane"
    threshold = f"look from {_FLAT_LOOK:g}"
    advice = (
        "a flat scene does not determine the focal length: include objects at other distances, or give --intrinsics"
    )
    verdict = verdict_above(fraction, look=_FLAT_LOOK, bad=np.inf)
    return finding("depth relief", verdict, summary, fraction, threshold, advice=advice)


def moving_content(photos: Sequence[PhotoFacts], pairs: Sequence[Pair]) -> Finding:
    """Find photos with independent motion, which several of their pairs see at the same place."""
    seen: dict[int, list[tuple[tuple[float, float, float, float], Patch]]] = {}
    for pair in pairs:
        for patch in pair.patches:
            seen.setdefault(pair.first, []).append((patch.box, patch))
            seen.setdefault(pair.second, []).append((patch.other_box, patch))
    moving_photos = []
    still = False
    for photo, boxes in seen.items():
        confirmed = [
            (box, patch) for box, patch in boxes if sum(_overlap(box, other) for other, _ in boxes) >= FEWEST_PAIRS
        ]
        if confirmed:
            (left, top, right, bottom), patch = max(confirmed, key=lambda item: item[1].matches)
            still = still or patch.still
            width, height = photos[photo].features.size
            across, down = 100 * (left + right) / 2 / width, 100 * (top + bottom) / 2 / height
            stays = ", fixed in the image" if patch.still else ""
            where = f"at {across:.0f} % across, {down:.0f} % down{stays}"
            moving_photos.append((patch.matches, photos[photo].name, where))
    fraction, threshold = len(moving_photos) / len(photos), "look from 1 photo, bad from half of them"
    advice = "mask it: moving objects become fog, and disturb poses"
    if still:
        advice += "; content fixed in the image is a watermark, a strap, or the background of a turntable"
    summary = f"independent movement in {several(len(moving_photos), 'photo')}" if moving_photos else "none found"
    remarks = ((name, what) for _, name, what in sorted(moving_photos, reverse=True))
    verdict = BAD if fraction >= 0.5 else LOOK if moving_photos else GOOD
    return finding("moving content", verdict, summary, fraction, threshold, advice=advice, photos=remarks)


def turning_object(pairs: Sequence[Pair]) -> Finding | None:
    """Return a finding if an object turns before a static background, where other checks of movement do not apply."""
    motions = together([pair.motions for pair in pairs if pair.motions is not None])
    others = sum(pair.linked and pair.motions is None for pair in pairs)
    motions = replace(motions, moved=motions.moved + others)
    if not motions.found:
        return None
    summary = (
        f"an object moves in front of a static background, as on a turntable: {motions.two} of "
        f"{motions.two + motions.still + motions.moved} pairs show both motions"
    )
    threshold = f"look if {100 * LEAST_FRACTION:g} % of the pairs with a moving object also show a static background"
    advice = (
        "nerfcli poses creates masks of the object and uses only its motion; if it finds none, give --masks that are "
        "white on the object, or use a plain cloth as background"
    )
    return Finding("turning object", LOOK, summary, motions.fraction, threshold, advice)


def _overlap(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
    """Return whether two boxes share at least a third of the smaller one."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    smaller = min((box[2] - box[0]) * (box[3] - box[1]) for box in (one, other))
    return width > 0 and height > 0 and width * height >= smaller / 3
