"""Find groups of photos that are placed at the wrong side of a scene.

Structure from motion joins photos by the few matches of things that look alike, such as the two sides of a vehicle. The
photos of such a group agree with each other, so no pair of them contradicts its poses. But photos next to them in space
show something else.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.distance import cdist

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import centres_of, views_of
from nerfcli.doctor.compared_pairs import Pair
from nerfcli.doctor.photo_facts import PhotoFacts
from nerfcli.doctor.pose_agreement import USUAL_BAD_PX, PairError, contradicts_from_px, usual
from nerfcli.errors import several
from nerfcli.matching.graph import connected_groups
from nerfcli.pages.findings import BAD, GOOD, Finding

# Number of nearest cameras to which each photo is compared in addition to the pairs chosen without poses.
NEAREST = 4
# Cameras are neighbours up to this multiple of the median distance to the nearest camera, if their axes are within this
# angle of each other. In sound captures nearly all of them match.
_NEAR, _SAME_WAY_COS = 2.0, np.cos(np.radians(20.0))
# Only where neighbours nearly always match does it mean anything that some do not.
_USUALLY_MATCH, _FEWEST_NEIGHBOURS = 0.95, 20


def nearest_pairs(frames: Sequence[Frame]) -> set[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of each camera with its nearest ones that look the same way."""
    distances = _distances(frames)
    pairs: set[tuple[int, int]] = set()
    for index, row in enumerate(distances):
        nearest = np.argsort(row, kind="stable")[:NEAREST]
        pairs |= {(min(index, int(other)), max(index, int(other))) for other in nearest if np.isfinite(row[other])}
    return pairs


def misplaced_groups(
    frames: Sequence[Frame],
    photos: Sequence[PhotoFacts],
    errors: Sequence[PairError],
    pairs: Sequence[Pair],
) -> Finding | None:
    """Check whether groups of photos match each other, but none of their neighbours; None where this tells nothing.

    It tells nothing if neighbours in the rest of the capture often do not match, either, or if all cameras are wrong.
    `errors` are those of the linked pairs, `pairs` all pairs that were compared.
    """
    usual_px, measured = usual(errors, len(photos))
    if not measured or usual_px >= USUAL_BAD_PX:
        return None
    limit_px = contradicts_from_px(usual_px)
    agreeing = {(pair.first, pair.second) for pair in errors if pair.error_px < limit_px}
    groups = connected_groups(range(len(frames)), agreeing)
    neighbours = _neighbours(frames, [(pair.first, pair.second) for pair in pairs])
    main = set(groups[0])
    match = [pair in agreeing for pair in neighbours if main.issuperset(pair)]
    if len(match) < _FEWEST_NEIGHBOURS or np.mean(match) < _USUALLY_MATCH:
        return None
    misplaced = [(group, count) for group in groups[1:] if (count := _strangers(group, main, neighbours)) > 0]
    total = sum(len(group) for group, _ in misplaced)
    if not misplaced:
        summary = f"{100 * np.mean(match):.0f} % of {len(match)} pairs of neighbouring cameras match"
    else:
        summary = (
            f"{several(total, 'photo')} match each other, but none of the photos taken next to them by their poses"
        )
    return Finding(
        "places",
        BAD if misplaced else GOOD,
        summary,
        total,
        f"a group of photos: bad if none of its {NEAREST} neighbouring pairs or more match, where "
        f"{100 * _USUALLY_MATCH:.0f} % of the others do",
        "compare these photos with their neighbours: things that look alike, such as two sides of an object, mislead "
        "structure from motion; remove them from the scene, or estimate poses from the photos with nerfcli poses"
        if misplaced
        else "",
        tuple(
            (photos[index].name, f"in a group of {len(group)}; none of its {count} neighbouring pairs matches")
            for group, count in misplaced
            for index in group
        ),
    )


def _strangers(group: Sequence[int], main: set[int], neighbours: Sequence[tuple[int, int]]) -> int:
    """Return how many pairs of neighbours a group has with the largest one, or 0 if they do not suffice for a verdict.

    None of them agrees with the poses, or the groups would be one.
    """
    inside = set(group)
    across = [pair for pair in neighbours if len(inside & set(pair)) == 1 and len(main & set(pair)) == 1]
    own = {index for pair in across for index in pair if index in inside}
    return len(across) if len(own) > 1 and len(across) >= NEAREST else 0


def _neighbours(frames: Sequence[Frame], compared: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return those of the compared pairs whose cameras are next to each other."""
    distances = _distances(frames)
    nearest = distances.min(axis=1)
    finite = nearest[np.isfinite(nearest)]
    limit = _NEAR * float(np.median(finite)) if len(finite) else 0.0
    return [pair for pair in compared if distances[pair] <= limit]


def _distances(frames: Sequence[Frame]) -> np.ndarray:
    """Return the distances (frames, frames) between cameras; infinite if they look different ways."""
    centres, views = centres_of(frames), views_of(frames)
    distances = cdist(centres, centres)
    distances[views @ views.T < _SAME_WAY_COS] = np.inf
    np.fill_diagonal(distances, np.inf)
    return distances
