"""The training of a scene from photos to checkpoint, within a budget of time or steps; masks of what is left out."""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nerfcli import distributed, kernels
from nerfcli.atomic import cannot_write
from nerfcli.captures.capture import Capture
from nerfcli.errors import LOST_RANK, UserError
from nerfcli.field.kinds import field_bytes, settings_from_json
from nerfcli.interrupts import deferred_interrupts
from nerfcli.machine import begin_recent_peak, peak_resident_bytes, use_threads
from nerfcli.photos.images import write_png
from nerfcli.training.checkpoints import Checkpoints, Totals, forget_waypoints, measure_waypoints, read_checkpoint
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.preparation import prepare
from nerfcli.training.runs.files import (
    FIELD,
    LOG,
    METRICS,
    OCCLUDERS,
    STATE,
    LogEntry,
    append_log,
    cut_log,
    left_out_mask,
)
from nerfcli.training.runs.run import RunConfig, continued, write_config
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import WAYPOINTS, Budget
from nerfcli.training.sentinel import FAILURES, Sentinel


def write_left_out(run: Path, inputs: TrainingInputs, *, notify: Callable[[str], None]) -> None:
    """Write RUN/occluders/PHOTO.png, black where pixels are left out, for each photo with such pixels.

    Held-out photos have those of what is attached to the camera. Occluders are reported.
    """
    if inputs.occluders is None and not inputs.attached:
        return
    folder, hidden = run / OCCLUDERS, {}
    if inputs.occluders is not None:
        hidden = {frame.name: mask for frame, mask in zip(inputs.pool.frames, inputs.occluders, strict=True)}
    shutil.rmtree(folder, ignore_errors=True)
    for name in dict.fromkeys([*hidden, *inputs.attached]):
        mask = np.logical_or.reduce([masks[name] for masks in (hidden, inputs.attached) if name in masks])
        if mask.any():
            write_png(left_out_mask(run, name), np.where(mask, 0, 255).astype(np.uint8))
    left_out = {name: 100.0 * float(mask.mean()) for name, mask in hidden.items()}
    most = sorted((name for name in left_out if left_out[name]), key=lambda name: -left_out[name])
    if most:
        named = ", ".join(f"{name} {left_out[name]:.0f} %" for name in most[:3])
        notify(
            f"occluders: {np.mean(list(left_out.values())):.1f} % of the pixels left out, in {len(most)} of "
            f"{len(hidden)} photos, most in {named}; masks in {folder}"
        )
    elif hidden and not inputs.attached:
        notify("occluders: none found")


CHECKPOINT_SECONDS = 30.0


@dataclass(frozen=True)
class Progress:
    """State of a training: fraction of the budget, steps, training seconds, loss, speed."""

    fraction: float
    step: int
    seconds: float
    loss: float
    samples_per_second: float


def train(
    scene: Capture,
    run: Path,
    settings: TrainSettings,
    *,
    resume: bool,
    memory_bytes: int | None = None,
    notify: Callable[[str], None],
    on_progress: Callable[[Progress], None],
) -> None:
    """Fit a field to the scene's training photos and write the run folder.

    The held-out photos are not opened before the last checkpoint has been written.

    Args:
        run: the folder to write; must not hold a run unless `resume`.
        resume: go on from the run's last checkpoint to the budget or step count of `settings`, which count from 0, see
            `continued`.
        memory_bytes: limit of resident memory; photos that do not fit are kept in files, and the result is the same. On
            a GPU, limit of its memory, into which everything has to fit.

    Raises:
        UserError: too little memory, unreadable photos, numbers that became non-finite, nothing to resume or other
            settings than `continued` allows, a folder that cannot be written, or, after a checkpoint has been written,
            another process that has ended.
        KeyboardInterrupt: passed on after a checkpoint has been written.
    """
    use_threads(settings.threads)
    begin_recent_peak()
    kernels.prepare(notify, settings.device)
    device = settings.device
    saved, begun = distributed.from_first(lambda: read_checkpoint(run, device) if resume else (None, None))
    if begun is not None:
        settings = continued(run, settings, before=begun.config)
    with_all_threads = replace(settings, threads=sum(distributed.gathered(settings.threads)))
    settings = replace(settings, log2_rows=with_all_threads.chosen_log2_rows)
    inputs = prepare(scene, settings, run=run, memory_bytes=memory_bytes, begun=begun, notify=notify)
    fitting = Fitting(inputs, size=None if saved is None else settings_from_json(saved[1]["field"]))
    notify(f"field: {fitting.field.settings.size_text}; {field_bytes(fitting.field) / 1e6:.2f} MB")
    if saved is not None:
        fitting.restore(*saved)
        totals = Totals(**saved[1]["totals"])
        cut_log(run, fitting.step)
        forget_waypoints(run, after=fitting.step)
        notify(f"resumed at step {fitting.step}, {totals.seconds:.1f} s")
    else:
        prepared = sum(inputs.seconds.values())
        totals = Totals(seconds=prepared, prepared=prepared)
        _clear(run)
    write_left_out(run, inputs, notify=notify)
    chosen = replace(settings, downscale=inputs.factor, contraction=inputs.extent.contraction)
    write_config(run, replace(RunConfig.describing(scene), settings=chosen, selection=inputs.selection))
    checkpoints = Checkpoints(run, fitting, totals, inputs=inputs, scene=scene)
    checkpoints.write_cameras(run)
    sentinel = Sentinel(fitting, run=run, notify=notify)
    distributed.gathered(None)  # wait until all processes have loaded their photos
    with deferred_interrupts() as interrupts:

        def after_step(progress: Progress) -> None:
            with distributed.interrupted_together():
                on_progress(progress)
                inputs.storage.release_pages()
                interrupts.raise_if_pending()

        try:
            _run(fitting, totals, sentinel=sentinel, checkpoints=checkpoints, run=run, on_progress=after_step)
        except KeyboardInterrupt:
            if not fitting.in_step:
                sentinel.settle()
                checkpoints.write()
            raise
        except UserError as error:
            if error.exit_code == LOST_RANK:  # nothing has been learned from that step
                checkpoints.write()
            raise
        checkpoints.finish()
    if fitting.rollbacks:
        notify(f"numbers became non-finite {fitting.rollbacks} times; the state before each is in {run}/failure-*")
    if distributed.rank() == 0:
        measure_waypoints(checkpoints.frames()[1], run, inputs, notify=notify)


def _clear(run: Path) -> None:
    """Create the run folder, and remove files of an earlier training from it."""
    try:
        run.mkdir(parents=True, exist_ok=True)
        for old in (*(run / name for name in (STATE, FIELD, LOG, METRICS)), *run.glob(FAILURES)):
            old.unlink(missing_ok=True)
        if (run / OCCLUDERS).is_dir():
            shutil.rmtree(run / OCCLUDERS)
    except OSError as error:
        raise cannot_write(run, error) from error
    forget_waypoints(run)


def _run(
    fitting: Fitting,
    totals: Totals,
    *,
    sentinel: Sentinel,
    checkpoints: Checkpoints,
    run: Path,
    on_progress: Callable[[Progress], None],
) -> None:
    """Step until the budget is used up.

    The clock is stopped while waypoints and checkpoints are written.
    """
    last_saved = totals.seconds
    losses: dict[str, float] = {}
    logged_samples, logged_rays, logged_seconds = totals.samples, totals.rays, totals.seconds

    def speeds() -> tuple[float, float]:
        seconds = max(totals.seconds - logged_seconds, 1e-9)
        return (totals.samples - logged_samples) / seconds, (totals.rays - logged_rays) / seconds

    def log() -> None:
        nonlocal logged_samples, logged_rays, logged_seconds
        samples_per_second, rays_per_second = speeds()
        entry: LogEntry = {
            "step": fitting.step,
            "seconds": round(totals.seconds, 3),
            "loss": sum(losses.values()),
            "losses": losses,
            "samples": totals.samples,
            "rays": totals.rays,
            "samples_per_second": round(samples_per_second),
            "rays_per_second": round(rays_per_second),
            "peak_memory_bytes": peak_resident_bytes(),
            "rollbacks": fitting.rollbacks,
        }
        append_log(run, entry)
        logged_samples, logged_rays, logged_seconds = totals.samples, totals.rays, totals.seconds

    budget = Budget.of(fitting.settings)

    def progress() -> float:
        return budget.progress(fitting.step, totals.seconds, before=totals.prepared)

    waypoints = [waypoint for waypoint in WAYPOINTS if waypoint > progress()]
    try:
        while (now := progress()) < 1.0:
            began = time.perf_counter()
            result = sentinel.advance(now)
            totals.seconds += distributed.largest(time.perf_counter() - began)
            totals.samples += result.samples
            totals.rays += result.rays
            losses = result.losses
            now = progress()
            on_progress(Progress(now, fitting.step, totals.seconds, result.loss, speeds()[0]))
            checkpoint_due = totals.seconds - last_saved >= CHECKPOINT_SECONDS
            if checkpoint_due or (waypoints and now >= waypoints[0]):
                sentinel.settle()
                now = progress()
            if waypoints and now >= waypoints[0]:
                waypoints = [later for later in waypoints if later > now]
                checkpoints.keep_waypoint()
                log()
            elif totals.seconds - logged_seconds >= 1.0:
                log()
            if checkpoint_due:
                checkpoints.write()
                last_saved = totals.seconds
    finally:
        # An interrupt may come before the last steps are logged, and a resumed training may have no step left to log.
        if totals.seconds > logged_seconds:
            log()
