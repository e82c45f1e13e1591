"""Choice of photo pairs to compare, and connectivity of the capture through matches."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from nerfcli.doctor.compared_pairs import Pair
from nerfcli.doctor.photo_facts import PhotoFacts
from nerfcli.errors import several
from nerfcli.matching.graph import connected_groups
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding, worst
from nerfcli.poses.engine.retrieval import alike, likeness
from nerfcli.poses.input.pairs import ALL_ALIKE_UP_TO
from nerfcli.poses.model.reasons import FEW_MATCHES

# In captures that are not compared exhaustively, each photo is compared with some later ones by name and with its most
# similar ones. The camera hardly moves between consecutive frames of a video, so there are wide steps, too.
STEPS_BY_NAME = (1, 2, 8, 20, 50)
LOOK_ALIKES = 6
# Similar photos are found by this many features of each photo, the largest ones; fewer miss some, more take longer.
_COARSEST = 96


def choose_pairs(photos: Sequence[PhotoFacts]) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, to compare: all of a small capture, about 11 per photo of a large one."""
    count = len(photos)
    if count <= ALL_ALIKE_UP_TO:
        return list(combinations(range(count), 2))
    near = {(i, i + step) for step in STEPS_BY_NAME for i in range(count - step)}
    coarsest = [
        photo.features.descriptors[np.argsort(-photo.features.scales, kind="stable")[:_COARSEST]] for photo in photos
    ]
    shared = likeness(coarsest, lambda stage, done, total: None)
    return sorted(near | set(alike(shared, LOOK_ALIKES, paired=near)))


def pair_count(count: int) -> int:
    """Estimate how many pairs `choose_pairs` chooses."""
    if count <= ALL_ALIKE_UP_TO:
        return count * (count - 1) // 2
    return count * (len(STEPS_BY_NAME) + LOOK_ALIKES)


def apart(count: int, pairs: Sequence[Pair]) -> set[int]:
    """Return the photos outside the largest connected group."""
    parts = connected_groups(range(count), [(pair.first, pair.second) for pair in pairs if pair.linked])
    return {photo for part in parts[1:] for photo in part}


def connectivity(photos: Sequence[PhotoFacts], pairs: Sequence[Pair]) -> Finding:
    """Check whether matches connect all photos, and which photos are only weakly connected."""
    linked = [pair for pair in pairs if pair.linked]
    parts = connected_groups(range(len(photos)), [(pair.first, pair.second) for pair in linked])
    loose = [photo for part in parts[1:] for photo in part]
    best, partners = np.zeros(len(photos), dtype=int), np.zeros(len(photos), dtype=int)
    for pair in linked:
        for photo in (pair.first, pair.second):
            best[photo] = max(best[photo], pair.inliers)
            partners[photo] += 1
    remarks = [(photos[i].name, _apart_text(i, parts)) for i in loose]
    weak = [
        i
        for i in sorted(parts[0], key=lambda photo: (best[photo], partners[photo]))
        if len(photos) > 2 and (best[i] < FEW_MATCHES or partners[i] < 2) and i not in loose
    ]
    remarks += [(photos[i].name, f"{several(partners[i], 'partner')}, best {best[i]} matches") for i in weak]
    fraction = len(parts[0]) / len(photos)
    verdict = worst([GOOD if len(parts) == 1 else BAD if fraction < 0.9 else LOOK, LOOK if weak else GOOD])
    sizes = " + ".join(str(len(part)) for part in parts[:6]) + (" + ..." if len(parts) > 6 else "")
    summary = (
        f"{len(parts)} parts without matches between them: {sizes}" if len(parts) > 1 else "all photos are connected"
    )
    if weak:
        summary += f"; {several(len(weak), 'photo')} only weakly"
    return Finding(
        "connectivity",
        verdict,
        summary,
        fraction,
        f"fraction of photos in the largest part: look below 1, bad below 0.9; per photo: look below {FEW_MATCHES} "
        f"matches with its best partner or fewer than 2 partners",
        "" if verdict == GOOD else "add photos in between, so that each overlaps its neighbours by two thirds",
        tuple(remarks),
    )


def _apart_text(photo: int, parts: Sequence[Sequence[int]]) -> str:
    mine = next(part for part in parts if photo in part)
    return "matches no other photo" if len(mine) == 1 else f"in a part of {len(mine)} photos"
