"""Train a scene, keep an existing run, resume one, or refuse to overwrite another one."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from nerfcli import distributed
from nerfcli.atomic import clear_leftovers
from nerfcli.captures.capture import Capture
from nerfcli.captures.loading import describe_source, describe_unused_masks, fingerprint, load_scene
from nerfcli.captures.orientation import describe_rescaling
from nerfcli.errors import UserError, listed, several
from nerfcli.exclusive import exclusive
from nerfcli.machine import is_one_of_several
from nerfcli.notices import Notify, Progress, no_progress, silent, warn_python
from nerfcli.training import loop
from nerfcli.training.loop import OCCLUDERS
from nerfcli.training.runs.config import split_hash
from nerfcli.training.runs.files import CONFIG, LOCK, METRICS, STATE
from nerfcli.training.runs.run import Run
from nerfcli.training.runs.settings import TrainSettings


def train_scene(
    scene: str | Path,
    run: str | Path,
    settings: TrainSettings = TrainSettings(),
    *,
    memory_bytes: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    holdout: str | None = None,
    notify: Notify = silent,
    warn: Notify = warn_python,
    progress: Progress = no_progress,
) -> Run:
    """Train one scene, keep a complete run with the same settings, or refuse to touch another one.

    Processes that torchrun has started train the scene together; see docs/many-devices.md.

    Example:
        >>> import nerfcli
        >>> from nerfcli.training.runs.settings import TrainSettings
        >>> run = nerfcli.train_scene("photos-scene", "photos-scene-run", TrainSettings(budget_seconds=60, threads=4))
        >>> run.summary.steps

    Args:
        scene: a folder that `estimate_poses` wrote, or of another format that `load_scene` reads.
        run: the folder to write.
        settings: budget, components, resolution, seed, device, threads.
        memory_bytes: limit of resident memory, or of memory on the GPU that trains; None for no limit.
        resume: continue from the last checkpoint of `run`; start from the beginning if there is none.
        overwrite: replace another run at `run`.
        holdout: photos to hold out, "every:8", "block:0.15" or a file of names; None for the scene's own split.
        notify, warn: called with lines for the user.
        progress: called with the fraction of the budget and a short text, after every step.

    Returns:
        The run, complete.

    Raises:
        UserError: see `nerfcli.training.loop.train`; or a different run exists at `run`.
        KeyboardInterrupt: passed on after a checkpoint has been written.
    """
    folder, run = Path(scene), Path(run)
    try:
        return _trained(
            folder,
            run,
            settings,
            memory_bytes=memory_bytes,
            resume=resume,
            overwrite=overwrite,
            holdout=holdout,
            notify=notify,
            warn=warn,
            progress=progress,
        )
    except KeyboardInterrupt:
        if (run / STATE).exists():
            notify(f"checkpoint saved in {run}; to continue, add --resume to the same command")
        raise


def _trained(
    folder: Path,
    run: Path,
    settings: TrainSettings,
    *,
    memory_bytes: int | None,
    resume: bool,
    overwrite: bool,
    holdout: str | None,
    notify: Notify,
    warn: Notify,
    progress: Progress,
) -> Run:
    """See `train_scene`."""
    loaded = load_scene(folder, holdout=holdout)
    notify(describe_source(folder, loaded))
    if loaded.missing:
        names = listed(loaded.missing)
        warn(f"{several(len(loaded.missing), 'missing photo')} of {folder} skipped: {names}")
    for text in describe_rescaling(loaded.rescaled):
        notify(text)
    if text := describe_unused_masks(loaded):
        notify(f"unused masks: {text}")

    if resume and not Run(run).is_trained and not (run / STATE).exists():
        # A script that a scheduler starts again always gives --resume, and may have been ended before a checkpoint.
        resume = False
        _refuse_others(run)
        notify(f"{run} has no checkpoint to resume; the training starts from the beginning")

    if is_one_of_several():
        distributed.join(settings.device)
    if distributed.rank() > 0:
        # The first process decides whether to train, keeps what comes of it, and reports.
        if distributed.from_first(lambda: True):  # or what the first one says instead
            with TemporaryDirectory() as nobody_reads, suppress(KeyboardInterrupt):
                loop.train(
                    loaded,
                    Path(nobody_reads),
                    settings,
                    resume=resume,
                    memory_bytes=memory_bytes,
                    notify=silent,
                    on_progress=lambda state: None,
                )
        return Run(run)

    def is_kept() -> bool:
        if not _keeps(run, loaded, settings, resume=resume, overwrite=overwrite):
            return False
        distributed.from_first(lambda: False)
        complete = "it is complete and has these settings; add --overwrite to train again"
        used = "its training has used this budget; give a larger --budget or --steps"
        notify(f"{run} is kept: {used if resume else complete}")
        return True

    if is_kept():
        return Run(run)
    with exclusive(run / LOCK, f"nerfcli train is working on {run}"):
        if is_kept():  # another process has just completed it
            return Run(run)
        clear_leftovers(run)
        if overwrite:
            (run / METRICS).unlink(missing_ok=True)  # they belong to the field that is replaced
        distributed.from_first(lambda: True)

        def on_progress(state: loop.Progress) -> None:
            speed = f"{state.samples_per_second / 1e3:.0f} k samples/s"
            progress(state.fraction, f"step {state.step}  loss {state.loss:.4f}  {speed}")

        progress(0.0, "")
        loop.train(
            loaded,
            run,
            settings,
            resume=resume,
            memory_bytes=memory_bytes,
            notify=notify,
            on_progress=on_progress,
        )
    return Run(run)


def was_interrupted(scene: Path, run: Path, settings: TrainSettings, *, holdout: str | None = None) -> bool:
    """Return whether a training of this scene with these settings was interrupted and left a checkpoint."""
    trained = Run(run)
    if not trained.is_trained:
        return False
    loaded = load_scene(scene, holdout=holdout)
    return trained.is_trained_from(loaded, settings) and not trained.is_complete(settings)


def _keeps(path: Path, scene: Capture, settings: TrainSettings, *, resume: bool, overwrite: bool) -> bool:
    """Return whether the run at `path` is complete with these settings; raise if it may not be replaced otherwise."""
    run = Run(path)
    masks = {frame.mask.parent: frame.mask for frame in scene.frames if frame.mask is not None}  # one of each folder
    for parent, mask in masks.items():
        if parent.resolve().is_relative_to((path / OCCLUDERS).resolve()):
            raise UserError(
                f"{path} holds masks that this scene uses, such as {mask}; training would delete them",
                "choose another folder with -o",
            )
    if resume and run.config.split_sha256 != split_hash(scene.test_names):
        before = run.config.holdout
        raise UserError(
            f"{path} was trained with other held-out photos ({before or 'the split of the scene'})",
            f"give --holdout {before}" if before else "remove --holdout, or choose another folder with -o",
        )
    if resume and run.config.scene_fingerprint != fingerprint(scene):
        raise UserError(f"{path} was trained on a different scene than {scene.root}", "choose another folder with -o")
    if resume and run.is_complete(settings):  # decided before stereo matching is repeated needlessly
        before = run.config.settings
        same = replace(settings, budget_seconds=before.budget_seconds, steps=before.steps)
        return run.is_trained_from(scene, same)
    if run.is_trained and not resume and not overwrite:
        if run.is_trained_from(scene, settings) and run.is_complete(settings):
            return True
        raise UserError(
            f"{path} exists", "add --resume to continue, --overwrite to replace it, or choose another folder with -o"
        )
    _refuse_others(path)
    return False


def _refuse_others(path: Path) -> None:
    """Refuse a file, and a folder of other files than those of a run."""
    others = path.is_dir() and not (path / CONFIG).exists() and any(entry.name != LOCK for entry in path.iterdir())
    if path.is_file() or others:
        raise UserError(f"{path} exists and is not a run folder", "choose another folder with -o")
