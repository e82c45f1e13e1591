"""Run a bench from beginning to end: split the budget between rendering and training, and continue earlier calls."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from nerfcli import kernels
from nerfcli.bench.machine import describe_machine, is_busy, load_average
from nerfcli.bench.records import Records, opened
from nerfcli.bench.rendering import WORK, measure_rendering
from nerfcli.bench.sample_pictures import FOLDER, slug
from nerfcli.bench.session import Session
from nerfcli.bench.sweep import RenderSetting, render_settings, train_settings
from nerfcli.bench.trained_run import BenchedRun
from nerfcli.bench.training import KEPT_FIELD, Trainings, measure_trainings
from nerfcli.bench.worker import measure_model
from nerfcli.errors import UserError
from nerfcli.render.model import Model, load_model
from nerfcli.runs.files import FIELD

# Fraction of the budget for rendering where training is measured as well: renderings are short, trainings are not.
_RENDERING_FRACTION = 0.4
# Fraction of the budget that is reserved for the report.
_KEPT_BACK = 0.03
# Fraction of the budget that rendering gets even if training took longer than planned.
_LEAST_FRACTION = 0.1
COMPLETE = "complete"
THIS_RUN = "this run"


@dataclass(frozen=True)
class BenchOptions:
    """Options of a bench.

    Args:
        budget_seconds: time limit for everything.
        sweep: "both", "render" or "train".
    """

    budget_seconds: float
    sweep: str
    seed: int


def open_bench(subject: BenchedRun, folder: Path, wanted: BenchOptions) -> Records:
    """Open the records of this bench in a folder, new or to be continued.

    Raises:
        UserError: the folder holds something else.
    """
    plan: dict[str, Any] = {
        "source": _title(subject.path.resolve()),
        "measured": subject.identity,
        "machine": describe_machine(subject.base.device, subject.base.threads),
        "budget_seconds": wanted.budget_seconds,
        "sweep": wanted.sweep,
        "seed": wanted.seed,
    }
    return opened(folder, plan)


def measure(
    subject: BenchedRun,
    records: Records,
    wanted: BenchOptions,
    *,
    tell: Callable[[float, str], None],
    notify: Callable[[str], None],
) -> None:
    """Measure what is still missing; every finished measurement is in the records, even if this is interrupted.

    Args:
        subject: a run or a scene.
        records: from `open_bench`.

    Raises:
        UserError: a photo cannot be read, or the results cannot be written.
    """
    if records.last(COMPLETE) is not None:
        return
    load = load_average()
    kernels.prepare(notify, subject.base.device)
    session = Session(records, wanted.budget_seconds, tell, notify)
    session.record("begun", load_average=load, busy=is_busy(load))
    if is_busy(load):
        notify(f"other programs are using the processors (load average {load:.1f}): times will be too long and vary")
    torch.set_num_threads(subject.base.threads)
    (records.folder / FOLDER).mkdir(exist_ok=True)
    if subject.run is not None:
        _measure_run(subject, subject.run, wanted, session)
    else:
        _measure_scene(subject, wanted, session)
    session.record(COMPLETE, load_average=load_average())
    shutil.rmtree(records.folder / WORK, ignore_errors=True)


def _measure_run(subject: BenchedRun, run: Path, wanted: BenchOptions, session: Session) -> None:
    """Render the run's field, then train its scene again in other ways."""
    ends = (1.0 - _KEPT_BACK) * wanted.budget_seconds
    model = load_model(run / FIELD, subject.base.device)
    if model.sha256 != subject.identity:
        raise UserError(f"{run / FIELD} was replaced while bench started", "wait until the training has finished")
    if wanted.sweep != "train":
        fraction = _RENDERING_FRACTION if wanted.sweep == "both" and subject.scene is not None else 1.0
        _render(subject, model, session, ends=fraction * ends)
    if wanted.sweep == "render":
        return
    if subject.scene is None:
        session.notify(f"training settings are skipped: {subject.why_no_scene}")
        return
    if subject.trained and not any(entry["point"] == THIS_RUN for entry in session.records.of_kind("training")):
        session.say("comparing this run with held-out photos")
        torch.set_num_threads(subject.base.threads)
        photos, pictures = subject.held_out(model), session.folder / FOLDER
        measured = measure_model(
            model, photos, seed=0, folder=pictures, prefix=slug(f"training {THIS_RUN}"), shown=subject.shown
        )
        described = {"group": "run", "options": None, "settings": subject.base.to_json()}
        session.record("training", point=THIS_RUN, **described, **subject.trained, **measured)
    trainings = Trainings(subject.scene, subject.base, subject.shown, kept=None)
    measure_trainings(trainings, train_settings(), session=session, seconds=ends - session.spent)


def _measure_scene(subject: BenchedRun, wanted: BenchOptions, session: Session) -> None:
    """Train the scene, then render the field of the default training."""
    assert subject.scene is not None
    ends = (1.0 - _KEPT_BACK) * wanted.budget_seconds
    settings = train_settings()
    fraction = {"both": 1.0 - _RENDERING_FRACTION, "train": 1.0, "render": _RENDERING_FRACTION}[wanted.sweep]
    if wanted.sweep == "render":
        settings = settings[:1]  # rendering needs one trained field
    trainings = Trainings(subject.scene, subject.base, subject.shown, kept=settings[0].name)
    measure_trainings(trainings, settings, session=session, seconds=fraction * ends - session.spent)
    field = session.folder / KEPT_FIELD
    if wanted.sweep != "train" and field.exists():
        _render(subject, load_model(field, subject.base.device), session, ends=ends)


def _render(subject: BenchedRun, model: Model, session: Session, *, ends: float) -> None:
    seconds = max(ends - session.spent, _LEAST_FRACTION * session.budget_seconds)
    measure_rendering(model, subject.held_out(model), _ways_to_render(subject), session=session, seconds=seconds)


def _title(path: Path) -> str:
    """Return the folder's name, with that of its parent if the name is only "run" or "scene"."""
    return f"{path.parent.name}/{path.name}" if path.name in ("run", "scene") else path.name


def _ways_to_render(subject: BenchedRun) -> list[RenderSetting]:
    """Return the settings that matter on this device: on a GPU, the number of CPU threads makes no difference."""
    base = subject.base
    return [way for way in render_settings(base.threads) if base.device == "cpu" or way.threads == base.threads]
