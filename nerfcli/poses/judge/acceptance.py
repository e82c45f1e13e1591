"""Acceptance of a model, based on evidence that the mapper did not choose itself.

The number of placed photos and the reprojection error say little: a wrong model has discarded what contradicts it. So
the verified matches of all pairs are tested again, and so are observations held out from the adjustment.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pycolmap

from nerfcli.poses.input.job import Job, Solver
from nerfcli.poses.judge.checks import Checks, checks_of
from nerfcli.poses.judge.contradictions import Contradiction, strong_contradictions
from nerfcli.poses.judge.parallax import RotationFit
from nerfcli.poses.model import held_out
from nerfcli.poses.model.lens_evidence import lenses_of
from nerfcli.poses.model.lens_observability import is_centred
from nerfcli.poses.model.reasons import MIN_MATCHES
from nerfcli.poses.model.two_views import PairAgreement, RotationError, VerifiedPair, agreements, rotation_errors

# Largest fraction of all matches in pairs that strongly contradict the model, as of a scene that repeats itself.
_MOST_RIVALS = 0.05
_GROSS_DEG = 10.0
_MOST_GROSS = 0.2
# Root mean square distance of the cameras from their centre, over the median distance to the points.
_LEAST_SPREAD = 0.003
# Focal lengths over the longer side. A model without depth may have any; if only cameras of a few photos are outside
# the usual range, the points of the others determine them. Photos from the internet have up to 3 times and more, and so
# do cropped photos by macro lenses: a focal length that the photos determine may also be in the wider range.
_FOCAL_RANGE, _WIDER_FOCAL_RANGE, _FEW = (0.3, 3.0), (0.2, 10.0), 0.1
# Parallax over the error of unused observations: with less, the points of a model explain matches hardly better than a
# rotation does.
_LEAST_GAIN = 3.5
# Reported if the measurement failed.
_UNKNOWN_GEOMETRY: dict[str, Any] = dict.fromkeys(
    ("triangulation_angle_deg", "share_in_front", "camera_spread_over_distance")
)
_UNKNOWN_HELD_OUT: dict[str, Any] = dict.fromkeys(
    ("observations", "median_px", "share_above_8_px", "principal_points_central")
)


@dataclass(frozen=True)
class Failure:
    """Reason to refuse a model: its kind in a few words, the numbers, and advice."""

    kind: str
    evidence: str
    advice: str


@dataclass(frozen=True)
class Verdict:
    """Measurements of a model and the resulting failures; `failures` is empty if it is accepted."""

    measures: dict[str, Any]
    failures: tuple[Failure, ...]

    @property
    def accepted(self) -> bool:
        """True if there are no failures."""
        return not self.failures

    def to_json(self) -> dict[str, Any]:
        """Return plain lists and dictionaries."""
        return {"accepted": self.accepted, **asdict(self)}


def judge(
    model: pycolmap.Reconstruction,
    pairs: Sequence[VerifiedPair],
    job: Job,
    *,
    turn: RotationFit | None = None,
    held: Sequence[VerifiedPair] = (),
    determined: Collection[int] = (),
    checks: Checks | None = None,
) -> Verdict:
    """Measure a converged model of a job's photos against the evidence and decide whether to accept it.

    A value that cannot be measured is None, and counts neither for nor against the model.

    Args:
        turn: how well rotations of the camera alone explain the matches.
        held: pairs that support photos located from points of the model, see `locate.shared_pairs`.
        determined: ids of cameras whose focal lengths are known to 1 %, see `lens_observability.focal_is_determined`.
    """
    run = (checks or checks_of(job)).run
    found: list[PairAgreement] = run("agreement of pairs", lambda: agreements(model, pairs), otherwise=[])
    rotations: list[RotationError] = run(
        "rotations of pairs", lambda: rotation_errors(model, pairs, job.solver), otherwise=[]
    )
    contradictions: list[Contradiction] = run(
        "contradictions",
        lambda: strong_contradictions(model, [*found, *agreements(model, held)], job.name_of),
        otherwise=[],
    )
    total = sum(a.matches for a in found)
    fraction = sum(c.matches for c in contradictions) / total if total else 0.0
    geometry = run("geometry of points and cameras", lambda: _geometry(model), otherwise=_UNKNOWN_GEOMETRY)
    focal = [_focal_measure(camera) for camera in _cameras_in_use(model) if not camera.is_spherical()]
    unused = run("unused observations", lambda: _held_out_measure(model, job.solver), otherwise=_UNKNOWN_HELD_OUT)
    counts = [model.image(photo).num_points3D for photo in model.reg_image_ids()] or [0]
    measures: dict[str, Any] = {
        "pairs": {
            "judged": len(found),
            "contradicting": sum(a.contradicts for a in found),
            "share_of_matches_that_agree": sum(a.matches * a.fraction for a in found) / total if total else None,
        },
        "strong_contradictions": [asdict(c) for c in contradictions[:20]],
        "strong_contradictions_share": fraction,
        "rotations": _rotation_measure(rotations),
        "parallax_px": None if turn is None else turn.parallax_px,
        **geometry,
        "focal_over_longer_side": focal,
        "held_out": unused,
        "observations_per_photo": {"median": float(np.median(counts)), "least": int(min(counts))},
    }
    failures = [
        *_no_baseline(turn, geometry, unused["median_px"]),
        *_contradicted(contradictions, fraction, found),
        *_turned(measures["rotations"]),
        *_implausible(model, measures, given=job.given_cameras, determined=determined),
    ]
    return Verdict(measures, tuple(failures))


def nothing_placed(turn: RotationFit | None) -> Verdict:
    """Return the verdict on a capture without a model: only whether the camera moved."""
    measures = {"parallax_px": None if turn is None else turn.parallax_px}
    return Verdict(measures, tuple(_no_baseline(turn, _UNKNOWN_GEOMETRY, None)))


def _geometry(model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Measure the triangulation angles, the fraction of observations in front, and the spread of the cameras."""
    photos = sorted(model.reg_image_ids())
    centres = np.array([model.image(photo).projection_center() for photo in photos]).reshape(-1, 3)
    forward = np.array([model.image(photo).viewing_direction() for photo in photos]).reshape(-1, 3)
    wide = np.array([_sees_behind(model.camera(model.image(photo).camera_id)) for photo in photos])
    places = {photo: place for place, photo in enumerate(photos)}
    # Points that the same number of photos see are measured together.
    by_count: dict[int, list[tuple[Any, list[int]]]] = {}
    for point in model.points3D.values():
        seen = [places[photo] for photo in {element.image_id for element in point.track.elements}]
        by_count.setdefault(len(seen), []).append((point.xyz, seen))
    angles, distances, in_front, observations = [], [], 0, 0
    # A million cosines between directions to points are in memory at a time.
    for count, alike in by_count.items():
        step = max(1, 2**20 // count**2)
        for part in (alike[first : first + step] for first in range(0, len(alike), step)):
            positions, seen_by = (np.array(each) for each in zip(*part, strict=True))  # (n, 3) and (n, photos)
            to = positions[:, None] - centres[seen_by]
            lengths = np.linalg.norm(to, axis=2)
            directions = to / np.maximum(lengths, 1e-300)[..., None]
            angles.append(np.arccos(np.clip((directions @ directions.swapaxes(1, 2)).min(axis=(1, 2)), -1, 1)))
            distances.append(np.median(lengths, axis=1))
            in_front += int((wide[seen_by] | ((directions * forward[seen_by]).sum(axis=2) > 0)).sum())
            observations += seen_by.size
    middle = np.mean(centres, axis=0)
    spread = np.sqrt(np.mean(np.sum((centres - middle) ** 2, axis=1)))
    return {
        "triangulation_angle_deg": float(np.degrees(np.median(np.concatenate(angles)))) if angles else None,
        "share_in_front": in_front / observations if observations else None,
        "camera_spread_over_distance": float(spread / np.median(np.concatenate(distances))) if distances else None,
    }


def _cameras_in_use(model: pycolmap.Reconstruction) -> list[pycolmap.Camera]:
    return [model.cameras[camera_id] for camera_id in sorted(set(lenses_of(model).values()))]


def _sees_behind(camera: pycolmap.Camera) -> bool:
    return camera.is_perspective_fisheye() or camera.is_spherical()


def _focal_measure(camera: pycolmap.Camera) -> float:
    return camera.mean_focal_length() / max(camera.width, camera.height)


def _held_out_measure(model: pycolmap.Reconstruction, solver: Solver) -> dict[str, Any]:
    training, held = held_out.split(model, seed=solver.seed)
    # The lens was chosen before; a principal point that was freed is not moved again.
    held_out.adjust(training, solver)
    errors = held_out.errors_px(training, held)
    return {
        "observations": len(errors),
        "median_px": float(np.median(errors)) if len(errors) else None,
        "share_above_8_px": float((errors > 8).mean()) if len(errors) else None,
        "principal_points_central": all(c.is_spherical() or is_centred(c) for c in _cameras_in_use(model)),
    }


def _rotation_measure(errors: Sequence[RotationError]) -> dict[str, Any]:
    weights = sum(error.weight for error in errors)
    gross = sum(error.weight for error in errors if error.degrees > _GROSS_DEG)
    return {
        "pairs": len(errors),
        "median_deg": float(np.median([error.degrees for error in errors])) if errors else None,
        "gross_share": gross / weights if weights else None,
    }


def _no_baseline(turn: RotationFit | None, geometry: Mapping[str, Any], held_out_px: float | None) -> list[Failure]:
    """Return the failure if a rotation explains the matches nearly as well, or if the cameras are all in one place.

    Parallax in pixels is also small in small photos and far from the scene, where a model may still be right.
    """
    spread = geometry["camera_spread_over_distance"]
    advice = "take the photos while walking around the scene or sideways; turning on the spot gives no depth"
    if turn is not None and turn.explains_all and turn.parallax_px < _LEAST_GAIN * (held_out_px or np.inf):
        evidence = f"a rotation of the camera without translation explains all matches to {turn.parallax_px:.1f} px"
        if turn.stands_still:
            evidence = (
                f"the camera stands still: matches are at the same place in all photos, to {turn.moved_px:.1f} px"
            )
            advice = "walk around the scene; if something turns in front of the camera, give --masks, white where it is"
    elif spread is not None and spread < _LEAST_SPREAD:
        evidence = f"the cameras are spread over only {100 * spread:.2f} % of their distance from the scene"
    else:
        return []
    return [Failure("no baseline (pure rotation)", evidence, advice)]


def _contradicted(
    contradictions: Sequence[Contradiction], fraction: float, found: Sequence[PairAgreement]
) -> list[Failure]:
    rivals = sum(c.matches for c in contradictions if c.is_rival)
    outweighing = [c for c in contradictions if c.outweighs]
    if fraction > _MOST_RIVALS and rivals > sum(c.matches for c in contradictions) / 2:
        kind = "parts of the scene look alike (repeated structure)"
        count = sum(a.contradicts for a in found)
        evidence = f"{count} of {len(found)} pairs contradict the poses, with as many matches as those that agree"
        advice = (
            "include distinctive surroundings in photos of the parts that look alike, or photograph each part "
            "separately"
        )
    elif outweighing:
        kind = "the poses contradict the strongest matches"
        first = outweighing[0]
        also = f" and {len(outweighing) - 1} more pairs" if len(outweighing) > 1 else ""
        matches = f"the {first.matches} verified matches between {first.one} and {first.other}"
        evidence = f"{matches} are inconsistent with the estimated poses{also}"
        advice = "take more photos between these two, with more overlap"
    else:
        return []
    return [Failure(kind, evidence, advice)]


def _turned(rotations: Mapping[str, Any]) -> list[Failure]:
    gross = rotations["gross_share"]
    if gross is None or gross <= _MOST_GROSS:
        return []
    evidence = (
        f"{100 * gross:.0f} % of the matches are in pairs whose relative rotation differs from the poses by more than "
        f"{_GROSS_DEG:.0f} degrees"
    )
    return [Failure("the poses contradict pairs of photos", evidence, "take more photos, with more overlap")]


def _implausible(
    model: pycolmap.Reconstruction,
    measures: Mapping[str, Any],
    *,
    given: Collection[int],
    determined: Collection[int] = (),
) -> list[Failure]:
    """Return a failure for each value that no real capture has."""
    angle_deg = measures["triangulation_angle_deg"]
    limits = [
        (angle_deg, held_out.LEAST_ANGLE_DEG, np.inf, "points are seen at {:.2f} degrees in the median"),
        (measures["share_in_front"], 0.95, np.inf, "only {:.0%} of the observations lie before their camera"),
        (measures["held_out"]["median_px"], 0.0, held_out.MOST_ERROR_PX, "unused observations are {:.1f} px off"),
        (measures["observations_per_photo"]["median"], MIN_MATCHES, np.inf, "photos see {:.0f} points each"),
    ]
    advice = "take photos with more overlap while moving sideways"
    failures = [
        Failure("the photos do not constrain the poses", text.format(value), advice)
        for value, least, most, text in limits
        if value is not None and (value < least or value > most)
    ]
    focals = {
        camera.camera_id: _focal_measure(camera)
        for camera in _cameras_in_use(model)
        if camera.camera_id not in given and not _sees_behind(camera)
    }
    photos = Counter(lenses_of(model).values())
    (least, most), (lowest, highest) = _FOCAL_RANGE, _WIDER_FOCAL_RANGE
    unusual = [camera_id for camera_id, focal in focals.items() if not least < focal < most]
    if sum(photos[camera_id] for camera_id in unusual) < _FEW * photos.total():
        determined = unusual
    advice = "give the intrinsics with --intrinsics, or use photos with EXIF data"
    text = "the estimated focal length is {:.2f} times the longer side"
    return failures + [
        Failure("the intrinsics are implausible", text.format(focals[camera_id]), advice)
        for camera_id in unusual
        if camera_id not in determined or not lowest < focals[camera_id] < highest
    ]
