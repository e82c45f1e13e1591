"""The training of a scene from photos to checkpoint, within a budget of time or steps."""

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.atomic import cannot_write
from nerfcli.errors import UserError
from nerfcli.field.checkpoint import load_tensors, refuse_non_finite, save_tensors
from nerfcli.field.cost import field_bytes
from nerfcli.render.model import Model, save_model
from nerfcli.scene import Scene
from nerfcli.train.exif_exposure import log_exposures, mean_log_exposure, relative_log_exposures
from nerfcli.train.extent import Extent, choose_extent
from nerfcli.train.fitting import Fitting
from nerfcli.train.heldout import HeldoutPixels
from nerfcli.train.interrupts import held_back
from nerfcli.train.photos import PixelPool, load_album
from nerfcli.train.point_depth import PointRays, point_depths
from nerfcli.train.room import needs_of, room_for
from nerfcli.train.run_folder import (
    CONFIG,
    FIELD,
    LOG,
    STATE,
    append_log,
    chosen_components,
    cut_log,
    describe_run,
    read_config,
    write_cameras,
    write_sealed,
)
from nerfcli.train.selection import SEARCH_SHARE, Selection, proposals, select
from nerfcli.train.sentinel import FAILURES, Sentinel
from nerfcli.train.settings import TrainSettings, automatic_downscale
from nerfcli.train.trials import Trials
from nerfcli.train.watch import that_must_be_finite

STATE_FORMAT = "nerfcli training 2"
CHECKPOINT_SECONDS = 30.0
HELDOUT_SHARES = (0.25, 0.5, 0.75, 1.0)
# Photos without alpha fill the frame; what the field lets through is black, and little does.
OPAQUE_BACKGROUND = (0.0, 0.0, 0.0)
ALPHA_BACKGROUND = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Progress:
    """Where a training stands: share of the budget, steps, training seconds, loss, speed, last held-out PSNR."""

    share: float
    step: int
    seconds: float
    loss: float
    samples_per_second: float
    heldout_psnr: float | None


@dataclass
class _Totals:
    """What accumulates over the whole training, resumed parts included; `searched` is the part of the seconds that the
    choice of the components took."""

    seconds: float = 0.0
    searched: float = 0.0
    samples: int = 0
    rays: int = 0


def train(
    scene: Scene,
    run: Path,
    settings: TrainSettings,
    *,
    resume: bool,
    memory_bytes: int | None = None,
    notify: Callable[[str], None],
    on_progress: Callable[[Progress], None],
) -> None:
    """Fit a field to the scene's training photos and write the run folder.

    Args:
        scene: photos, cameras and split.
        run: the folder to write; must not hold a run unless `resume`.
        settings: budget, resolution, seed, device.
        resume: go on from the run's last checkpoint to the budget or step count of `settings`, which count from 0.
        memory_bytes: that may be resident; photos that do not fit stand in files, and the result is the same.
        notify: takes lines for the user.
        on_progress: called after every step.

    Raises:
        UserError: too little memory, unreadable photos, numbers that became non-finite, nothing to resume, or a folder
            that cannot be written.
        KeyboardInterrupt: passed on after a checkpoint has been written.
    """
    torch.set_num_threads(settings.threads)
    kernels.prepare(notify)
    if not scene.train_frames:
        raise UserError(f"{scene.root} has no training photo", "every 8th photo is held out; at least 2 are needed")
    first = scene.train_frames[0].camera
    factor = settings.downscale or automatic_downscale(first.width, first.height)
    needs = needs_of((*scene.train_frames, *scene.test_frames), factor, settings=settings)
    room, told = room_for(needs, memory_bytes, folder=run)
    notify(told)
    masks = settings.components.masks
    album = load_album(scene.train_frames, factor=factor, threads=settings.threads, room=room, masks=masks)
    photos = album.photos
    test_album = load_album(scene.test_frames, factor=factor, threads=settings.threads, room=room, masks=masks)
    device = torch.device(settings.device)
    saved = load_tensors(run / STATE, settings.device) if resume else None
    if saved is not None:
        extent = _begun(run, settings, saved[1])
    else:
        extent = choose_extent(scene, photos, settings, fills_frame=album.fills_frame, notify=notify)
    similarity = extent.training_from_scene
    pool = PixelPool(photos, similarity, device, colours=album.colours, room=room)
    notify(
        f"{len(photos)} photos to train on, {len(test_album.photos)} held out, "
        f"{photos[0].frame.camera.width}x{photos[0].frame.camera.height} (1/{factor}), "
        f"{extent}, {settings.device}, {settings.threads} threads"
    )
    asked, selection = settings, None
    if saved is not None:
        settings = replace(settings, components=chosen_components(read_config(run)))
    elif settings.model == "auto":
        trials = Trials(photos, extent, settings=settings, log_gains=None)
        selection = _search(trials, settings, has_alpha=pool.has_alpha, photos=len(photos), notify=notify)
        settings = replace(settings, components=selection.components)
    reference = None if settings.components.exposure == "none" else mean_log_exposure(scene.train_frames)
    heldout = None
    if test_album.photos:
        gains = relative_log_exposures(scene.test_frames, reference)
        heldout = HeldoutPixels(
            test_album.photos, similarity, device, log_gains=gains, colours=test_album.colours, room=room
        )
    if pool.without_ray:
        notify(f"{pool.without_ray} pixels are left out: their lens model has no direction for them")

    points = PointRays(point_depths(scene, pool, similarity), pool) if settings.components.points else None
    if points is not None:
        notify(f"{len(points.known.numbers)} pixels have a point of structure from motion")
    if reference is not None:
        known = log_exposures(scene.train_frames)
        notify(f"EXIF tells the exposure of {np.isfinite(known).sum()} of {len(known)} photos")
    gains = relative_log_exposures(scene.train_frames, reference)
    log_gains = torch.from_numpy(gains)[:, None].expand(-1, 3)
    fitting = Fitting(
        pool,
        extent.marching,
        contraction=extent.contraction,
        settings=settings,
        log_gains=log_gains,
        points=points,
    )
    size = ", ".join(f"{name} {value}" for name, value in fitting.field.settings.to_json().items())
    notify(f"field: {size}; {field_bytes(fitting.field) / 1e6:.2f} MB")
    spent = selection.seconds if selection is not None else 0.0
    totals = _Totals(seconds=spent, searched=spent)
    if saved is not None:
        totals = _restore(fitting, run, *saved)
        cut_log(run, fitting.step)
        notify(f"resumed at step {fitting.step}, {totals.seconds:.1f} s")
    else:
        try:
            run.mkdir(parents=True, exist_ok=True)
            # What stands there now would not fit to what comes.
            for old in (run / STATE, run / FIELD, run / LOG, *run.glob(FAILURES)):
                old.unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(run, error) from error
    described = describe_run(scene, asked, factor=factor, contraction=extent.contraction, selection=selection)
    if resume:
        described["selection"] = read_config(run).get("selection")
    write_sealed(run / CONFIG, described)
    write_cameras(run, scene.train_frames, scene.test_frames)
    background = fitting.parts.background or (ALPHA_BACKGROUND if pool.has_alpha else OPAQUE_BACKGROUND)

    def model() -> Model:
        return Model(
            fitting.field,
            fitting.occupied,
            extent.marching,
            background,
            similarity,
            scene.unit,
            scene.unit_source,
            log_exposure=reference,
        )

    def checkpoint() -> None:
        tensors, description = fitting.state()
        description |= {"format": STATE_FORMAT, "extent": extent.to_json(), "totals": vars(totals)}
        writing = [
            lambda: save_model(run / FIELD, model()),
            lambda: save_tensors(run / STATE, tensors, description),
        ]
        # A kill may come between the two. The state is all that resuming needs, and never ahead of the field; the first
        # time it is written first, so that there is no field which one can neither go on from nor replace.
        for write in writing if (run / FIELD).exists() else reversed(writing):
            write()

    sentinel = Sentinel(fitting, pool, run=run, notify=notify)
    with held_back() as interrupts:

        def after_step(progress: Progress) -> None:
            on_progress(progress)
            room.relieve()
            interrupts.answer()

        try:
            _run(
                fitting,
                totals,
                sentinel=sentinel,
                model=model,
                run=run,
                heldout=heldout,
                on_progress=after_step,
                checkpoint=checkpoint,
            )
        except KeyboardInterrupt:
            if not fitting.in_step:
                checkpoint()
            raise
        checkpoint()
    if fitting.rollbacks:
        notify(f"numbers became non-finite {fitting.rollbacks} times; the states before are in {run}/failure-*")


def _run(
    fitting: Fitting,
    totals: _Totals,
    *,
    sentinel: Sentinel,
    model: Callable[[], Model],
    run: Path,
    heldout: HeldoutPixels | None,
    on_progress: Callable[[Progress], None],
    checkpoint: Callable[[], None],
) -> None:
    """Step until the budget is used up; the clock stands still during checks and checkpoints."""
    settings = fitting.settings
    last_saved = totals.seconds
    psnr: float | None = None
    loss = 0.0
    logged_samples, logged_rays, logged_seconds = totals.samples, totals.rays, totals.seconds

    def speeds() -> tuple[float, float]:
        seconds = max(totals.seconds - logged_seconds, 1e-9)
        return (totals.samples - logged_samples) / seconds, (totals.rays - logged_rays) / seconds

    def log(**measured: float) -> None:
        nonlocal logged_samples, logged_rays, logged_seconds
        samples_per_second, rays_per_second = speeds()
        entry: dict[str, Any] = {
            "step": fitting.step,
            "seconds": round(totals.seconds, 3),
            "loss": loss,
            "samples": totals.samples,
            "rays": totals.rays,
            "samples_per_second": round(samples_per_second),
            "rays_per_second": round(rays_per_second),
            "peak_memory_bytes": peak_memory_bytes(),
            "rollbacks": fitting.rollbacks,
        }
        append_log(run, entry | measured)
        logged_samples, logged_rays, logged_seconds = totals.samples, totals.rays, totals.seconds

    checks = [share for share in HELDOUT_SHARES if share > _share(settings, fitting.step, totals)]
    try:
        while (share := _share(settings, fitting.step, totals)) < 1.0:
            began = time.perf_counter()
            result = sentinel.advance(share)
            totals.seconds += time.perf_counter() - began
            totals.samples += result.samples
            totals.rays += result.rays
            loss = result.loss
            share = _share(settings, fitting.step, totals)
            on_progress(Progress(share, fitting.step, totals.seconds, loss, speeds()[0], psnr))
            if checks and share >= checks[0]:
                checks = [later for later in checks if later > share]
                psnr = heldout.psnr(model()) if heldout is not None else None
                log(**({"heldout_psnr": psnr} if psnr is not None else {}))
            elif totals.seconds - logged_seconds >= 1.0:
                log()
            if totals.seconds - last_saved >= CHECKPOINT_SECONDS:
                checkpoint()
                last_saved = totals.seconds
    finally:
        # An interruption may come before the last steps are in the log, and nothing be left to do when it goes on.
        if totals.seconds > logged_seconds:
            log()


def _search(
    trials: Trials, settings: TrainSettings, *, has_alpha: bool, photos: int, notify: Callable[[str], None]
) -> Selection:
    """Let the scene decide on the components, and tell how it did."""
    candidates = proposals(settings.components, has_alpha=has_alpha, photos=photos, fixed=settings.fixed)
    budget, steps = settings.budget_seconds, settings.steps
    notify(f"tries {len(candidates)} components in short trainings, for {SEARCH_SHARE:.0%} of the budget")
    selection = select(
        trials,
        settings.components,
        candidates,
        seconds=None if budget is None else SEARCH_SHARE * budget,
        steps=None if steps is None else round(SEARCH_SHARE * steps),
    )
    for decision in selection.decisions:
        notify(decision.in_words())
    if not selection.decisions:
        notify("the budget is too small to try components; those that most scenes need are taken")
    return selection


def _share(settings: TrainSettings, step: int, totals: _Totals) -> float:
    """How much of the budget is used: the larger of the shares of time, that of the search aside, and of steps."""
    left = settings.budget_seconds - totals.searched if settings.budget_seconds else 0.0
    by_time = (totals.seconds - totals.searched) / left if left > 0 else 0.0
    by_steps = step / settings.steps if settings.steps else 0.0
    return min(1.0, max(by_time, by_steps))


def _begun(run: Path, settings: TrainSettings, description: dict[str, Any]) -> Extent:
    """The extent in which the run was begun, as its last checkpoint says."""
    if description.get("format") != STATE_FORMAT:
        raise UserError(f"{run / STATE} was written by another version", "train again with --overwrite")
    extent = Extent.from_json(description["extent"])
    if settings.contraction not in (None, extent.contraction):
        raise UserError(
            f"{run} was trained with --contraction {extent.contraction}, not {settings.contraction}",
            "train into a new folder with -o, or again with --overwrite",
        )
    return extent


def _restore(fitting: Fitting, run: Path, tensors: dict[str, Tensor], description: dict[str, Any]) -> _Totals:
    """Bring `fitting` to the run's last checkpoint, which says this."""
    if description["field"] != fitting.field.settings.to_json():
        raise UserError(
            f"{run} was trained with another field ({description['field']})",
            "train into a new folder with -o, or again with --overwrite",
        )
    if missing := [name for name in fitting.parts.state_dict() if f"parts.{name}" not in tensors]:
        raise UserError(
            f"{run} was trained without what --with asks for now ({missing[0]})",
            "train into a new folder with -o, or again with --overwrite",
        )
    refuse_non_finite(that_must_be_finite(tensors), run / STATE)
    fitting.restore(tensors, description)
    return _Totals(**description["totals"])


def peak_memory_bytes() -> int:
    """The largest resident size this process has had."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # kilobytes everywhere else
