"""Training and evaluation of the members of a run, RUN/members/1, 2, ...: further fields of the same scene."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from nerfcli.atomic import read_json, write_json
from nerfcli.errors import UserError
from nerfcli.evaluate.perceptual import find_perceptual
from nerfcli.evaluate.protocol import background_of, compare, mean_of, measured
from nerfcli.evaluate.run_photos import held_out_photos_of
from nerfcli.field.kinds import KINDS as FIELDS
from nerfcli.render.pictures import render_picture
from nerfcli.runs.files import MEMBERS, METRICS
from nerfcli.runs.members import members_of
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings
from nerfcli.workflows.notices import Notify, Progress, no_progress, one_of_several, silent, warn_python
from nerfcli.workflows.train import train_again

VARIED = ("seeds", "photos", "prior", "field")
# Fraction of the training photos that each member uses. A bootstrap sample has 63 % of them, which costs more quality.
PHOTO_FRACTION = 0.8
# See `TrainSettings.random_start`. This value costs 0.2 dB on the spheres scene; 0.3 would cost 1 dB.
RANDOM_START = 0.1


def member_settings(first: TrainSettings, count: int, *, vary: str) -> list[TrainSettings]:
    """Return the settings of the members of a run.

    Args:
        vary: one of `VARIED`. "seeds": only the seeds, which follow the run's seed; they also vary in all other kinds.
            "photos": `PHOTO_FRACTION` of the training photos, drawn without replacement. "prior": a smooth random
            field to start from. "field": each kind of field in turn.
    """
    members = []
    for number in range(1, count + 1):
        settings = replace(first, seed=first.seed + number)
        match vary:
            case "photos":
                settings = replace(settings, photo_fraction=PHOTO_FRACTION * first.photo_fraction)
            case "prior":
                settings = replace(settings, random_start=RANDOM_START)
            case "field":
                settings = replace(settings, field=FIELDS[(number - 1) % len(FIELDS)])
        members.append(settings)
    return members


def train_members(
    run: Run,
    count: int,
    *,
    only: int | None = None,
    vary: str,
    device: str,
    threads: int,
    memory_bytes: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    notify: Notify = silent,
    warn: Notify = warn_python,
    progress: Progress = no_progress,
) -> list[Run]:
    """Train the members of a run, each with the run's whole budget, and return the members trained or kept.

    Complete members are kept and interrupted ones are resumed.

    Args:
        run: a complete run.
        only: the member to train, counted from 1; None for all. Processes that train one each need no communication.
        vary: one of `VARIED`, see `member_settings`.
        device, threads: as for `TrainSettings`.
        memory_bytes, resume, overwrite, notify, warn: see `train_again`.

    Raises:
        UserError: see `train_again`; or a member with other settings exists.
    """
    first = replace(run.config.settings, device=device, threads=threads)
    budgets = [f"{first.budget_seconds:g} s"] if first.budget_seconds else []
    budgets += [f"{first.steps} steps"] if first.steps else []
    notify(f"{count} members, varied by {vary}, {' or '.join(budgets)} each")
    members, all_settings = [], member_settings(first, count, vary=vary)
    chosen = range(1, count + 1) if only is None else [only]
    for place, number in enumerate(chosen):
        path = run.path / MEMBERS / str(number)
        train_again(
            run,
            {path: all_settings[number - 1]},
            memory_bytes=memory_bytes,
            resume=resume,
            overwrite=overwrite,
            notify=notify,
            warn=warn,
            progress=one_of_several(progress, place, len(chosen), f"member {number} of {count}"),
        )
        members.append(Run(path))
    return members


def evaluate_members(
    run: Run, *, device: str, threads: int, overwrite: bool = False, notify: Notify, progress: Progress = no_progress
) -> dict[str, Any]:
    """Measure a run's members and the mean of their pictures on the held-out photos, or keep existing metrics.

    Returns:
        Content of RUN/members/metrics.json: "members", each member's measures averaged over the photos; "mean_picture",
        the same for the mean of the members' pictures; "checkpoints_sha256", the hashes of the members' fields.

    Raises:
        UserError: see `members_of`; or no photos were held out, or photos cannot be read.
    """
    members, path = members_of(run), run.path / MEMBERS / METRICS
    torch.set_num_threads(threads)
    models = [member.model(device) for member in members]
    checkpoints = [model.sha256 for model in models]
    if path.exists() and not overwrite:
        metrics = read_json(path, needed=("members", "mean_picture"), hint="add --overwrite to evaluate again")
        if metrics.get("checkpoints_sha256") == checkpoints:
            notify(f"{path} is kept: it is up to date; add --overwrite to evaluate again")
            return metrics
    perceptual, test = find_perceptual(notify), run.cameras.test
    rows: list[list[dict[str, float | None]]] = []
    for place, frame in enumerate(test):
        pairs = []
        for member, model in zip(members, models, strict=True):
            (photo,) = held_out_photos_of(member.config, [frame], model, threads=threads)
            picture = render_picture(model, photo.frame, background=background_of(model, photo))
            pairs.append(compare(photo, picture))
            progress((place + len(pairs) / len(members)) / len(test), f"{place}/{len(test)} photos")
        mean = replace(
            pairs[0], rendered=np.asarray(np.mean([pair.rendered for pair in pairs], axis=0, dtype=np.float32))
        )
        rows.append([measured(pair, perceptual) for pair in (*pairs, mean)])
    if not rows:
        raise UserError(f"{run.path} has no held-out photos to evaluate on", "train it with some held out: --holdout")
    *of_members, of_mean = [mean_of(column) for column in zip(*rows, strict=True)]
    metrics = {"members": of_members, "mean_picture": of_mean, "checkpoints_sha256": checkpoints}
    write_json(path, metrics)
    return metrics
