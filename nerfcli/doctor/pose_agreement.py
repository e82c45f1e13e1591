"""Check the given poses of a scene against the verified matches of its photos.

A field trained with one wrong pose has fog there, and nothing says why. Matches do: at any depth, the ray of one photo
is in the epipolar plane, which contains the ray of the other photo and the baseline.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.frame import Frame
from nerfcli.doctor.compared_pairs import FEWEST_PAIRS, Pair
from nerfcli.doctor.photo_facts import PhotoFacts
from nerfcli.errors import several
from nerfcli.matching.epipolar import sampson_angles
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding
from nerfcli.poses.model.reasons import FEW_MATCHES

# Photos that look alike match at the wrong place, too. They have fewer matches than true neighbours, so the strongest
# pairs of a photo decide.
_STRONGEST = 6
# A pair contradicts its poses from this median error on, or from this multiple of the capture's, since poses by
# tracking are off by pixels everywhere.
_CONTRADICTS_PX, _TIMES_USUAL = 4.0, 5.0
# For the whole capture; poses by tracking are off by pixels, and those read with wrong conventions by tens of pixels.
USUAL_LOOK_PX, USUAL_BAD_PX = 1.0, 5.0
# The two rays of a match must differ by this much for it to mean anything that they meet behind a camera.
_LEAST_PARALLAX_PX = 10.0

_ALL_WRONG = (
    "nerfcli convert SCENE --detect tests whether the cameras were read with the right conventions; nerfcli poses "
    "estimates them from the photos"
)
_SOME_WRONG = "remove these photos from the scene, or estimate all poses from the photos with nerfcli poses"
_INACCURATE = (
    "poses by tracking drift, and focal lengths are off at times: train optimizes them if matches suggest it; "
    "nerfcli poses on the photos may do better"
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
    found = []
    for pair in pairs:
        if pair.linked and pair.agreeing is not None:
            error_px, behind = _compared_with_poses(pair, frames, photos)
            if np.isfinite(error_px):
                found.append(PairError(pair.first, pair.second, pair.inliers, error_px, behind))
    return found


def agreement(photos: Sequence[PhotoFacts], errors: Sequence[PairError]) -> Finding | None:
    """Check whether the matches of each photo agree with the given poses; None without a photo with enough pairs."""
    usual_px, measured = usual(errors, len(photos))
    if not measured:
        return None
    limit_px = contradicts_from_px(usual_px)
    named = contradicting(errors, len(photos), limit_px=limit_px)
    behind = float(np.mean([pair.behind for pair in errors if pair.matches >= FEW_MATCHES]))
    summary = f"median epipolar error {usual_px:.2g} px"
    threshold = (
        f"all photos: look from {USUAL_LOOK_PX:g} px, bad from {USUAL_BAD_PX:g} px; a photo: bad if most of its "
        f"{_STRONGEST} strongest pairs are off by {limit_px:.2g} px"
    )
    if usual_px >= USUAL_BAD_PX or len(named) > 0.5 * measured or behind > 0.5:
        where = f", and {100 * behind:.0f} % of the pairs meet behind a camera" if behind > 0.5 else ""
        summary = f"the matches contradict the cameras as a whole: {summary}{where}"
        return Finding("poses", BAD, summary, usual_px, threshold, _ALL_WRONG)
    if named:
        summary = f"{summary}; {several(len(named), 'photo')} contradicted by most of their matches"
        remarks = tuple((photos[index].name, f"off by {error_px:.0f} px") for index, error_px in named)
        return Finding("poses", BAD, summary, usual_px, threshold, _SOME_WRONG, remarks)
    look = usual_px >= USUAL_LOOK_PX
    return Finding("poses", LOOK if look else GOOD, summary, usual_px, threshold, _INACCURATE if look else "")


def contradicting(errors: Sequence[PairError], count: int, *, limit_px: float) -> list[tuple[int, float]]:
    """Find the photos most of whose strongest pairs are off by more than a limit; return them with their median error.

    The photo with the largest fraction of such pairs is removed first, so that a wrong pose does not accuse its
    neighbours.
    """
    left, named = list(errors), []
    while True:
        suspects = []
        for index, values in enumerate(_strongest(left, count)):
            if len(values) >= FEWEST_PAIRS and np.mean(np.array(values) > limit_px) > 0.5:
                suspects.append((float(np.mean(np.array(values) > limit_px)), float(np.median(values)), index))
        if not suspects:
            return sorted(named, key=lambda item: -item[1])
        _, error_px, index = max(suspects)
        named.append((index, error_px))
        left = [pair for pair in left if index not in (pair.first, pair.second)]


def contradicts_from_px(usual_px: float) -> float:
    """Return the error in pixels from which on a pair contradicts its poses, by the usual error of the capture."""
    return max(_CONTRADICTS_PX, _TIMES_USUAL * usual_px)


def usual(errors: Sequence[PairError], count: int) -> tuple[float, int]:
    """Return the median over photos of the median error of their strongest pairs, and how many photos have enough."""
    medians = [np.median(values) for values in _strongest(errors, count) if len(values) >= FEWEST_PAIRS]
    return (float(np.median(medians)) if medians else float("nan")), len(medians)


def _strongest(errors: Sequence[PairError], count: int) -> list[list[float]]:
    """Return the errors of the pairs of each photo with the most matches."""
    of_photo: list[list[float]] = [[] for _ in range(count)]
    for pair in sorted(errors, key=lambda pair: -pair.matches):
        for index in (pair.first, pair.second):
            if pair.matches >= FEW_MATCHES and len(of_photo[index]) < _STRONGEST:
                of_photo[index].append(pair.error_px)
    return of_photo


def _compared_with_poses(pair: Pair, frames: Sequence[Frame], photos: Sequence[PhotoFacts]) -> tuple[float, bool]:
    """Return the median error of the matches of a pair in pixels, NaN if the cameras see none of them, and whether most
    of their points are behind a camera."""
    assert pair.agreeing is not None
    directions, valid, focals_px = [], np.ones(len(pair.agreeing[0]), dtype=bool), []
    for index, pixels in zip((pair.first, pair.second), pair.agreeing, strict=True):
        camera, (width, height) = frames[index].camera, photos[index].features.size
        bearings, seen = camera.bearings(pixels * (camera.width / width, camera.height / height))
        directions.append(bearings)
        valid &= seen
        focals_px.append(camera.focal_px * width / camera.width)
    if not valid.any():
        return float("nan"), False
    second_from_first = rigid.inverse(frames[pair.second].world_from_cam) @ frames[pair.first].world_from_cam
    rotation, t = second_from_first[:3, :3], second_from_first[:3, 3]
    first, second = (bearings[valid] for bearings in directions)
    angles, behind = sampson_angles(first, second, rotation, t)
    turned = first @ rotation.T
    parallax = np.arctan2(np.linalg.norm(np.cross(turned, second), axis=1), (turned * second).sum(axis=1))
    focal_px = float(np.mean(focals_px))
    meet_behind = behind & (parallax * focal_px > _LEAST_PARALLAX_PX)
    # Without a baseline both rays should have the same direction.
    errors = np.where(np.isnan(angles), parallax, angles)
    return focal_px * float(np.median(errors)), float(np.mean(meet_behind)) > 0.5
