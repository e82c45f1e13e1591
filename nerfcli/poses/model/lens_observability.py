"""Find which lens parameters a capture determines; the others keep their usual values.

A parameter that the observations do not determine is not harmless: it absorbs errors from elsewhere, and rotates or
moves the poses with it. So the principal point stays at the centre, and higher distortion at zero, until the
observations clearly support another value, judged by photos and by parts of the scene (see `lens_evidence`). A focal
length that they do not determine stays at EXIF's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from scipy.special import chdtri

from nerfcli.photos.focal_evidence import usual_focal_px
from nerfcli.poses.input.job import Solver
from nerfcli.poses.model.lens_evidence import (
    NAMES,
    Estimate,
    LensEvidence,
    OwnCameras,
    UndeterminedError,
    camera_of,
    camera_with,
    lens_evidence,
    lens_values,
    lenses_of,
    parameters_of,
)

# Probability of freeing a parameter that is in fact zero; it must be small, since eight parts of a scene are few.
_CHANCE = 5e-4
# If the standard deviation of the distortion term moves the corner by less than this fraction of its distance from the
# centre, the term is harmless, and may be free without being significant; a lens is weakly determined beyond it.
HARMLESS = 0.003
# Relative standard deviation of a focal length by EXIF, and of an unknown one, between a fisheye and a small telephoto
# lens; the deviation above which a focal length without EXIF is held; and those above which focal length and distortion
# (at the corner) are reported as weak.
_EXIF_DEVIATION = 0.03
_UNKNOWN_DEVIATION = 0.35
_OPEN_DEVIATION = 0.05
WEAK_FOCAL = 0.01
# A principal point farther than this from the centre, as a fraction of the size, is a fit to something else.
PRINCIPAL_POINT_RANGE = 0.1

_PRINCIPAL_POINT = ("cx", "cy")
_TANGENTIAL = ("fa", "p1", "p2")
_MODELS = {
    frozenset(): "SIMPLE_PINHOLE",
    frozenset(["k1"]): "SIMPLE_RADIAL",
    frozenset(["k1", "k2"]): "RADIAL",
    frozenset(["k1", "k2", *_TANGENTIAL]): "OPENCV",
}


@dataclass(frozen=True)
class DeterminedLens:
    """Lens parameters that a capture determines: a camera with the estimates of one step, where an adjustment starts.

    principal_point: whether it is free. held: whether the focal length stays, since the observations leave it open.
    """

    camera: pycolmap.Camera
    principal_point: bool
    held: bool


def determine_lens(
    model: pycolmap.Reconstruction,
    camera_id: int,
    solver: Solver = Solver(),
    *,
    mapped: pycolmap.Reconstruction,
    named: bool = False,
    exif_focal_px: float | None = None,
) -> DeterminedLens:
    """Find which lens parameters of a perspective camera a converged model determines.

    Args:
        mapped: the model before its full adjustment, in which an undetermined focal length has not drifted yet.
        named: whether the camera keeps its model; its principal point may still become free.
        exif_focal_px: the focal length to keep if the observations do not determine it.

    Raises:
        UndeterminedError: the model has too few observations.
    """
    camera = model.cameras[camera_id]
    evidence = lens_evidence(model, camera_id, solver)
    free = list(parameters_of(camera)) if named else ["f", "k1"]
    # The principal point comes first: real cameras have sensors off the axis, and tangential terms imitate that.
    # It is tested again once k2 is free, whose absence may have hidden it.
    groups = [_PRINCIPAL_POINT] if named else [_PRINCIPAL_POINT, ("k2",), _PRINCIPAL_POINT, _TANGENTIAL]
    for number, group in enumerate(groups):
        if set(group) <= set(free) or (number > 1 and "k2" not in free):
            continue
        if _relative_distance(evidence, free, group, camera) > 1:
            free = [*free, *group]
    found = evidence.estimate(free)
    # If the focal length is undetermined, so is distortion: neither can be estimated without the other.
    fraction = found.deviation("f") / camera.mean_focal_length()
    if not named and not fraction <= (_OPEN_DEVIATION if exif_focal_px is None else _EXIF_DEVIATION):
        focal_px = exif_focal_px or _between_px(mapped, camera_id, solver)
        return DeterminedLens(_held(mapped.cameras[camera_id], focal_px), principal_point=False, held=True)
    if not named and "k2" not in free and fraction <= _EXIF_DEVIATION:
        distance = found.distance(["k1"]) / float(chdtri(1, _CHANCE))
        if distance <= 1 and not _is_harmless(evidence, found, camera):
            free = [name for name in free if name != "k1"]
            # The current value of k1 goes to zero, and the other parameters follow.
            found = evidence.without("k1").estimate(free)
    return DeterminedLens(_camera(camera, found, named=named), principal_point="cx" in free, held=False)


def refine_lens(model: pycolmap.Reconstruction, lens: int, own: OwnCameras, solver: Solver) -> pycolmap.Camera | None:
    """Return a lens as the observations determine it if photos have principal points of their own: one Newton step.

    Returns the camera of the lens's first photo with these parameters, with its principal point; None if the
    observations do not determine them, or the lens cannot be examined in this way.
    """
    camera = camera_of(model, lens, own)
    free = parameters_of(camera)
    if not free or lens in solver.fixed:
        return None
    try:
        evidence = lens_evidence(model, lens, solver, own=own)
        return _camera(camera, evidence.estimate(free), named=True)
    except np.linalg.LinAlgError:
        return None


def uncertainty(
    model: pycolmap.Reconstruction,
    camera_id: int,
    solver: Solver = Solver(),
    *,
    principal_point: bool,
    own: OwnCameras | None = None,
) -> dict[str, Any]:
    """Compute the uncertainty of the intrinsics of a camera, one standard deviation each, for the report.

    Args:
        camera_id: that of the lens where photos have cameras of their own.
        principal_point: whether it is free.
        own: None if photos share cameras.

    Returns:
        {"focal_percent", "principal_point_px": its uncertainty if it were free, "principal_point_free",
        "distortion_border_px": uncertainty of distortion at the corner, None for a lens without distortion, "weak":
        whether focal length or distortion are uncertain enough for a warning, "reason": None}. If the lens cannot be
        examined in this way or the observations are too few, "reason" says so and the numbers and "weak" are None.
    """
    own = own or OwnCameras(lenses_of(model))
    camera = camera_of(model, camera_id, own)
    nothing = {"focal_percent": None, "principal_point_px": None, "distortion_border_px": None}
    nothing |= {"principal_point_free": principal_point, "weak": None}
    free = parameters_of(camera)
    if camera_id in solver.fixed:
        return nothing | {"reason": "the intrinsics are given"}
    if not free:
        return nothing | {"reason": f"not supported for {camera.model.name}"}
    try:
        evidence = lens_evidence(model, camera_id, solver, own=own)
        found = evidence.estimate([*free, *(_PRINCIPAL_POINT if principal_point else ())])
        freed = evidence.estimate([*free, *_PRINCIPAL_POINT])
    except np.linalg.LinAlgError as error:
        return nothing | {"reason": str(error)}
    focal = found.deviation("f") / camera.mean_focal_length()
    border = max((_border_px(evidence, found, name) for name in free if name[0] in "kp"), default=None)
    harmless = HARMLESS * np.hypot(camera.width, camera.height) / 2
    return {
        "focal_percent": 100 * focal,
        "principal_point_px": [freed.deviation(name) for name in _PRINCIPAL_POINT],
        "distortion_border_px": border,
        "principal_point_free": principal_point,
        "weak": bool(focal > WEAK_FOCAL or (border is not None and border > harmless)),
        "reason": None,
    }


def focal_is_determined(found: Mapping[str, Any]) -> bool:
    """Return whether an `uncertainty` knows the focal length to 1 % (one standard deviation)."""
    return found["focal_percent"] is not None and found["focal_percent"] < 100 * WEAK_FOCAL


def is_centred(camera: pycolmap.Camera) -> bool:
    """Return whether the principal point is less than a tenth of the picture's size away from the centre."""
    x, y = camera.principal_point_x / camera.width, camera.principal_point_y / camera.height
    return abs(x - 0.5) < PRINCIPAL_POINT_RANGE and abs(y - 0.5) < PRINCIPAL_POINT_RANGE


def _relative_distance(
    evidence: LensEvidence, free: Sequence[str], group: Sequence[str], camera: pycolmap.Camera
) -> float:
    try:
        found = evidence.estimate([*free, *group])
    except UndeterminedError:
        return 0.0
    if group == _PRINCIPAL_POINT and not is_centred(_camera(camera, found, named=True)):
        return 0.0
    return found.distance(group) / float(chdtri(len(group), _CHANCE))


def _between_px(mapped: pycolmap.Reconstruction, camera_id: int, solver: Solver) -> float:
    """Return the mean of a mapped model's focal length and a usual one, weighted by uncertainty (in logarithms)."""
    camera = mapped.cameras[camera_id]
    focal_px, usual_px = camera.mean_focal_length(), usual_focal_px(camera.width, camera.height)
    try:
        found = lens_evidence(mapped, camera_id, solver).estimate(parameters_of(camera))
    except np.linalg.LinAlgError:
        return usual_px
    weights = np.array([found.deviation("f") / focal_px, _UNKNOWN_DEVIATION]) ** -2.0
    return float(np.exp(weights @ np.log([focal_px, usual_px]) / weights.sum()))


def _held(camera: pycolmap.Camera, focal_px: float) -> pycolmap.Camera:
    """Return the camera with another focal length and the same distortion in pixels: k1 r^3 / f^2 at a radius r."""
    values = np.zeros(len(NAMES))
    values[NAMES.index("f")] = focal_px
    k1 = NAMES.index("k1")
    values[k1] = lens_values(camera)[k1] * (focal_px / camera.mean_focal_length()) ** 2
    held = camera_with(camera, "SIMPLE_RADIAL", values)
    held.has_prior_focal_length = True
    return held


def has_open_distortion(model: pycolmap.Reconstruction, camera_id: int, solver: Solver) -> bool:
    """Return whether a camera's one distortion term is neither significant nor harmless at its current focal length."""
    camera = model.cameras[camera_id]
    try:
        evidence = lens_evidence(model, camera_id, solver)
        found = evidence.estimate(["k1"])
    except np.linalg.LinAlgError:
        return True
    return not _is_harmless(evidence, found, camera) and found.distance(["k1"]) <= float(chdtri(1, _CHANCE))


def _is_harmless(evidence: LensEvidence, found: Estimate, camera: pycolmap.Camera) -> bool:
    return _border_px(evidence, found, "k1") < HARMLESS * float(np.hypot(camera.width, camera.height)) / 2


def _border_px(evidence: LensEvidence, found: Estimate, name: str) -> float:
    return found.deviation(name) * float(evidence.border_px[NAMES.index(name)])


def _camera(camera: pycolmap.Camera, found: Estimate, *, named: bool) -> pycolmap.Camera:
    """Return a camera with the estimated parameters; those that were not free keep their values, or are absent."""
    values = lens_values(camera)
    values[[NAMES.index(name) for name in found.names]] = found.values
    name = camera.model.name if named else _MODELS[frozenset(found.names) - {"f", *_PRINCIPAL_POINT}]
    return camera_with(camera, name, values)
