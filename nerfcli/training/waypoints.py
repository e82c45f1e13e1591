"""Waypoints: copies of the field during training, measured on held-out pixels once the training is over.

No held-out photo is opened before, so training can neither learn from them nor be stopped or steered by them.
"""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from nerfcli.atomic import cannot_write
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError
from nerfcli.field.background import colours_behind
from nerfcli.field.exposure import exposed
from nerfcli.photos.colours import psnr_of
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.render.held_out_exposure import log_gains_of
from nerfcli.render.model import Model, load_model, save_model
from nerfcli.render.tracing import render_rays
from nerfcli.training.appearance import over_background
from nerfcli.training.fitting import TrainingInputs
from nerfcli.training.pool import PixelPool, load_album
from nerfcli.training.runs.log import add_to_log
from nerfcli.training.storage import IN_MEMORY, PhotoStorage

FOLDER = "waypoints"
# Number of held-out pixels that are measured.
PIXELS = 4096


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
    held_out: Sequence[Frame], run: Path, inputs: TrainingInputs, *, notify: Callable[[str], None]
) -> None:
    """Add the PSNR of a sample of held-out pixels to the waypoint entries of RUN/log.jsonl, and remove the waypoints.

    If held-out photos cannot be read, report this and measure nothing: the training itself is complete without them.
    """
    settings, device = inputs.settings, inputs.settings.device
    steps = _kept(run)
    if held_out and steps:
        masks = settings.components.masks
        try:
            album = load_album(
                held_out, factor=inputs.factor, threads=settings.threads, storage=inputs.storage, masks=masks
            )
            pixels = HeldoutPixels(
                album.photos,
                inputs.extent.training_from_scene,
                torch.device(device),
                colours=album.colours,
                storage=inputs.storage,
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


class HeldoutPixels:
    """A fixed sample of a few thousand distinct pixels of the held-out photos, or most of them if there are fewer.

    Args:
        colours, storage: see `PixelPool`.
    """

    def __init__(
        self,
        photos: Sequence[LoadedPhoto],
        training_from_scene: Similarity,
        device: torch.device,
        *,
        colours: np.ndarray | None = None,
        storage: PhotoStorage = IN_MEMORY,
    ):
        pool = PixelPool(photos, training_from_scene, device, colours=colours, storage=storage)
        generator = torch.Generator(device=device).manual_seed(1)
        numbers = pool.numbers(PIXELS, generator).unique()
        self.origins, self.directions, self.colours = pool.rays_of(numbers)[:3]
        self.cones = pool.cones[pool.photo_of(numbers)]
        self.photos = pool.photo_of(numbers)

    @torch.no_grad()
    def psnr(self, model: Model, *, log_gains: np.ndarray) -> float:
        """Return the PSNR in dB over all these pixels, clipped to [0, 1], on the model's background.

        Args:
            log_gains: (photos, 3) of the photos relative to the model's pictures; see `held_out_exposure`.
        """
        background = colours_behind(model.background, self.directions)
        # All rays at once would take half a gigabyte while space is still full of fog.
        parts = zip(
            *(rays.split(512) for rays in (self.origins, self.directions, self.cones, background)),
            strict=True,
        )
        rendered = torch.cat(
            [render_rays(model, *rays, background=behind, cones=cones).rgb for *rays, cones, behind in parts]
        )
        wanted = over_background(self.colours, background)
        if log_gains.any():
            rendered = exposed(rendered, torch.as_tensor(log_gains).to(rendered)[self.photos])
        error = (rendered.clamp(0.0, 1.0) - wanted).square().mean().item()
        return psnr_of(error)


def _kept(run: Path) -> list[int]:
    """Return the steps that have waypoints, in order."""
    return sorted(int(path.stem) for path in (run / FOLDER).glob("*.safetensors") if path.stem.isdecimal())


def _path(run: Path, step: int) -> Path:
    return run / FOLDER / f"{step}.safetensors"
