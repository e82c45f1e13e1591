"""Judge the largest component, which becomes the scene, and describe the others.

After its second chance it may have gained photos of the others or lost some.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pycolmap

from nerfcli.poses.engine.mapped import MappedModels
from nerfcli.poses.engine.mapping import photo_numbers
from nerfcli.poses.engine.second_chance import ChosenModel, grow, is_contradicted, second_chance
from nerfcli.poses.input.job import Job, Report, Tell
from nerfcli.poses.judge.checks import Checks
from nerfcli.poses.judge.examine import examine
from nerfcli.poses.model.reasons import FEW_MATCHES
from nerfcli.poses.model.two_views import count_matches


def choose_model(mapped: MappedModels, report: Report, tell: Tell, *, checks: Callable[[], Checks]) -> ChosenModel:
    """Examine the largest model, and give it a second chance if pairs of photos contradict it, or let it grow.

    Args:
        checks: makes a check runner for one model.
    """
    examined = examine(mapped.models[:1], mapped.job, report, localised=mapped.localised, checks=checks())
    if is_contradicted(examined.verdict):
        chance = second_chance(mapped, examined, report, tell, checks=checks)
    elif examined.verdict.accepted:
        chance = grow(mapped, examined, report, tell, checks=checks)
    else:
        return ChosenModel(mapped, examined)
    if chance.examined is examined or not chance.examined.verdict.accepted:
        return chance
    first, *found = chance.mapped.models
    models = [first, *_with_photos_of_their_own(first, [*found, *mapped.models[1:]])]
    return ChosenModel(replace(chance.mapped, models=models), chance.examined)


def _with_photos_of_their_own(
    first: pycolmap.Reconstruction, others: Sequence[pycolmap.Reconstruction]
) -> list[pycolmap.Reconstruction]:
    """Return the models, largest first, that have most of their photos, and at least 3, in no larger model."""
    taken, kept = set(first.reg_image_ids()), []
    for model in sorted(others, key=lambda model: -model.num_reg_images()):
        photos = set(model.reg_image_ids())
        own = photos - taken
        if len(own) >= 3 and 2 * len(own) > len(photos):
            kept.append(model)
            taken |= photos
    return kept


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
