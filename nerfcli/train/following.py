"""The other ranks of a training: rank 0 decides, announces each step and writes files; they take the same steps."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.errors import UserError
from nerfcli.fit.extent import Extent
from nerfcli.fit.fitting import Fitting
from nerfcli.fit.point_depth import PointDepths, PointRays
from nerfcli.fit.ranks import ALONE, SingleProcess
from nerfcli.interrupts import deferred_interrupts
from nerfcli.photos.pool import PixelPool
from nerfcli.runs.settings import TrainSettings
from nerfcli.scene import Scene
from nerfcli.train.preparation import Prepared, load_training_photos
from nerfcli.train.sentinel import Sentinel

# Announcements of rank 0 other than a fraction of the budget, which announces a step.
SETTLE, END = -1.0, -2.0
# Ctrl-C and SIGTERM reach all ranks, and rank 0 announces the end. A rank that does not hear it in this time leaves.
GRACE_SECONDS = 5.0
# Steps from whose duration the efficiency is computed.
TIMED_STEPS = 20


@dataclass(frozen=True)
class SharedPreparation:
    """Results of rank 0's preparation that the other ranks need, on the CPU; see `Prepared`."""

    settings: TrainSettings
    extent: Extent
    log_gains: Tensor
    log_focal: float
    depths: tuple[PointDepths, ...] | None
    sky: Tensor | None
    occluders: list[np.ndarray] | None


def start_others(fitting: Fitting, prepared: Prepared) -> None:
    """Send the decisions and the state of rank 0 to the other ranks, and wait until they are ready.

    Raises:
        UserError: another rank has ended.
    """
    ranks, points = fitting.ranks, prepared.points
    if ranks.count == 1:
        return
    decided = SharedPreparation(
        prepared.settings,
        prepared.extent,
        prepared.log_gains.cpu(),
        prepared.log_focal,
        None if points is None else tuple(_moved(depths, "cpu") for depths in points.sets),
        None if prepared.sky is None else prepared.sky.cpu(),
        prepared.occluders,
    )
    ranks.from_first(decided)
    _copy_state(fitting)


def follow(scene: Scene, run: Path, settings: TrainSettings, ranks: SingleProcess, *, memory_bytes: int | None) -> None:
    """Take part in the training of rank 0 until it ends.

    Args:
        scene: photos, cameras and split, as rank 0 has them.
        run: folder for temporary files that hold photos; nothing else is written.
        settings: as for rank 0, except for threads and device.
        ranks: the processes that train together; this is not the first.
        memory_bytes: see `loop.train`.

    Raises:
        UserError: see `loop.train`; or another rank has ended.
        KeyboardInterrupt: Ctrl-C or SIGTERM came, but rank 0 continues or has ended.
    """
    torch.set_num_threads(settings.threads)
    kernels.prepare(_silent, settings.device)
    factor, storage, album = load_training_photos(scene, settings, run=run, memory_bytes=memory_bytes, notify=_silent)
    decided: SharedPreparation | None = ranks.from_first(None)
    if decided is None:  # the run is complete already
        return
    settings = replace(decided.settings, device=settings.device, threads=settings.threads)
    device = torch.device(settings.device)
    similarity = decided.extent.training_from_scene
    pool = PixelPool(album.photos, similarity, device, colours=album.colours, storage=storage)
    if decided.occluders is not None:
        pool.leave_out(decided.occluders, storage=storage)
    prepared = Prepared(
        settings,
        factor,
        storage,
        decided.extent,
        pool,
        selection=None,
        log_exposure=None,
        log_gains=decided.log_gains,
        log_focal=decided.log_focal,
        points=None if decided.depths is None else PointRays([_moved(d, device) for d in decided.depths], pool),
        seconds=0.0,
        sky=None if decided.sky is None else decided.sky.to(device),
        occluders=decided.occluders,
    )
    fitting = prepared.fitting(ranks)
    _copy_state(fitting)
    sentinel = Sentinel(fitting, pool, run=run, notify=_silent)
    with deferred_interrupts() as interrupts:
        last = float("inf")
        try:
            while (message := ranks.announce(END)) != END:
                if interrupts.came is not None:
                    last = min(last, time.monotonic() + GRACE_SECONDS)
                if time.monotonic() > last:
                    interrupts.raise_if_pending()
                if message == SETTLE:
                    sentinel.settle()
                else:
                    sentinel.advance(message)
                    storage.release_pages()
        except UserError:
            interrupts.raise_if_pending()  # an interrupt may be why rank 0 has ended
            raise


def describe_efficiency(fitting: Fitting, seconds: Sequence[float]) -> str:
    """Describe the efficiency of the ranks: compare their step time with that of a few more steps on rank 0 alone.

    Args:
        fitting: of rank 0, after the training; the other ranks have ended.
        seconds: durations of the last steps of all ranks together.
    """
    count, fitting.ranks = fitting.ranks.count, ALONE
    fitting.advance(1.0)
    began = time.perf_counter()
    for _ in range(TIMED_STEPS):
        fitting.advance(1.0)
    fitting.settle()
    alone = (time.perf_counter() - began) / TIMED_STEPS
    together = sum(seconds) / len(seconds)
    gain = alone / together
    return (
        f"{count} processes: {1e3 * together:.1f} ms a step, {1e3 * alone:.1f} ms with the first one alone: {gain:.2f} "
        f"times as fast, efficiency {100 * gain / count:.0f} %"
    )


def _copy_state(fitting: Fitting) -> None:
    ranks = fitting.ranks
    ranks.gathered(None)  # wait until all have loaded their photos
    tensors, description = fitting.state()
    ranks.copy_from_first(*tensors.values())
    fitting.restore(tensors, ranks.from_first(description))


def _moved(depths: PointDepths, device: torch.device | str) -> PointDepths:
    return PointDepths(*(tensor.to(device) for tensor in vars(depths).values()))


def _silent(text: str) -> None:
    """Drop a line for the user: rank 0 reports for all."""
