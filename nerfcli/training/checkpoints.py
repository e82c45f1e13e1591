"""What a training writes while it runs: checkpoints, from which it resumes bit for bit, and waypoints.

Waypoints are copies of field and cameras, measured on held-out pixels once the training is over. No held-out photo is
opened before, so training can neither learn from them nor be stopped or steered by them.
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfcli import distributed
from nerfcli.atomic import cannot_write
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.run_cameras import CAMERAS, write_cameras
from nerfcli.errors import UserError
from nerfcli.field.background import colours_behind
from nerfcli.field.checkpoint import load_tensors, refuse_non_finite, save_tensors
from nerfcli.field.exposure import changed_in_front, exposed
from nerfcli.field.hash_field import HashField
from nerfcli.photos.colours import psnr_of
from nerfcli.photos.exif import log_exposures
from nerfcli.photos.held_out_exposure import PhotoExposures, exif_slope, gains_between, gains_beyond_exif, log_gains_of
from nerfcli.render.model import Model, save_model
from nerfcli.render.tracing import render_rays
from nerfcli.training.appearance import over_background
from nerfcli.training.extent import Extent
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.picture_cells import FEWEST_STEPS, with_picture_cells
from nerfcli.training.pool import PixelPool, load_album
from nerfcli.training.preparation import EarlierDecisions
from nerfcli.training.runs.files import FIELD, STATE, add_to_log
from nerfcli.training.runs.run import Run, read_config
from nerfcli.training.sentinel import that_must_be_finite

STATE_FORMAT = "nerfcli training 2"
# Photos without alpha fill the frame; behind the field is black, and little of it shows through.
OPAQUE_BACKGROUND = (0.0, 0.0, 0.0)
ALPHA_BACKGROUND = (1.0, 1.0, 1.0)


@dataclass
class Totals:
    """Totals over the whole training, including resumed parts; `prepared` is the time before the first step."""

    seconds: float = 0.0
    prepared: float = 0.0
    samples: int = 0
    rays: int = 0


class Checkpoints:
    """The files of one training."""

    def __init__(self, run: Path, fitting: Fitting, totals: Totals, *, inputs: TrainingInputs, scene: Capture):
        self._run, self._fitting, self._totals = run, fitting, totals
        self._inputs, self._scene = inputs, scene

    def model(self) -> Model:
        """Return the current field as a model.

        Where the sky is known, it is shown instead of the fog that is left where no training ray has come.
        """
        fitting, inputs = self._fitting, self._inputs
        cells = fitting.cells
        alone = ALPHA_BACKGROUND if inputs.pool.has_alpha else OPAQUE_BACKGROUND
        return Model(
            fitting.field,
            cells.coarse if fitting.appearance.sky is None else cells.visited,
            fitting.ray_steps.render_steps(fitting.plan.stride),
            fitting.appearance.background or alone,
            inputs.extent.training_from_scene,
            self._scene.unit,
            self._scene.unit_source,
        )

    def exposures(self) -> PhotoExposures:
        """Return the exposures of held-out photos, from the current ones of the training photos."""
        exposure, test = self._fitting.appearance.exposure, self._scene.test_frames
        mean = self._inputs.log_exposure
        if exposure is None or self._fitting.components.exposure == "exif":
            return PhotoExposures(mean)
        place = {frame.name: index for index, frame in enumerate(self._scene.frames)}
        places = np.array([place[frame.name] for frame in self._scene.train_frames], dtype=int)
        wanted = np.array([place[frame.name] for frame in test], dtype=int)
        log_gains = exposure.log_gains().detach().cpu().double().numpy()

        def by_name(gains: np.ndarray) -> dict[str, list[float]]:
            return {frame.name: row for frame, row in zip(test, gains.tolist(), strict=True)}

        around = by_name(gains_between(places, log_gains, wanted))
        if mean is None:
            return PhotoExposures(exposures=around)
        slope = exif_slope(places, log_gains, self._exif)
        beyond = gains_beyond_exif(places, log_gains, self._exif, wanted, slope=slope)
        return PhotoExposures(mean, slope, around, by_name(beyond))

    @cached_property
    def _exif(self) -> np.ndarray:
        return log_exposures(self._scene.train_frames)

    def frames(self) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
        """Return the training frames and the held-out frames with their current cameras."""
        given = (self._scene.train_frames, self._scene.test_frames)
        refinement = self._fitting.appearance.cameras
        if refinement is None:
            return given
        return refinement.frames(*given)

    def keep_waypoint(self) -> None:
        """Keep the current field, cameras and exposures until the training is over, see `measure_waypoints`."""
        waypoint = _waypoint(self._run, self._fitting.step)
        try:
            waypoint.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(waypoint, error) from error
        save_model(waypoint / FIELD, self.model())
        self.write_cameras(waypoint)

    def write_cameras(self, folder: Path) -> None:
        """Write FOLDER/cameras.json, with the exposures of held-out photos."""
        refined = self._fitting.appearance.cameras is not None
        given = {frame.name: frame for frame in self._scene.frames} if refined else None
        write_cameras(folder, *self.frames(), given=given, exposures=self.exposures())

    def write(self) -> None:
        """Write RUN/field.safetensors and RUN/state.safetensors, and the cameras and exposures that belong to them.

        Of several processes that train together, the first one does.
        """
        if distributed.rank() == 0:
            self._write(self.model())

    def finish(self) -> None:
        """Write the files after the last step, with what makes pictures of a hash grid faster."""
        if distributed.rank() == 0:
            model = self.model()
            has_surfaces = isinstance(model.field, HashField) and self._fitting.step >= FEWEST_STEPS
            self._write(with_picture_cells(model, self.frames()[0]) if has_surfaces else model)

    def _write(self, model: Model) -> None:
        tensors, description = self._fitting.state()
        extent = self._inputs.extent.to_json()
        description |= {"format": STATE_FORMAT, "extent": extent, "totals": vars(self._totals)}
        writing = [lambda: self._write_field(model), lambda: save_tensors(self._run / STATE, tensors, description)]
        # The process may be killed between the two. The field is written first, so that the state is never ahead of it;
        # except for the first time, as a field without a state could be neither resumed nor replaced.
        for write in writing if (self._run / FIELD).exists() else reversed(writing):
            write()

    def _write_field(self, model: Model) -> None:
        save_model(self._run / FIELD, model)
        self.write_cameras(self._run)


def read_checkpoint(run: Path, device: str) -> tuple[tuple[dict[str, Tensor], dict[str, Any]], EarlierDecisions]:
    """Return the last checkpoint of a run, for `Fitting.restore`, and the decisions made before it.

    Raises:
        UserError: there is none, another version wrote it, or it has numbers that are not finite.
    """
    tensors, description = load_tensors(run / STATE, device)
    if description.get("format") != STATE_FORMAT:
        raise UserError(f"{run / STATE} was written by another version of nerfcli", "train again with --overwrite")
    refuse_non_finite(that_must_be_finite(tensors), run / STATE)
    return (tensors, description), EarlierDecisions(Extent.from_json(description["extent"]), read_config(run))


WAYPOINTS_FOLDER = "waypoints"
# Number of held-out pixels that are measured.
WAYPOINT_PIXELS = 4096


def forget_waypoints(run: Path, *, after: int = -1) -> None:
    """Remove waypoints of steps later than `after`: a killed training has come farther than its last checkpoint."""
    for step in _waypoints_of(run):
        if step > after:
            shutil.rmtree(_waypoint(run, step), ignore_errors=True)
    if not _waypoints_of(run):
        shutil.rmtree(run / WAYPOINTS_FOLDER, ignore_errors=True)


def measure_waypoints(
    held_out: Sequence[Frame], run: Path, inputs: TrainingInputs, *, notify: Callable[[str], None]
) -> None:
    """Add the PSNR of a sample of held-out pixels to the waypoint entries of RUN/log.jsonl, and remove the waypoints.

    If held-out photos cannot be read, report this and measure nothing: the training itself is complete without them.
    """
    settings, device = inputs.settings, inputs.settings.device
    steps = _waypoints_of(run)
    if held_out and steps:
        masks = settings.components.masks
        try:
            album = load_album(
                held_out, factor=inputs.factor, threads=settings.threads, storage=inputs.storage, masks=masks
            )
            seen = tuple(photo.without(inputs.attached.get(photo.frame.name)) for photo in album.photos)
            album, similarity = replace(album, photos=seen), inputs.extent.training_from_scene
            pixels = HeldoutPixels(PixelPool(album, similarity, torch.device(device), storage=inputs.storage))
        except UserError as error:
            notify(f"training is complete, but PSNR on held-out photos could not be measured: {error}")
            forget_waypoints(run)
            return
        measured = {}
        for step in steps:
            waypoint = Run(_waypoint(run, step))
            log_gains = log_gains_of(held_out, waypoint.cameras.exposures)
            measured[step] = pixels.psnr(waypoint.model(device), log_gains=log_gains)
        add_to_log(run, {step: {"heldout_psnr": psnr} for step, psnr in measured.items()})
        curve = ", ".join(f"{psnr:.2f} dB at step {step}" for step, psnr in measured.items())
        notify(f"PSNR on a sample of held-out pixels: {curve}")
    forget_waypoints(run)


class HeldoutPixels:
    """A fixed sample of a few thousand distinct pixels of the held-out photos, or most of them if there are fewer."""

    def __init__(self, pool: PixelPool):
        generator = torch.Generator(device=pool.colours.device).manual_seed(1)
        numbers = pool.numbers(WAYPOINT_PIXELS, generator).unique()
        self.origins, self.directions, self.colours = pool.rays_of(numbers)[:3]
        self.cones = pool.cones[pool.photo_of(numbers)]
        self.photos = pool.photo_of(numbers)

    @torch.no_grad()
    def psnr(self, model: Model, *, log_gains: np.ndarray) -> float:
        """Return the PSNR in dB over all these pixels, clipped to [0, 1], on the model's background.

        Args:
            log_gains: (photos, 3) of the photos relative to rendered pictures; see `held_out_exposure`.
        """
        background = colours_behind(model.background, self.directions)
        # All rays at once would take half a gigabyte while space is still full of fog.
        parts = zip(*(rays.split(512) for rays in (self.origins, self.directions, self.cones, background)), strict=True)
        seen = (render_rays(model, *rays, background=behind, cones=cones) for *rays, cones, behind in parts)
        columns = zip(*((one.rgb, 1.0 - one.ends.opacity[:, None]) for one in seen), strict=True)
        rendered, transmittance = map(torch.cat, columns)
        wanted = over_background(self.colours, background)
        if log_gains.any():
            gains = torch.as_tensor(log_gains).to(rendered)[self.photos]
            if self.colours.shape[-1] == 3:  # the background is a part of the photo
                transmittance = torch.zeros_like(transmittance)
            rendered = changed_in_front(
                rendered, lambda own: exposed(own, gains), transmittance=transmittance, behind=background
            )
        error = (rendered.clamp(0.0, 1.0) - wanted).square().mean().item()
        return psnr_of(error)


def _waypoints_of(run: Path) -> list[int]:
    """Return the steps that have waypoints, in order."""
    complete = (run / WAYPOINTS_FOLDER).glob(f"*/{CAMERAS}")  # written after the field
    return sorted(int(path.parent.name) for path in complete if path.parent.name.isdecimal())


def _waypoint(run: Path, step: int) -> Path:
    return run / WAYPOINTS_FOLDER / str(step)
