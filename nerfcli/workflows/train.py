"""Train a scene, keep an existing run, resume one, or refuse to overwrite another one; plan a training."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

from nerfcli import distributed
from nerfcli.atomic import clear_leftovers, exclusive
from nerfcli.captures.archives import unpacked
from nerfcli.captures.capture import Capture
from nerfcli.captures.loading import (
    describe_source,
    describe_unused_masks,
    fingerprint,
    load_scene,
    refuse_without_training_photos,
)
from nerfcli.captures.orientation import describe_rescaling
from nerfcli.errors import UserError, duration, listed, several
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.kinds import chosen_size, parameter_bytes
from nerfcli.machine import Resources, is_one_of_several
from nerfcli.notices import Reporter, silent
from nerfcli.output import Output
from nerfcli.training import loop
from nerfcli.training.runs.components import choose
from nerfcli.training.runs.files import CONFIG, LOCK, OCCLUDERS, STATE
from nerfcli.training.runs.run import Run, continued, split_hash
from nerfcli.training.runs.settings import TrainSettings, automatic_downscale
from nerfcli.training.schedule import WAYPOINTS, Schedule, StepPlan
from nerfcli.training.storage import InFiles, needs_of, planned_field, storage_for

# Width of a pixel at the centre of the scene, in units of the training frame, for a field whose photos are not read.
LIKELY_FOOTPRINT = 1e-3


def train_scene(
    scene: str | Path,
    output: Output = Output(),
    settings: TrainSettings = TrainSettings(),
    *,
    resume: bool | None = False,
    holdout: str | None = None,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> Run:
    """Train one scene, keep a complete run with the same settings, or refuse to touch another one.

    Processes that torchrun has started train the scene together; see docs/many-devices.md.

    Example:
        >>> import nerfcli
        >>> from nerfcli.training.runs.settings import TrainSettings
        >>> run = nerfcli.train_scene("photos-scene", settings=TrainSettings(budget_seconds=60, threads=4))
        >>> run.summary.steps

    Args:
        scene: a folder that `estimate_poses` wrote, or of another format that `load_scene` reads.
        output: the folder to write, SCENE-run by default.
        settings: budget, components, resolution, seed, device, threads.
        resume: continue from the last checkpoint of the run; start from the beginning if there is none. None to do so
            only if there is a training of this scene with these settings, whose budget may be smaller.
        holdout: photos to hold out, "every:8", "block:0.15" or a file of names; None for the scene's own split.
        resources: limit of memory; device and threads are those of the settings.
        reporter: its progress is the fraction of the budget, after every step.

    Returns:
        The run, complete.

    Raises:
        UserError: see `nerfcli.training.loop.train`; or a different run exists there.
        KeyboardInterrupt: passed on after a checkpoint has been written.
    """
    given = Path(scene)
    run = output.beside(given, "-run")
    if is_one_of_several():
        distributed.join(settings.device)
    folder = distributed.from_first(lambda: unpacked(given, Output(run, output.overwrite), reporter=reporter))
    loaded = load_scene(folder, holdout=holdout)
    _describe(folder, loaded, reporter)
    again = "add --resume to" if resume is not None else "run"
    if resume is None:
        resume = not output.overwrite and _goes_on(Run(run), loaded, settings)
    if resume and not Run(run).is_trained and not (run / STATE).exists():
        # A script that a scheduler starts again always gives --resume, and may have been ended before a checkpoint.
        resume = False
        _refuse_others(run)
        reporter.note(f"{run} has no checkpoint to resume; the training starts from the beginning")
    task = _Task(loaded, run, settings, resources.memory_limit(settings.device), resume, output.overwrite)
    if distributed.rank() > 0:
        _help(task)
    elif not _is_kept(task, reporter):
        with _claimed(run):
            if not _is_kept(task, reporter):  # another process may just have completed it
                _train(task, reporter, again)
    return Run(run)


@dataclass(frozen=True)
class _Task:
    """A training to carry out; see `train_scene` and `loop.train`."""

    scene: Capture
    run: Path
    settings: TrainSettings
    memory_bytes: int | None
    resume: bool
    overwrite: bool

    def fit(self, folder: Path, **reporting: Any) -> None:
        """Train into a folder; `reporting` are the functions that `loop.train` calls."""
        how = {"resume": self.resume, "memory_bytes": self.memory_bytes}
        loop.train(self.scene, folder, self.settings, **how, **reporting)


def _help(task: _Task) -> None:
    """Train together with the first process, which decides whether to train, keeps the result, and reports."""
    if distributed.from_first(lambda: True):  # the first one sends False if the run is kept
        with TemporaryDirectory() as unused, suppress(KeyboardInterrupt):
            task.fit(Path(unused), notify=silent, on_progress=lambda state: None)


def _is_kept(task: _Task, reporter: Reporter) -> bool:
    """Return whether the run is there and stays, and say so."""
    if not _keeps(task):
        return False
    distributed.from_first(lambda: False)
    complete = "it is complete and has these settings; add --overwrite to train again"
    used = "its training has used this budget; give a larger --budget or --steps"
    reporter.note(f"{task.run} is kept: {used if task.resume else complete}")
    return True


@contextmanager
def _claimed(run: Path) -> Iterator[None]:
    """Hold the lock of a run; leave no trace of it where nothing has been written, as when training is refused."""
    is_new = not run.exists()
    with exclusive(run / LOCK, f"nerfcli train is working on {run}"):
        try:
            yield
        finally:
            with suppress(OSError):
                if [entry.name for entry in run.iterdir()] == [LOCK]:
                    (run / LOCK).unlink()
                    if is_new:
                        run.rmdir()


def _train(task: _Task, reporter: Reporter, again: str) -> None:
    """Train, and say how to continue after an interrupt: `again` the same command."""
    run, budget = task.run, task.settings.budget_seconds

    def on_progress(state: loop.Progress) -> None:
        speed = f"{state.samples_per_second / 1e3:.0f} k samples/s"
        left = "" if budget is None else f", {duration(max(0.0, budget - state.seconds))} left"
        reporter.progress(state.fraction, f"step {state.step}  loss {state.loss:.4f}  {speed}{left}")

    clear_leftovers(run)
    distributed.from_first(lambda: True)
    reporter.progress(0.0, "")
    try:
        task.fit(run, notify=reporter.note, on_progress=on_progress)
    except KeyboardInterrupt:
        if (run / STATE).exists():
            reporter.note(f"checkpoint saved in {run}; to continue, {again} the same command")
        raise


def _goes_on(run: Run, scene: Capture, settings: TrainSettings) -> bool:
    """Return whether a training of this scene with these settings but for its budget is there to go on with."""
    if not run.is_trained or (run.is_complete(settings) and run.is_trained_from(scene, settings)):
        return False
    before = run.config.settings
    return run.is_trained_from(scene, replace(settings, budget_seconds=before.budget_seconds, steps=before.steps))


def _describe(folder: Path, scene: Capture, reporter: Reporter) -> None:
    """Tell what was loaded, and what was left out."""
    reporter.note(describe_source(folder, scene))
    for text in scene.notes:
        reporter.warn(text)
    if scene.missing:
        reporter.warn(f"{several(len(scene.missing), 'missing photo')} of {folder} skipped: {listed(scene.missing)}")
    for text in describe_rescaling(scene.rescaled):
        reporter.note(text)
    if text := describe_unused_masks(scene):
        reporter.note(f"unused masks: {text}")


def _keeps(task: _Task) -> bool:
    """Return whether the run is complete with these settings; raise if it may not be replaced otherwise."""
    path, scene, settings, run = task.run, task.scene, task.settings, Run(task.run)
    masks = {frame.mask.parent: frame.mask for frame in scene.frames if frame.mask is not None}  # one of each folder
    for parent, mask in masks.items():
        if parent.resolve().is_relative_to((path / OCCLUDERS).resolve()):
            what = f"{path} holds masks that this scene uses, such as {mask}; training would delete them"
            raise UserError(what, "choose another folder with -o")
    if task.resume and run.config.split_sha256 != split_hash(scene.test_names):
        before = run.config.holdout
        raise UserError(
            f"{path} was trained with other held-out photos ({before or 'the split of the scene'})",
            f"give --holdout {before}" if before else "remove --holdout, or choose another folder with -o",
        )
    if task.resume and run.config.scene_fingerprint != fingerprint(scene):
        raise UserError(f"{path} was trained on a different scene than {scene.root}", "choose another folder with -o")
    if task.resume and run.is_complete(continued(path, settings, before=run.config)):
        return True  # before photos are read and matched needlessly
    if run.is_trained and not task.resume and not task.overwrite:
        if run.is_trained_from(scene, settings) and run.is_complete(settings):
            return True
        raise UserError(
            f"{path} exists, and is not a complete training with these settings",
            "add --resume to continue it with its own settings, --overwrite to replace it, "
            "or choose another folder with -o",
        )
    _refuse_others(path)
    return False


def _refuse_others(path: Path) -> None:
    """Refuse a file, and a folder of other files than those of a run."""
    others = path.is_dir() and not (path / CONFIG).exists() and any(entry.name != LOCK for entry in path.iterdir())
    if path.is_file() or others:
        raise UserError(f"{path} exists and is not a run folder", "choose another folder with -o")


@dataclass(frozen=True)
class TrainingPlan:
    """Cost of a training.

    Args:
        train_photos, held_out_photos: numbers of photos.
        downscale: factor by which photos are reduced.
        pixels: number of pixels of the reduced training photos.
        memory_bytes: peak memory of the process.
        disk_bytes: largest size of the run folder, including photos that do not fit into memory.
        seconds: the budget, which includes the automatic selection but not the reading of photos; None without one.
        steps: limit on the number of steps; None without one.
        schedule: what steps do at values of the progress, see `StepPlan`. Known distances and a learned background that
            are still to be selected are shown as if they were.
    """

    train_photos: int
    held_out_photos: int
    downscale: int
    pixels: int
    memory_bytes: int
    disk_bytes: int
    seconds: float | None
    steps: int | None
    schedule: tuple[tuple[float, StepPlan], ...]

    def describe(self) -> str:
        """Return one sentence."""
        length = f"{self.steps} steps" if self.seconds is None else f"{self.seconds:.0f} s"
        return (
            f"{self.train_photos} training photos and {self.held_out_photos} held out, {self.pixels / 1e6:.1f} million "
            f"pixels (photos reduced by {self.downscale}): {length}, about {self.memory_bytes / 1e9:.2f} GB of memory, "
            f"{self.disk_bytes / 1e9:.2f} GB on disk"
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        schedule = [{"progress": progress, **asdict(plan)} for progress, plan in self.schedule]
        return {**asdict(self), "schedule": schedule}


def plan_training(
    scene: str | Path, settings: TrainSettings, *, holdout: str | None = None, resources: Resources = Resources()
) -> TrainingPlan:
    """Estimate the cost of `train_scene` without opening photos or writing anything.

    Example:
        >>> from nerfcli.training.runs.settings import TrainSettings
        >>> from nerfcli.workflows.train import plan_training
        >>> plan_training("photos-scene", TrainSettings(budget_seconds=300)).memory_bytes

    Raises:
        UserError: the scene cannot be read, has no training photo, or does not fit into memory.
    """
    loaded = load_scene(Path(scene), holdout=holdout)
    refuse_without_training_photos(loaded)
    factor = settings.downscale or automatic_downscale([frame.camera for frame in loaded.train_frames])
    needs = needs_of((*loaded.train_frames, *loaded.test_frames), factor, settings=settings)
    limit = resources.memory_limit() if settings.device == "cpu" else None
    storage, _ = storage_for(needs, limit, folder=Path(gettempdir()))
    in_files = needs.photos if isinstance(storage, InFiles) else 0
    total = needs.photos + needs.rest
    return TrainingPlan(
        train_photos=len(loaded.train_frames),
        held_out_photos=len(loaded.test_frames),
        downscale=factor,
        pixels=sum((f.camera.width // factor) * (f.camera.height // factor) for f in loaded.train_frames),
        memory_bytes=min(total, limit) if limit else total,
        # The field and its waypoints, the state with both moments of the optimiser, and the previous state until the
        # next is written.
        disk_bytes=(1 + len(WAYPOINTS) + 3 + 3) * parameter_bytes(planned_field(settings)) + in_files,
        seconds=settings.budget_seconds,
        steps=settings.steps,
        schedule=tuple(_likely_schedule(settings).plans()),
    )


def _likely_schedule(settings: TrainSettings) -> Schedule:
    """Return the schedule of a training with a wide baseline, with what is still to be selected for its losses."""
    is_open = [name for name in ("points", "background") if settings.model == "auto" and name not in settings.fixed]
    components = choose(settings.components, included=is_open, excluded=())
    size = chosen_size(
        settings.field,
        hash_grid=HashFieldSettings(contraction="l2", log2_rows=settings.chosen_log2_rows),
        footprint=LIKELY_FOOTPRINT,
        memory_bytes=settings.field_memory_bytes,
    )
    return Schedule(replace(settings, components=components), parallax=1.0, cameras_from=0.0, field=size)
