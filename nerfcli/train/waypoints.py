"""Waypoints: copies of the field during training, measured on held-out photos once the training is over.

No held-out photo is opened before, so training can neither learn from them nor be stopped or steered by them.
"""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from nerfcli.atomic import cannot_write
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.photos.held_out_exposure import log_gains_of
from nerfcli.photos.pool import load_album
from nerfcli.render.model import Model, load_model, save_model
from nerfcli.runs.log import add_to_log
from nerfcli.train.held_out_pixels import HeldoutPixels
from nerfcli.train.preparation import Prepared

FRACTIONS = (0.25, 0.5, 0.75, 1.0)
FOLDER = "waypoints"


def keep_waypoint(run: Path, step: int, model: Model) -> None:
    """Write the field after a step.

    Raises:
        UserError: it cannot be written.
    """
    try:
        (run / FOLDER).mkdir(exist_ok=True)
    except OSError as error:
        raise cannot_write(run / FOLDER, error) from error
    save_model(_path(run, step), model)


def forget_waypoints(run: Path, *, after: int = -1) -> None:
    """Remove waypoints of steps later than `after`: a killed training has come farther than its last checkpoint."""
    for step in _kept(run):
        if step > after:
            _path(run, step).unlink(missing_ok=True)
    if not _kept(run):
        shutil.rmtree(run / FOLDER, ignore_errors=True)


def measure_waypoints(
    held_out: Sequence[Frame], run: Path, prepared: Prepared, *, notify: Callable[[str], None]
) -> None:
    """Add the PSNR of a sample of held-out pixels to the waypoint entries of RUN/log.jsonl, and remove the waypoints.

    If held-out photos cannot be read, report this and measure nothing: the training itself is complete without them.
    """
    settings, device = prepared.settings, prepared.settings.device
    steps = _kept(run)
    if held_out and steps:
        masks = settings.components.masks
        try:
            album = load_album(
                held_out, factor=prepared.factor, threads=settings.threads, storage=prepared.storage, masks=masks
            )
            pixels = HeldoutPixels(
                album.photos,
                prepared.extent.training_from_scene,
                torch.device(device),
                colours=album.colours,
                storage=prepared.storage,
            )
        except UserError as error:
            notify(f"training is complete, but PSNR on held-out photos could not be measured: {error}")
            return
        measured = {}
        for step in steps:
            model = load_model(_path(run, step), device)
            measured[step] = pixels.psnr(model, log_gains=log_gains_of(held_out, model))
        add_to_log(run, {step: {"heldout_psnr": psnr} for step, psnr in measured.items()})
        curve = ", ".join(f"{psnr:.2f} dB at step {step}" for step, psnr in measured.items())
        notify(f"PSNR on a sample of held-out pixels: {curve}")
    forget_waypoints(run)


def _kept(run: Path) -> list[int]:
    """Return the steps that have waypoints, in order."""
    return sorted(int(path.stem) for path in (run / FOLDER).glob("*.safetensors") if path.stem.isdecimal())


def _path(run: Path, step: int) -> Path:
    return run / FOLDER / f"{step}.safetensors"
