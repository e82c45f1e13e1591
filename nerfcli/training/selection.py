"""Select the components of a model: by evidence, and by paired short trainings where that does not decide.

A component is added only if its gain exceeds the noise, and removed only if hardly anything can be lost by it. Gain
and noise are measured, not assumed: every candidate continues the same start with the same seeds and pixels as the
model that it would change, and the variation of the gains between seeds and between photos gives their error. Each is
tried on top of the components kept so far: of two that correct the same fault, one is enough.
"""

import math
import time
from dataclasses import dataclass, replace
from typing import Any

from nerfcli.matching.camera_check import CameraCheck
from nerfcli.training.evidence import LEARN_FOCAL, LEAST_MISS_PX, LEAST_SKY_FRACTION, may_use_points
from nerfcli.training.runs.components import CHOICES, MOST_DEGREES, Change, Components, Decision, Selection, untried
from nerfcli.training.schedule import FEWEST_STEPS, Budget
from nerfcli.training.search import ADDITION, LIKELY, REMOVAL, SURE, Candidate, Search
from nerfcli.training.trials import Diagnostics, Trials

# Spread of the photos' brightness, in logarithms of light. Below the first number, exposures do not help; above the
# second, they are likely, and a smaller gain in the trial is enough.
LEAST_EXPOSURE_SPREAD, LIKELY_EXPOSURE_SPREAD = 0.06, 0.11
# With up to this many photos, as many as there are harmonics, view dependence explains exposures as well, and learned
# ones drift towards none: they stay at the values from matched pixels. With more photos, learning also corrects what
# adds up along a ring of cameras.
FEW_PHOTOS = (MOST_DEGREES + 1) ** 2
# Fraction of pixels that show distant things. Below the first number, the field itself shows a sky as well; above the
# second, a sky is likely, and a smaller gain in the trial is enough.
LEAST_FAR_FRACTION, LIKELY_FAR_FRACTION = 0.01, 0.1
# A colour by direction predicts a sky better than one colour by at least this, unlike surfaces that a coarse field has
# put far away. Or it predicts it this well: an overcast sky has one colour.
LEAST_SKY_DB, LEAST_SKY_PSNR = 1.0, 22.0
# Poses with at least this epipolar error at any focal length are wrong; in between, a trial decides.
SURELY_MISSED_PX = 1.2
# The focal length from matches is used if it differs from the given one by this many standard errors and this much in
# the logarithm, and reduces the epipolar error to this fraction.
FOCAL_ERRORS, LEAST_FOCAL, MISS_FRACTION = 5.0, 0.003, 0.85


@dataclass(frozen=True)
class Facts:
    """Facts about a scene and the requested components, before training.

    Args:
        has_alpha: whether the photos have alpha: then nothing is behind the object.
        has_exif: whether exposures in EXIF differ.
        cameras_known: reason to trust the cameras, shown to the user; None if they may be wrong.
        cameras: their check against matched features; None if there is none.
        points: number of pixels that see a point at a known distance.
        stereo: number of pixels with a depth from stereo matching.
        sensor: number of pixels with a depth from a sensor.
        sky_fraction: fraction of the pixels that look like a sky, see `matching.sky`.
        sky_confirmed: whether 3D points, or depths from stereo matching, confirm that it is one.
        is_plain: whether it is a plain background around an object.
        occluded_fraction: fraction of the pixels where something hides a surface that other photos see.
        has_attached: whether something is attached to a camera, see `matching.attached`.
        photos: number of training photos.
        exposure_spread: standard deviation of the photos' brightness at points that they share, in logarithms of light.
        fixed: names of the components that the user has set.
    """

    field: str
    has_alpha: bool
    has_exif: bool
    cameras_known: str | None = None
    cameras: CameraCheck | None = None
    points: int = 0
    stereo: int = 0
    sensor: int = 0
    sky_fraction: float = 0.0
    sky_confirmed: bool = False
    is_plain: bool = False
    occluded_fraction: float = 0.0
    has_attached: bool = False
    photos: int = 0
    exposure_spread: float = 0.0
    fixed: tuple[str, ...] = ()


def with_known_cameras(requested: Components, facts: Facts) -> tuple[Components, float, list[Decision]]:
    """Return the model with what matched features show about the cameras, the log focal factor, and the decisions.

    Features may show that focal lengths have to change by this factor (its logarithm is 0 otherwise) or that poses do
    not fit. Trials cannot decide on focal lengths: a model that has begun with a wrong one is bent to fit, and stays so
    for long. For the same reason, a requested model with learned lenses begins with the focal length from features. For
    poses, a trial is too short to show more than that learning them does no harm; features show that they are wrong.
    """
    check, learns = facts.cameras, requested.cameras in LEARN_FOCAL
    if check is None or ("cameras" in facts.fixed and not learns):
        return requested, 0.0, []
    given, changed = check.misses_px
    best_px = min(check.misses_px)
    if math.isfinite(check.error):
        per_cent = 100.0 * math.expm1(check.log_focal)
        seen = (
            f"{check.matches} matched features suggest a focal length {abs(per_cent):.2f} % "
            f"(± {100.0 * check.error:.2f} %) {'longer' if per_cent > 0 else 'shorter'}; they miss by {given:.2f} px "
            f"with the given one, by {changed:.2f} px with this one"
        )
    else:
        seen = f"{check.matches} matched features miss by {given:.2f} px, and by more at other focal lengths"
    is_sure = abs(check.log_focal) > max(LEAST_FOCAL, FOCAL_ERRORS * check.error)
    # With wrong poses, any focal length may seem best; the right one leaves hardly any error.
    is_sure = is_sure and changed < min(MISS_FRACTION * given, LEAST_MISS_PX)
    if is_sure:
        value = requested.cameras if learns else "focal"
        return replace(requested, cameras=value), check.log_focal, [untried(("cameras", value), seen, kept=True)]
    if learns:
        return requested, 0.0, []
    decisions = [untried(("cameras", "focal"), seen)]
    if best_px < SURELY_MISSED_PX:
        return requested, 0.0, decisions
    seen = f"{check.matches} matched features miss by at least {best_px:.2f} px at any focal length"
    decisions.append(untried(("cameras", "poses"), seen, kept=True))
    return replace(requested, cameras="poses"), 0.0, decisions


def with_evidence(requested: Components, facts: Facts) -> tuple[Components, list[Decision]]:
    """Return the model with components that photos support before any training, unless set, and the decisions.

    These are points, at which rays should end, depths from stereo matching and from a sensor, the omission of what
    hides surfaces that other photos see or is attached to the camera, exposures from shared pixels, and a sky that 3D
    points or stereo confirm. They are in the model from the first step on: later, density has formed elsewhere already.
    A sensor's depths need no good poses.
    """
    wanted: list[tuple[Change, str]] = []
    may_use = may_use_points(requested, facts.fixed, has_alpha=facts.has_alpha, cameras=facts.cameras)
    if facts.points and may_use:
        wanted.append((("points", CHOICES["points"].on), f"{facts.points:,} pixels see a 3D point at a known distance"))
        if facts.stereo:
            wanted.append((("stereo", True), f"several photos agree on the depth of {facts.stereo:,} pixels"))
        if facts.exposure_spread > LIKELY_EXPOSURE_SPREAD:
            reason = f"photos differ by {_stops(facts.exposure_spread)} at the same points"
            wanted.append((("exposure", "matched" if facts.photos <= FEW_PHOTOS else "learned"), reason))
    hiding = ["something is attached to the camera"] if facts.has_attached else []
    if facts.occluded_fraction and facts.points and may_use:
        hiding.append(f"{100.0 * facts.occluded_fraction:.1f} % of the pixels hide surfaces that other photos see")
    if hiding:
        wanted.append((("occluders", True), "; ".join(hiding)))
    if facts.sensor:
        wanted.append((("sensor", True), f"a sensor has measured the depth of {facts.sensor:,} pixels"))
    if facts.sky_confirmed or facts.is_plain:
        kind = "are a plain background" if facts.is_plain else "look like a sky, with hardly any surface in front"
        reason = f"{100.0 * facts.sky_fraction:.0f} % of the pixels {kind}"
        wanted.append((("background", "sphere"), reason))
    wanted = [(change, reason) for change, reason in wanted if change[0] not in facts.fixed]
    values: dict[str, Any] = dict(change for change, _ in wanted)
    model = replace(requested, **values)
    return model, [untried(change, reason, kept=True) for change, reason in wanted]


def _stops(spread: float) -> str:
    """Describe the spread of exposures between photos in stops."""
    return f"{spread / math.log(2.0):.2g} stops"


def proposals(start: Components, signs: Diagnostics, facts: Facts) -> tuple[list[Candidate], list[Decision]]:
    """Return the candidates for a scene, those with the best support first, and decisions on what nothing supports."""
    candidates: list[Candidate] = []
    declined: list[Decision] = []
    if start.exposure not in ("matched", "learned"):
        spread = signs.exposure_spread
        rule = LIKELY if spread > LIKELY_EXPOSURE_SPREAD else ADDITION
        if facts.has_exif:
            candidates.append(Candidate(("exposure", "exif"), "EXIF says that exposures differ", rule))
        if spread > LEAST_EXPOSURE_SPREAD:
            candidates.append(Candidate(("exposure", "learned"), f"photos differ by {_stops(spread)}", rule))
        else:
            declined.append(untried(("exposure", "learned"), f"photos differ by only {_stops(spread)}"))
    poses, check = ("cameras", "poses"), facts.cameras
    if facts.cameras_known is not None:
        declined.append(untried(poses, facts.cameras_known))
    elif check is None:
        candidates.append(Candidate(poses, "too few matched features to check them", ADDITION))
        # In a trial, a right focal length changes as much as a wrong one, because of the coarse field.
        declined.append(untried(("cameras", "focal"), "too few matched features to decide"))
    elif min(check.misses_px) < LEAST_MISS_PX:
        declined.append(untried(poses, f"matched features miss by only {min(check.misses_px):.2f} px"))
    else:
        candidates.append(Candidate(poses, f"matched features miss by {min(check.misses_px):.2f} px", SURE))
    if not facts.has_alpha:
        sphere = ("background", "sphere")
        distant = f"{100.0 * signs.far_fraction:.1f} % of the pixels see mostly distant things"
        if facts.sky_fraction > LEAST_SKY_FRACTION:
            sky = f"{100.0 * facts.sky_fraction:.0f} % of the pixels look like a sky"
            candidates.append(Candidate(sphere, sky, SURE))
        elif signs.far_fraction <= LEAST_FAR_FRACTION:
            declined.append(untried(sphere, f"only {distant}"))
        elif why := _unlike_a_sky(signs):
            declined.append(untried(sphere, f"{distant}, but {why}"))
        else:
            rule = LIKELY if signs.far_fraction > LIKELY_FAR_FRACTION else ADDITION
            candidates.append(Candidate(sphere, distant, rule))
    if facts.field == "hash":  # which keeps its shape without it
        candidates.append(Candidate(("view", 0), "", REMOVAL))
    order = (SURE, LIKELY, ADDITION, REMOVAL)
    return (
        [
            candidate
            for candidate in sorted(candidates, key=lambda candidate: order.index(candidate.rule))
            if candidate.change[0] not in facts.fixed and getattr(start, candidate.change[0]) != candidate.change[1]
        ],
        [decision for decision in declined if decision.component not in facts.fixed],
    )


def _unlike_a_sky(signs: Diagnostics) -> str | None:
    """Return why distant things are no sky; None if they may be one."""
    one, painted = signs.sky_psnr
    if painted >= LEAST_SKY_PSNR or painted - one >= LEAST_SKY_DB:
        return None
    return f"viewing direction does not explain their colours: {painted:.1f} dB with it, {one:.1f} dB with one colour"


def _without_poses(model: Components) -> Components:
    """Return the model for trials, without learned poses unless they are what is tried.

    Poses take a third of the time, and trials of other components are too short for them to improve.
    """
    return replace(model, cameras="fixed") if model.cameras == "poses" else model


def select(trials: Trials, requested: Components, facts: Facts, budget: Budget) -> Selection:
    """Find the components that a scene needs: those that evidence supports, and candidates that gain in trials.

    Returns:
        The selection; if the budget is too small for a first training of `FEWEST_STEPS`, only what needs no trial.
    """
    began = time.perf_counter()
    model, decided = with_evidence(requested, facts)
    start = trials.begin(_without_poses(model), budget.of_start(), fewest=FEWEST_STEPS)
    if start is None:
        return Selection(model, tuple(decided))
    candidates, declined = proposals(model, start.signs, facts)
    search = Search(trials, start, _without_poses(model), budget=budget, began=began)
    search.run(candidates)
    chosen = replace(model, **search.kept)
    is_found = chosen.exposure == "learned" and model.exposure != "learned"
    decisions = (*decided, *search.decisions.values(), *declined)
    return Selection(chosen, decisions, log_gains=search.log_gains if is_found else None)
