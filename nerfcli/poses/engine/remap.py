"""Choose the model that becomes the scene: the largest one, mapped again if refused, or extended if accepted.

Wrong matches between parts that look alike put whole groups of photos in wrong places. `remap_refused` leaves out
different evidence each time; a model must pass the same checks, against all pairs. `extend_accepted` adds photos that
the mapper gave up after a few failures in a row: they often fit the adjusted model, with its lens.
"""

import time
from collections.abc import Callable, Set
from dataclasses import dataclass, replace

import pycolmap

from nerfcli.errors import duration, several
from nerfcli.matching.graph import consistent_groups
from nerfcli.poses.engine.attempts import SMALLER_BASELINE
from nerfcli.poses.engine.database import copied
from nerfcli.poses.engine.mapping import MappedModels, MapperOptions, map_globally, map_photos, mapper_limit_seconds
from nerfcli.poses.input.job import Job, Report, Tell
from nerfcli.poses.input.pairs import FOLLOWERS, capture_order
from nerfcli.poses.input.plan import LEAST_LIMIT_SECONDS, at_once_seconds, mapping_seconds
from nerfcli.poses.judge.acceptance import Verdict
from nerfcli.poses.judge.checks import checks_of
from nerfcli.poses.judge.contradictions import without_photos
from nerfcli.poses.judge.examine import ExaminedModel, examine
from nerfcli.poses.judge.parallax import NO_PARALLAX_PX
from nerfcli.poses.model.intrinsics import refine_model
from nerfcli.poses.model.reasons import MIN_MATCHES
from nerfcli.poses.model.two_views import agreements, count_matches, read_verified_pairs

# Least fraction of the placed photos in a consistent part that is worth extending.
_LEAST_PART = 0.3
# Photos in smaller models, as a fraction of those in the accepted one, from which it is extended to them.
_LEAST_APART = 0.05
# Mapping again may take this long at least: with few photos no way takes longer, so that the result depends neither on
# how busy the machine is nor on how much of the first mapping an earlier call has done.
_LEAST_SECONDS = 60.0
_GLOBALLY = "all photos at once (global mapper)"
_MAY_LOOK_ALIKE = (
    "photos of sides that look alike, such as those of a package, may still be joined wrongly: look at the result from "
    "all sides; --masks can hide what repeats"
)
_Pairs = Set[frozenset[int]]  # of image ids


@dataclass(frozen=True)
class ChosenModel:
    """The examined model, and all models in the order of their numbers, including the examined one."""

    mapped: MappedModels
    examined: ExaminedModel


def choose_model(mapped: MappedModels, report: Report, tell: Tell) -> ChosenModel:
    """Examine the largest model; map again if pairs of photos contradict it, or extend it if it is accepted.

    Smaller models stay if they have most of their photos, and at least 3, for themselves.
    """
    examined = examine(mapped.models[:1], mapped.job, report, located=mapped.located)
    if not is_contradicted(examined.verdict) and not examined.verdict.accepted:
        return ChosenModel(mapped, examined)
    again = extend_accepted if examined.verdict.accepted else remap_refused
    chosen = again(ChosenModel(mapped, examined), report, tell)
    if chosen.examined is examined or not chosen.examined.verdict.accepted:
        return chosen
    first, *found = chosen.mapped.models
    kept, taken = [first], set(first.reg_image_ids())
    for model in sorted([*found, *mapped.models[1:]], key=lambda model: -model.num_reg_images()):
        photos = set(model.reg_image_ids())
        if len(photos - taken) >= max(3, len(photos) // 2 + 1):
            kept.append(model)
            taken |= photos
    return replace(chosen, mapped=replace(chosen.mapped, models=kept))


def is_contradicted(verdict: Verdict) -> bool:
    """Return whether pairs of photos contradict the model, while other poses may be right: the camera did not turn."""
    parallax_px = verdict.measures["parallax_px"]
    only_turns = parallax_px is not None and parallax_px < NO_PARALLAX_PX
    kinds = [failure.kind for failure in verdict.failures]
    return not only_turns and any("contradict" in kind or "look alike" in kind for kind in kinds)


def remap_refused(given: ChosenModel, report: Report, tell: Tell) -> ChosenModel:
    """Map again in one way after the other, for at most twice the time of the first mapping, or for a minute.

    Returns the first accepted model, which may be the largest consistent part of the given one; else the given one.
    """
    mapped, verdict, start = given.mapped, given.examined.verdict, time.perf_counter()
    job, scratch, pairs = mapped.job, mapped.seconds, verdict.measures["pairs"]
    against = f"{pairs['contradicting']} of {pairs['judged']} pairs of photos contradict the poses"
    against = against if pairs["contradicting"] else verdict.failures[0].evidence
    most = max(2 * scratch, _LEAST_SECONDS)
    tell(f"{against}: mapping again, for at most {duration(most)}")
    largest, by_global_mapper = mapped.models[0], list[pycolmap.Reconstruction]()
    part, suspects = _consistent_part(largest, job)
    rest = scratch * (1 - part.num_reg_images() / largest.num_reg_images())
    at_once = scratch * at_once_seconds(len(job.files)) / mapping_seconds(len(job.files))

    def extend(part: pycolmap.Reconstruction, suspects: _Pairs) -> list[pycolmap.Reconstruction]:
        worth_it = part.num_reg_images() >= _LEAST_PART * largest.num_reg_images()
        return _extend_part(part, suspects, job, report) if worth_it else []

    # With the seconds that each takes, by the number of photos that it has to place again.
    ways: tuple[tuple[str, float, Callable[[], list[pycolmap.Reconstruction]]], ...] = (
        ("from the largest consistent part", rest, lambda: extend(part, suspects)),
        (_GLOBALLY, at_once, lambda: _map_globally(part, job)),
        (
            "from the largest consistent part of that",
            rest,
            lambda: extend(*_consistent_part(by_global_mapper[0], job)) if by_global_mapper else [],
        ),
        ("from scratch, with other initial pairs", scratch, lambda: _map_from_scratch(suspects, job, report)),
        ("only the largest consistent part of the first model", 0.0, lambda: [part, *mapped.models[1:]]),
    )
    for what, takes, make in ways:
        left = max(most - (time.perf_counter() - start), 0.0)
        if takes >= left and what != ways[-1][0]:
            why = f"it takes about {duration(takes)}, and {duration(left)} are left" if left > 0 else "no time is left"
            tell(f"{what}: skipped, since {why}")
            continue
        tell(f"next: {what}" + (f" (about {duration(takes)})" if takes else ""))
        seconds = max(left, LEAST_LIMIT_SECONDS) if what == _GLOBALLY else 2.0 * mapper_limit_seconds(len(job.files))
        found = _attempt(what, make, given.mapped, report, tell, seconds=seconds)
        if found is None:
            continue
        if found.examined.verdict.accepted:
            if what == ways[-1][0]:  # the other ways were refused, or skipped, so that nothing confirms it
                found.mapped.attempts[-1]["doubt"] = _MAY_LOOK_ALIKE
            return found
        by_global_mapper = found.mapped.models if what == _GLOBALLY else by_global_mapper
        given = replace(given, mapped=replace(mapped, attempts=found.mapped.attempts))
    return given


def extend_accepted(given: ChosenModel, report: Report, tell: Tell) -> ChosenModel:
    """Extend an accepted model to the photos of smaller models, if these are many and match its photos.

    Returns a larger accepted model, or the given one.
    """
    mapped, model = given.mapped, given.examined.model
    if model is None:  # no photo was placed at all
        return given
    placed = set(model.reg_image_ids())
    apart = {photo for other in mapped.models[1:] for photo in other.reg_image_ids()} - placed
    joins = (
        count >= MIN_MATCHES and not placed.isdisjoint(pair) and not apart.isdisjoint(pair)
        for *pair, count in count_matches(mapped.job.database)
    )
    if len(apart) < _LEAST_APART * len(placed) or not any(joins):
        return given
    what = "from the accepted model"
    takes = mapped.seconds * len(apart) / (len(placed) + len(apart))
    tell(f"{several(len(apart), 'photo')} in smaller models, next: {what} (about {duration(takes)})")

    def make() -> list[pycolmap.Reconstruction]:
        return _extend(pycolmap.Reconstruction(model), frozenset(), mapped.job, report)

    seconds = 2.0 * mapper_limit_seconds(len(mapped.job.files))
    found = _attempt(what, make, mapped, report, tell, seconds=seconds, beyond=len(placed))
    if found is None:
        return given
    if found.examined.verdict.accepted and found.mapped.attempts[-1]["models"][0] > len(placed):
        return found
    return replace(given, mapped=replace(mapped, attempts=found.mapped.attempts))


def _attempt(
    what: str,
    make: Callable[[], list[pycolmap.Reconstruction]],
    mapped: MappedModels,
    report: Report,
    tell: Tell,
    *,
    seconds: float,
    beyond: int = 0,
) -> ChosenModel | None:
    """Examine the first of the models that `make` makes, and record the attempt; None, and tell why, without any.

    It must have more photos than `beyond`.
    """
    runner = checks_of(mapped.job)
    models = runner.run(what, make, otherwise=[], seconds=seconds)
    if not models or models[0].num_reg_images() <= beyond:
        nothing = runner.not_computed.get(what, "nothing to map")
        tell(f"{what}: {'no further photo registered' if models else nothing}")
        return None
    examined = examine(models[:1], mapped.job, report, located=mapped.located, checks=runner)
    size = 0 if examined.model is None else examined.model.num_reg_images()
    verdict = "accepted" if examined.verdict.accepted else examined.verdict.failures[0].kind
    tell(f"{what}: {size} of {len(mapped.job.files)} photos registered, {verdict}")
    attempt = {"what": what, "models": [size, *(model.num_reg_images() for model in models[1:])]}
    return ChosenModel(replace(mapped, models=models, attempts=[*mapped.attempts, attempt]), examined)


def _consistent_part(model: pycolmap.Reconstruction, job: Job) -> tuple[pycolmap.Reconstruction, _Pairs]:
    """Return the model of the largest group of photos that the strongest pairs consistently connect, and suspects.

    Suspects are pairs that may be wrong: they contradict the poses inside a group, or connect groups that stronger
    pairs keep apart. Photos that are near in the capture order are none, since the camera barely moved between them.
    """
    found = agreements(model, read_verified_pairs(job.database, min_matches=MIN_MATCHES))
    joins = [(a.one, a.other, -a.matches if a.contradicts else a.matches * a.fraction) for a in found]
    groups = consistent_groups(sorted(model.reg_image_ids()), joins)
    group_of = {photo: number for number, group in enumerate(groups) for photo in group}
    place = {job.image_ids[number]: index for index, number in enumerate(capture_order(job.names) or ())}
    suspects = set()
    for a in found:
        near = bool(place) and abs(place[a.one] - place[a.other]) <= FOLLOWERS
        if not near and a.contradicts == (group_of[a.one] == group_of[a.other]):
            suspects.add(frozenset((a.one, a.other)))
    return without_photos(model, sorted(set(model.reg_image_ids()) - set(groups[0]))), suspects


def _extend_part(
    part: pycolmap.Reconstruction, suspects: _Pairs, job: Job, report: Report
) -> list[pycolmap.Reconstruction]:
    """Adjust a consistent part, and extend it to the other photos without the suspects."""
    base = pycolmap.Reconstruction(part)
    refine_model(base, job.solver)
    return _extend(base, suspects, job, report)


def _extend(base: pycolmap.Reconstruction, suspects: _Pairs, job: Job, report: Report) -> list[pycolmap.Reconstruction]:
    # Attempts are numbered after all of the first mapping; the number is added to the seed.
    with copied(job, "remapped", without=suspects, cameras=base) as copy:
        return map_photos(copy, report, attempt=100, start=MapperOptions(), base=base)


def _map_from_scratch(suspects: _Pairs, job: Job, report: Report) -> list[pycolmap.Reconstruction]:
    """Map without the suspects, with another seed and a smaller initial baseline."""
    with copied(job, "remapped", without=suspects) as copy:
        return map_photos(copy, report, attempt=101, start=SMALLER_BASELINE)


def _map_globally(part: pycolmap.Reconstruction, job: Job) -> list[pycolmap.Reconstruction]:
    """Estimate the rotations, then the positions, of all photos together, with the intrinsics of the part."""
    known = pycolmap.Reconstruction(part)
    for camera in known.cameras.values():
        camera.has_prior_focal_length = True
    with copied(job, "remapped", cameras=known) as copy:
        return map_globally(copy)
