"""Judge the component that becomes the scene, and keep the numbering under which the report lists all components.

Components are numbered by size after the second chance of the largest one, which may gain photos of the others or lose
some. So a request for a smaller component gets the one that the report lists under that number.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from nerfcli.poses.engine.mapped import COMPONENTS, FIRST, MappedModels, mapping_key, read_mapped, write_mapped
from nerfcli.poses.engine.mapping import photo_numbers
from nerfcli.poses.engine.second_chance import ChosenModel, grow, is_contradicted, second_chance
from nerfcli.poses.input.job import Job, Report, Tell
from nerfcli.poses.input.stages import read_stage, write_stage
from nerfcli.poses.judge.checks import Checks
from nerfcli.poses.judge.examine import examine
from nerfcli.poses.model.reasons import FEW_MATCHES
from nerfcli.poses.model.two_views import count_matches

# A component has at least this many photos of its own.
_LEAST_PHOTOS = 3


def choose_component(
    mapped: MappedModels, report: Report, tell: Tell, *, component: int, checks: Callable[[], Checks]
) -> ChosenModel:
    """Examine one component, and give it a second chance if pairs of photos contradict it.

    Components are numbered from 1; there may be none with this number. `checks` makes a check runner for one model.
    """
    if component == 1:
        return _largest(mapped, report, tell, checks=checks)
    numbered = _numbered(mapped)
    if numbered is None:
        tell("component 1 is checked first, as the others are numbered after it")
        numbered = _largest(mapped, report, tell, checks=checks).mapped
    index = component - 1
    wanted, others = numbered.models[index : index + 1], [*numbered.models[:index], *numbered.models[index + 1 :]]
    examined = examine(wanted, numbered.job, report, checks=checks())
    if not is_contradicted(examined.verdict):
        return ChosenModel(numbered, examined)
    size, placed = wanted[0].num_reg_images(), sum(model.num_reg_images() for model in numbered.models)
    alone = replace(numbered, models=[*wanted, *others], seconds=numbered.seconds * size / placed, localised=())
    chance = second_chance(alone, examined, report, tell, checks=checks, component=component)
    models = [*numbered.models[:index], chance.mapped.models[0], *numbered.models[index + 1 :]]
    return ChosenModel(replace(numbered, models=models, attempts=chance.mapped.attempts), chance.examined)


def _largest(mapped: MappedModels, report: Report, tell: Tell, *, checks: Callable[[], Checks]) -> ChosenModel:
    largest_first = _numbered(mapped) or mapped
    examined = examine(
        largest_first.models[:1], largest_first.job, report, localised=largest_first.localised, checks=checks()
    )
    if is_contradicted(examined.verdict):
        chance = second_chance(mapped, examined, report, tell, checks=checks)
    elif examined.verdict.accepted and largest_first is mapped:
        chance = grow(mapped, examined, report, tell, checks=checks)
    else:
        chance = ChosenModel(largest_first, examined)
    if chance.examined is examined or not chance.examined.verdict.accepted:
        if largest_first is mapped or chance.mapped is not largest_first:
            _keep_numbers(mapped.job, FIRST)
        return chance
    first, *found = chance.mapped.models
    numbered = replace(chance.mapped, models=[first, *_with_photos_of_their_own(first, [*found, *mapped.models[1:]])])
    write_mapped(numbered, mapping_key(mapped.job), name=COMPONENTS)
    _keep_numbers(mapped.job, COMPONENTS)
    return ChosenModel(numbered, chance.examined)


def _with_photos_of_their_own(
    first: pycolmap.Reconstruction, others: Sequence[pycolmap.Reconstruction]
) -> list[pycolmap.Reconstruction]:
    """Return the models, largest first, that have most of their photos, and at least 3, in no larger model."""
    taken, kept = set(first.reg_image_ids()), []
    for model in sorted(others, key=lambda model: -model.num_reg_images()):
        photos = set(model.reg_image_ids())
        own = photos - taken
        if len(own) >= _LEAST_PHOTOS and 2 * len(own) > len(photos):
            kept.append(model)
            taken |= photos
    return kept


def _numbered(mapped: MappedModels) -> MappedModels | None:
    """Return the models in the order listed by an earlier call; None if there was none, or the models are gone."""
    name = read_stage(_stage(mapped.job), mapping_key(mapped.job))
    if name is None or name == FIRST:
        return None if name is None else mapped
    return read_mapped(mapped.job, mapping_key(mapped.job), name=name)


def _keep_numbers(job: Job, name: str) -> None:
    write_stage(_stage(job), mapping_key(job), name)


def _stage(job: Job) -> Path:
    return Path(job.folder) / "numbering.json"


def describe_components(models: Sequence[pycolmap.Reconstruction], job: Job) -> list[dict[str, Any]]:
    """Describe each model of a job, the largest first, by the matches in the job's database.

    Per model {"size", "photos": numbers, "apart": why it is not part of the largest, None for that one}.
    """
    members = [photo_numbers(model, job) for model in models]
    pairs = [(count, job.numbers[one], job.numbers[other]) for one, other, count in count_matches(job.database)]
    return [
        {
            "size": len(photos),
            "photos": photos,
            "apart": _apart(set(photos), set(members[0]), pairs, job.names) if index else None,
        }
        for index, photos in enumerate(members)
    ]


def _apart(photos: set[int], largest: set[int], pairs: Sequence[tuple[int, int, int]], names: Sequence[str]) -> str:
    own = photos - largest
    between = [pair for pair in pairs if own.intersection(pair[1:]) and largest.intersection(pair[1:])]
    if not between:
        return "none of its photos matches a photo of the largest"
    count, one, other = max(between)
    best = f"{names[one]} and {names[other]}, {count} matches"
    strong = sum(pair[0] >= FEW_MATCHES for pair in between)
    if not strong:
        return f"no pair connects it well enough to the largest (best: {best})"
    pairs_connect = "1 pair connects" if strong == 1 else f"{strong} pairs connect"
    return f"{pairs_connect} it to the largest (strongest: {best}), but no consistent alignment was found"
