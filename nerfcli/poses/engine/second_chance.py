"""Map again if the checks refuse a model because verified pairs of photos contradict it.

Wrong matches between parts that look alike put whole groups of photos in wrong places. Each hypothesis below leaves
out different evidence and maps again; its model must pass the same checks, against all pairs, to be accepted.
"""

import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import pycolmap

from nerfcli.errors import duration, several
from nerfcli.matching.graph import consistent_groups
from nerfcli.poses.engine.attempts import SMALLER_BASELINE
from nerfcli.poses.engine.database import keep_geometries
from nerfcli.poses.engine.mapped import MappedModels, mapping_key, read_mapped, write_mapped
from nerfcli.poses.engine.mapping import (
    MapperOptions,
    map_globally,
    map_photos,
    mapper_limit_seconds,
)
from nerfcli.poses.input.job import Job, Report, Tell
from nerfcli.poses.input.pairs import FOLLOWERS, capture_order
from nerfcli.poses.input.plan import LEAST_LIMIT_SECONDS, at_once_seconds, mapping_seconds
from nerfcli.poses.input.stages import stage_key
from nerfcli.poses.judge.acceptance import Verdict
from nerfcli.poses.judge.checks import Checks
from nerfcli.poses.judge.contradictions import without_photos
from nerfcli.poses.judge.examine import ExaminedModel, examine
from nerfcli.poses.judge.parallax import NO_PARALLAX_PX
from nerfcli.poses.model.intrinsics import settle
from nerfcli.poses.model.reasons import MIN_MATCHES
from nerfcli.poses.model.two_views import agreements, count_matches, read_verified_pairs

# Least fraction of the placed photos in a consistent core that is worth extending.
_LEAST_CORE = 0.3
_ALL_AT_ONCE = "all photos at once (global mapper)"
# Photos in smaller models, as a fraction of those in the accepted one, from which `grow` tries to add them.
_LEAST_APART = 0.05


@dataclass(frozen=True)
class ChosenModel:
    """The examined model, and all models in the order of their numbers, including the examined one."""

    mapped: MappedModels
    examined: ExaminedModel


def second_chance(
    mapped: MappedModels,
    first: ExaminedModel,
    report: Report,
    tell: Tell,
    *,
    checks: Callable[[], Checks],
) -> ChosenModel:
    """Map again under one hypothesis after the other until the checks accept a model.

    Args:
        mapped: the model that the checks refused, and the smaller ones.
        first: the result of these checks.
        checks: makes a check runner for one more model.

    Returns:
        The first accepted model; else the largest consistent part of the first model, if accepted; else the given one.
    """
    start = time.perf_counter()
    pairs = first.verdict.measures["pairs"]
    against = f"{pairs['contradicting']} of {pairs['judged']} pairs of photos contradict the poses"
    if not pairs["contradicting"]:
        against = first.verdict.failures[0].evidence
    scratch = mapped.seconds
    most = 2 * scratch
    tell(f"{against}: mapping again, for at most {duration(most)}")
    attempts = list(mapped.attempts)
    core = _core(mapped.models[0], mapped.job)
    at_once: list[MappedModels] = []  # result of the global mapper, to extend later

    def grown_from_all() -> MappedModels | None:
        return _regrown(mapped, _core(at_once[0].models[0], mapped.job), report) if at_once else None

    rest = 1 - core.model.num_reg_images() / mapped.models[0].num_reg_images()
    photos = len(mapped.job.files)
    all_at_once = scratch * at_once_seconds(photos) / mapping_seconds(photos)
    # The time of each is estimated from the number of photos that it has to place again.
    hypotheses: list[tuple[str, float, Callable[[], MappedModels | None]]] = [
        ("from the largest consistent part", rest * scratch, lambda: _regrown(mapped, core, report)),
        (_ALL_AT_ONCE, all_at_once, lambda: _all_at_once(mapped, core)),
        ("from the largest consistent part of that", rest * scratch, grown_from_all),
        ("from scratch, with other initial pairs", scratch, lambda: _from_nothing(mapped, core, report)),
        (
            "only the largest consistent part of the first model",
            0.0,
            lambda: replace(mapped, models=[core.model, *mapped.models[1:]]),
        ),
    ]
    for number, (what, takes, make) in enumerate(hypotheses):
        left = max(most - (time.perf_counter() - start), 0.0)
        if number < len(hypotheses) - 1 and takes >= left:
            why = f"it takes about {duration(takes)}, and {duration(left)} are left" if left > 0 else "no time is left"
            tell(f"{what}: skipped, since {why}")
            continue
        tell(f"next: {what}" + (f" (about {duration(takes)})" if takes else ""))
        runner = checks()
        limit = max(left, LEAST_LIMIT_SECONDS) if what == _ALL_AT_ONCE else _mapping_limit_seconds(mapped.job)
        found = _tried(what, make, mapped.job, tell, name=f"second-chance-{number}", runner=runner, seconds=limit)
        if found is None:
            continue
        if what == _ALL_AT_ONCE:
            at_once.append(found)
        examined, attempt = _examined(what, found, report, tell, runner=runner)
        attempts.append(attempt)
        if examined.verdict.accepted:
            return ChosenModel(replace(found, attempts=attempts), examined)
    return ChosenModel(replace(mapped, attempts=attempts), first)


def grow(
    mapped: MappedModels, first: ExaminedModel, report: Report, tell: Tell, *, checks: Callable[[], Checks]
) -> ChosenModel:
    """Extend an accepted model to the photos of smaller models, if these are many and match its photos.

    Where a few photos fail in a row, the mapper gives up and begins another model; starting from the adjusted model,
    with its lens, these photos often fit. Returns a larger accepted model, or the given one.
    """
    given = ChosenModel(mapped, first)
    model = first.model
    if model is None:  # no photo was placed at all
        return given
    placed = set(model.reg_image_ids())
    apart = {photo for other in mapped.models[1:] for photo in other.reg_image_ids()} - placed
    if len(apart) < _LEAST_APART * len(placed) or not _match(placed, apart, mapped.job):
        return given
    what = "from the accepted model"
    takes = mapped.seconds * len(apart) / (len(placed) + len(apart))
    tell(f"{several(len(apart), 'photo')} in smaller models, next: {what} (about {duration(takes)})")

    def make() -> MappedModels:
        return _mapped_without(mapped, frozenset(), report, base=pycolmap.Reconstruction(model))

    runner, limit = checks(), _mapping_limit_seconds(mapped.job)
    found = _tried(what, make, mapped.job, tell, name="grown", runner=runner, seconds=limit)
    if found is None:
        return given
    if found.models[0].num_reg_images() <= len(placed):
        tell(f"{what}: no further photo registered")
        return given
    examined, attempt = _examined(what, found, report, tell, runner=runner)
    attempts = [*mapped.attempts, attempt]
    if not examined.verdict.accepted or attempt["models"][0] <= len(placed):
        return ChosenModel(replace(mapped, attempts=attempts), first)
    return ChosenModel(replace(found, attempts=attempts), examined)


def _tried(
    what: str,
    make: Callable[[], MappedModels | None],
    job: Job,
    tell: Tell,
    *,
    name: str,
    runner: Checks,
    seconds: float,
) -> MappedModels | None:
    """Return the models of a hypothesis, which are stored under `name`; None, and tell the user why, without any."""
    key = stage_key(mapping_key(job), name)

    def stored() -> MappedModels | None:
        there = read_mapped(job, key, name=name)
        if there is None and (made := make()) is not None:
            write_mapped(made, key, name=name)
            there = read_mapped(job, key, name=name)
        return there

    found = runner.run(what, stored, otherwise=None, seconds=seconds)
    if found is None or not found.models:
        tell(f"{what}: {runner.not_computed.get(what, 'nothing to map')}")
        return None
    return found


def _examined(
    what: str, found: MappedModels, report: Report, tell: Tell, *, runner: Checks
) -> tuple[ExaminedModel, dict[str, Any]]:
    """Examine the first model of a hypothesis; also return the record of the attempt."""
    examined = examine(found.models[:1], found.job, report, checks=runner)
    size = 0 if examined.model is None else examined.model.num_reg_images()
    verdict = "accepted" if examined.verdict.accepted else examined.verdict.failures[0].kind
    tell(f"{what}: {size} of {len(found.job.files)} photos registered, {verdict}")
    return examined, {"what": what, "models": [size, *(model.num_reg_images() for model in found.models[1:])]}


def _mapping_limit_seconds(job: Job) -> float:
    """Return the time limit of a mapper run with the work around it; the mapper's own limit is half of that."""
    return 2.0 * mapper_limit_seconds(len(job.files))


def _match(some: set[int], others: set[int], job: Job) -> bool:
    """Return whether any of `some` matches any of `others` (image ids)."""
    return any(
        (one in some and other in others) or (one in others and other in some)
        for one, other, count in count_matches(job.database)
        if count >= MIN_MATCHES
    )


def is_contradicted(verdict: Verdict) -> bool:
    """Return whether pairs of photos contradict the model, as opposed to a capture that no model can fit.

    If the camera only turned, no model can be right.
    """
    parallax = verdict.measures["parallax_px"]
    if parallax is not None and parallax < NO_PARALLAX_PX:
        return False
    kinds = [failure.kind for failure in verdict.failures]
    return any("contradict" in kind or "look alike" in kind for kind in kinds)


@dataclass(frozen=True)
class _Core:
    """The largest group of photos that the strongest pairs consistently connect.

    model: with the photos of the group only. suspects: pairs of photo numbers that may be wrong: they contradict the
    poses inside a group, or connect groups that stronger pairs keep apart.
    """

    model: pycolmap.Reconstruction
    suspects: frozenset[tuple[int, int]]


def _core(model: pycolmap.Reconstruction, job: Job) -> _Core:
    found = agreements(model, read_verified_pairs(job.database, min_matches=MIN_MATCHES))
    joins = [(a.one, a.other, -a.matches if a.contradicts else a.matches * a.fraction) for a in found]
    groups = consistent_groups(sorted(model.reg_image_ids()), joins)
    group_of = {photo: number for number, group in enumerate(groups) for photo in group}
    rest = without_photos(model, sorted(set(model.reg_image_ids()) - set(groups[0])))
    suspects = {
        (job.numbers[a.one], job.numbers[a.other])
        for a in found
        if a.contradicts == (group_of[a.one] == group_of[a.other])
    }
    return _Core(rest, frozenset(suspects - _neighbours_in_order(job, suspects)))


def _neighbours_in_order(job: Job, pairs: Iterable[tuple[int, int]]) -> set[tuple[int, int]]:
    """Return the pairs that are near in the capture order, where the camera barely moved; none without an order."""
    order = capture_order(job.names)
    if order is None:
        return set()
    place = {number: index for index, number in enumerate(order)}
    return {(one, other) for one, other in pairs if abs(place[one] - place[other]) <= FOLLOWERS}


def _regrown(mapped: MappedModels, core: _Core, report: Report) -> MappedModels | None:
    """Adjust the core and extend it to the other photos without the suspects; return None if the core is too small."""
    if core.model.num_reg_images() < _LEAST_CORE * mapped.models[0].num_reg_images():
        return None
    base = pycolmap.Reconstruction(core.model)
    settle(base, threads=mapped.job.threads, fixed=mapped.job.fixed_cameras)
    return _mapped_without(mapped, core.suspects, report, base=base)


def _from_nothing(mapped: MappedModels, core: _Core, report: Report) -> MappedModels:
    return _mapped_without(mapped, core.suspects, report, base=None)


def _mapped_without(
    mapped: MappedModels, suspects: frozenset[tuple[int, int]], report: Report, *, base: pycolmap.Reconstruction | None
) -> MappedModels:
    """Extend a model without the suspects, or map from scratch with another seed and a smaller initial baseline."""
    job = _with_own_database(mapped.job, without=suspects)
    attempt = 100  # after all `attempts`; it is added to the seed
    if base is None:
        models = map_photos(job, report, attempt=attempt + 1, start=SMALLER_BASELINE)
    else:
        _set_cameras(job, base)
        models = map_photos(job, report, attempt=attempt, start=MapperOptions(), base=base)
    job.database.unlink()
    return MappedModels(models, mapped.job, mapped.attempts)


def _all_at_once(mapped: MappedModels, core: _Core) -> MappedModels | None:
    """Estimate the rotations, then the positions, of all photos together, with the intrinsics of the core."""
    job = _with_own_database(mapped.job)
    for camera in core.model.cameras.values():
        camera.has_prior_focal_length = True
    _set_cameras(job, core.model)
    models = map_globally(job)
    job.database.unlink()
    return MappedModels(models, mapped.job, mapped.attempts)


def _set_cameras(job: Job, model: pycolmap.Reconstruction) -> None:
    """Write a model's cameras into the job's database: the mapper can only extend a model with the same lenses."""
    with pycolmap.Database.open(job.database) as database:
        for camera in model.cameras.values():
            database.update_camera(camera)


def _with_own_database(job: Job, *, without: Iterable[tuple[int, int]] = ()) -> Job:
    """Copy the job's database, without some pairs of photo numbers, and return the job of the copy."""
    copy = replace(job, variant="second-chance")
    shutil.copyfile(job.database, copy.database)
    left_out = {(min(pair), max(pair)) for pair in without}
    keep_geometries(copy, [pair for pair in job.pairs if (min(pair), max(pair)) not in left_out])
    return copy
