"""Check the given poses of a scene against the verified matches of its photos.

A field trained with one wrong pose has fog there, and nothing says why. Matches do.

Structure from motion also joins photos by the few matches of things that look alike, such as the two sides of a
vehicle. The photos of such a group agree with each other, so no pair of them contradicts its poses. But photos next to
them in space show something else.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from nerfcli.cameras import rigid
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import centres_of, views_of
from nerfcli.doctor.compared_pairs import FEWEST_PAIRS, Pair
from nerfcli.doctor.photo_facts import PhotoFacts
from nerfcli.errors import several
from nerfcli.matching.agreement import agreement, rays_of
from nerfcli.matching.graph import connected_groups
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding
from nerfcli.poses.input.pairs import pairs_of_nearest
from nerfcli.poses.model.reasons import FEW_MATCHES

# Photos that look alike match at the wrong place, too. They have fewer matches than true neighbours, so the strongest
# pairs of a photo decide.
_STRONGEST = 6
# A pair contradicts its poses from this median error on, or from this multiple of the capture's, since poses by
# tracking are off by pixels everywhere.
_CONTRADICTS_PX, _TIMES_USUAL = 4.0, 5.0
# For the whole capture; poses by tracking are off by pixels, and those read with wrong conventions by tens of pixels.
_USUAL_LOOK_PX, _USUAL_BAD_PX = 1.0, 5.0
# The two rays of a match must differ by this much for it to mean anything that they meet behind a camera.
_LEAST_PARALLAX_PX = 10.0
# Number of nearest cameras to which each photo is compared in addition to the pairs chosen without poses.
NEAREST = 4
# Cameras are neighbours up to this multiple of the median distance to the nearest camera, if their axes are within this
# angle of each other. In sound captures nearly all of them match.
_NEAR, _SAME_WAY_COS = 2.0, np.cos(np.radians(20.0))
# Only where neighbours nearly always match does it mean anything that some do not.
_USUALLY_MATCH, _FEWEST_NEIGHBOURS = 0.95, 20

_ALL_WRONG = (
    "nerfcli convert SCENE --detect tests whether the cameras were read with the right conventions; nerfcli poses "
    "estimates them from the photos"
)
_SOME_WRONG = "remove these photos from the scene, or estimate all poses from the photos with nerfcli poses"
_MISPLACED = (
    "compare these photos with their neighbours: things that look alike, such as two sides of an object, mislead "
    "structure from motion; remove them from the scene, or estimate poses from the photos with nerfcli poses"
)
_INACCURATE = (
    "poses from tracking drift, and their focal lengths may be wrong: train refines them if matches show it; nerfcli "
    "poses on the photos may do better"
)


@dataclass(frozen=True)
class PairError:
    """How well the matches of two photos fit their poses.

    Args:
        matches: number of verified matches.
        error_px: their median distance from the epipolar geometry of the poses, at `photo_facts.LONGER_SIDE_PX`.
        behind: whether the poses put most of their points behind a camera.
    """

    first: int
    second: int
    matches: int
    error_px: float
    behind: bool


def pair_errors(frames: Sequence[Frame], photos: Sequence[PhotoFacts], pairs: Sequence[Pair]) -> list[PairError]:
    """Measure how well the matches of each linked pair fit the poses.

    An error is at most the distance by which the pose moves the point in the picture, so pairs with little parallax
    have small errors, however uncertain the direction of their baseline is. `frames` are in the order of `photos`.
    """
    errors = []
    for pair in pairs:
        if not pair.linked or pair.agreeing is None:
            continue
        rays, focals_px = [], []
        for index, pixels in zip((pair.first, pair.second), pair.agreeing, strict=True):
            camera, (width, height) = frames[index].camera, photos[index].features.size
            scaled = pixels * (camera.width / width, camera.height / height)
            rays.append(rays_of([camera], np.zeros(len(pixels), dtype=np.int64), scaled))
            focals_px.append(camera.focal_px * width / camera.width)
        second_from_first = rigid.inverse(frames[pair.second].world_from_cam) @ frames[pair.first].world_from_cam
        found = agreement(rays[0], rays[1], second_from_first, focal_px=float(np.mean(focals_px)))
        if found.count:
            behind = np.sum(found.behind & (found.parallax_px > _LEAST_PARALLAX_PX)) > 0.5 * found.count
            error_px = float(np.nanmedian(np.abs(found.sampson_px)))
            errors.append(PairError(pair.first, pair.second, pair.inliers, error_px, bool(behind)))
    return errors


def poses_by_matches(photos: Sequence[PhotoFacts], errors: Sequence[PairError]) -> Finding | None:
    """Check whether the matches of each photo agree with the given poses; None without a photo with enough pairs."""
    usual_px, limit_px, measured = _usual(errors, len(photos))
    if not measured:
        return None
    named = contradicting(errors, len(photos), limit_px=limit_px)
    behind = float(np.mean([pair.behind for pair in errors if pair.matches >= FEW_MATCHES]))
    summary = f"median epipolar error {usual_px:.2g} px"
    threshold = (
        f"all photos: look from {_USUAL_LOOK_PX:g} px, bad from {_USUAL_BAD_PX:g} px; a photo: bad if most of its "
        f"{_STRONGEST} strongest pairs are off by {limit_px:.2g} px"
    )
    if usual_px >= _USUAL_BAD_PX or len(named) > 0.5 * measured or behind > 0.5:
        where = f", and {100 * behind:.0f} % of the pairs meet behind a camera" if behind > 0.5 else ""
        summary = f"the matches contradict the cameras as a whole: {summary}{where}"
        return Finding("poses", BAD, summary, usual_px, threshold, _ALL_WRONG)
    if named:
        summary = f"{summary}; {several(len(named), 'photo')} contradicted by most of their matches"
        remarks = tuple((photos[index].name, f"off by {error_px:.0f} px") for index, error_px in named)
        return Finding("poses", BAD, summary, usual_px, threshold, _SOME_WRONG, remarks)
    look = usual_px >= _USUAL_LOOK_PX
    return Finding("poses", LOOK if look else GOOD, summary, usual_px, threshold, _INACCURATE if look else "")


def nearest_pairs(frames: Sequence[Frame]) -> set[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of each camera with its nearest ones that look the same way."""
    return pairs_of_nearest(_distances(frames), NEAREST)


def misplaced_groups(
    frames: Sequence[Frame], photos: Sequence[PhotoFacts], errors: Sequence[PairError], pairs: Sequence[Pair]
) -> Finding | None:
    """Check whether groups of photos match each other, but none of their neighbours; None where this tells nothing.

    It tells nothing if neighbours in the rest of the capture often do not match, either, or if all cameras are wrong.
    `errors` are those of the linked pairs, `pairs` all pairs that were compared.
    """
    usual_px, limit_px, measured = _usual(errors, len(photos))
    if not measured or usual_px >= _USUAL_BAD_PX:
        return None
    agreeing = {(pair.first, pair.second) for pair in errors if pair.error_px < limit_px}
    groups = connected_groups(range(len(frames)), agreeing)
    distances = _distances(frames)
    nearest = distances.min(axis=1)
    near = _NEAR * float(np.median(nearest[np.isfinite(nearest)])) if np.isfinite(nearest).any() else 0.0
    neighbours = [(pair.first, pair.second) for pair in pairs if distances[pair.first, pair.second] <= near]
    main = set(groups[0])
    match = [pair in agreeing for pair in neighbours if main.issuperset(pair)]
    if len(match) < _FEWEST_NEIGHBOURS or np.mean(match) < _USUALLY_MATCH:
        return None
    misplaced = [(group, count) for group in groups[1:] if (count := _strangers(group, main, neighbours)) > 0]
    total = sum(len(group) for group, _ in misplaced)
    threshold = (
        f"a group of photos: bad if none of its {NEAREST} neighbouring pairs or more match, where "
        f"{100 * _USUALLY_MATCH:.0f} % of the others do"
    )
    if not misplaced:
        summary = f"{100 * np.mean(match):.0f} % of {len(match)} pairs of neighbouring cameras match"
        return Finding("places", GOOD, summary, total, threshold, "")
    summary = f"{several(total, 'photo')} match each other, but none of the photos taken next to them by their poses"
    remarks = tuple(
        (photos[index].name, f"in a group of {len(group)}; none of its {count} neighbouring pairs matches")
        for group, count in misplaced
        for index in group
    )
    return Finding("places", BAD, summary, total, threshold, _MISPLACED, remarks)


def contradicting(errors: Sequence[PairError], count: int, *, limit_px: float) -> list[tuple[int, float]]:
    """Find the photos most of whose strongest pairs are off by more than a limit; return them with their median error.

    The photo with the largest fraction of such pairs is removed first, so that a wrong pose does not accuse its
    neighbours.
    """
    left, named = list(errors), []
    while True:
        suspects = []
        for index, values in enumerate(_strongest(left, count)):
            share = float(np.mean(np.array(values) > limit_px)) if len(values) >= FEWEST_PAIRS else 0.0
            if share > 0.5:
                suspects.append((share, float(np.median(values)), index))
        if not suspects:
            return sorted(named, key=lambda item: -item[1])
        _, error_px, index = max(suspects)
        named.append((index, error_px))
        left = [pair for pair in left if index not in (pair.first, pair.second)]


def _usual(errors: Sequence[PairError], count: int) -> tuple[float, float, int]:
    """Return the median over photos of the median error of their strongest pairs, from which error on a pair then
    contradicts its poses, and how many photos have enough pairs."""
    medians = [np.median(values) for values in _strongest(errors, count) if len(values) >= FEWEST_PAIRS]
    usual_px = float(np.median(medians)) if medians else float("nan")
    return usual_px, max(_CONTRADICTS_PX, _TIMES_USUAL * usual_px), len(medians)


def _strongest(errors: Sequence[PairError], count: int) -> list[list[float]]:
    """Return the errors of the pairs of each photo with the most matches."""
    of_photo: list[list[float]] = [[] for _ in range(count)]
    for pair in sorted(errors, key=lambda pair: -pair.matches):
        for index in (pair.first, pair.second):
            if pair.matches >= FEW_MATCHES and len(of_photo[index]) < _STRONGEST:
                of_photo[index].append(pair.error_px)
    return of_photo


def _strangers(group: Sequence[int], main: set[int], neighbours: Sequence[tuple[int, int]]) -> int:
    """Return how many pairs of neighbours a group has with the largest one, or 0 if they do not suffice for a verdict.

    None of them agrees with the poses, or the groups would be one.
    """
    inside = set(group)
    across = [pair for pair in neighbours if len(inside & set(pair)) == 1 and len(main & set(pair)) == 1]
    own = {index for pair in across for index in pair if index in inside}
    return len(across) if len(own) > 1 and len(across) >= NEAREST else 0


def _distances(frames: Sequence[Frame]) -> np.ndarray:
    """Return the distances (frames, frames) between cameras; infinite if they look different ways."""
    centres, views = centres_of(frames), views_of(frames)
    distances = cdist(centres, centres)
    distances[views @ views.T < _SAME_WAY_COS] = np.inf
    np.fill_diagonal(distances, np.inf)
    return distances
