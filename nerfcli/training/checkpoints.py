"""Checkpoints: write a training's state to the run folder and restore it bit for bit."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from nerfcli import distributed
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.run_cameras import write_cameras
from nerfcli.errors import UserError
from nerfcli.field.checkpoint import refuse_non_finite, save_tensors
from nerfcli.field.kinds import settings_from_json
from nerfcli.photos.exif import log_exposures
from nerfcli.render.held_out_exposure import exif_slope, gains_between, gains_beyond_exif
from nerfcli.render.model import Model, save_model
from nerfcli.training.extent import Extent
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.preparation import EarlierDecisions
from nerfcli.training.runs.config import read_config
from nerfcli.training.runs.files import FIELD, STATE
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.sentinel import that_must_be_finite

STATE_FORMAT = "nerfcli training 2"
# Photos without alpha fill the frame; behind the field is black, and little of it shows through.
OPAQUE_BACKGROUND = (0.0, 0.0, 0.0)
ALPHA_BACKGROUND = (1.0, 1.0, 1.0)


@dataclass
class Totals:
    """Totals over the whole training, including resumed parts; `searched` is the time spent selecting components."""

    seconds: float = 0.0
    searched: float = 0.0
    samples: int = 0
    rays: int = 0


class Checkpoints:
    """The files of one training.

    Args:
        fitting, totals: read when a checkpoint is written.
        inputs: what the fitting began from.
        scene: gives the unit of length.
    """

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
            log_exposure=inputs.log_exposure,
            **self._held_out_exposures(),
        )

    def _held_out_exposures(self) -> dict[str, Any]:
        """Return the exposures of held-out photos for `Model`, from training photos; none with exposure=exif."""
        exposure, test = self._fitting.appearance.exposure, self._scene.test_frames
        if exposure is None or self._fitting.components.exposure == "exif":
            return {}
        place = {frame.name: index for index, frame in enumerate(self._scene.frames)}
        places = np.array([place[frame.name] for frame in self._scene.train_frames], dtype=int)
        wanted = np.array([place[frame.name] for frame in test], dtype=int)
        log_gains = exposure.log_gains().detach().cpu().double().numpy()
        found = {"exposures": gains_between(places, log_gains, wanted)}
        slope = 1.0
        if self._inputs.log_exposure is not None:
            slope = exif_slope(places, log_gains, self._exif)
            found["beyond_exif"] = gains_beyond_exif(places, log_gains, self._exif, wanted, slope=slope)
        by_name = {
            kind: {frame.name: tuple(row) for frame, row in zip(test, gains.tolist(), strict=True)}
            for kind, gains in found.items()
        }
        return {"exif_slope": slope, **by_name}

    @cached_property
    def _exif(self) -> np.ndarray:
        return log_exposures(self._scene.train_frames)

    def frames(self) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
        """Return the training frames and the held-out frames with their current cameras."""
        given = (self._scene.train_frames, self._scene.test_frames)
        refinement = self._fitting.appearance.cameras
        if refinement is None:
            return given
        return refinement.frames(*given, scale=self._inputs.extent.training_from_scene.scale)

    def write_cameras(self) -> None:
        """Write RUN/cameras.json."""
        refined = self._fitting.appearance.cameras is not None
        given = {frame.name: frame for frame in self._scene.frames} if refined else None
        write_cameras(self._run, *self.frames(), given=given)

    def write(self) -> None:
        """Write RUN/field.safetensors and RUN/state.safetensors, and the cameras that the field was trained with.

        Of several processes that train together, the first one does.
        """
        if distributed.rank() > 0:
            return
        tensors, description = self._fitting.state()
        extent = self._inputs.extent.to_json()
        description |= {"format": STATE_FORMAT, "extent": extent, "totals": vars(self._totals)}
        writing = [self._write_field, lambda: save_tensors(self._run / STATE, tensors, description)]
        # The process may be killed between the two. The state is all that resuming needs and must never be ahead of the
        # field. The first time it is written first, so that no field exists that can neither be resumed nor replaced.
        for write in writing if (self._run / FIELD).exists() else reversed(writing):
            write()

    def _write_field(self) -> None:
        save_model(self._run / FIELD, self.model())
        if self._fitting.appearance.cameras is not None:
            self.write_cameras()


def decisions_of(run: Path, settings: TrainSettings, description: dict[str, Any]) -> EarlierDecisions:
    """Return the decisions of an earlier call, from its last checkpoint and its settings.

    Raises:
        UserError: another version wrote the checkpoint, or it has another contraction than requested.
    """
    if description.get("format") != STATE_FORMAT:
        raise UserError(f"{run / STATE} was written by another version of nerfcli", "train again with --overwrite")
    extent = Extent.from_json(description["extent"])
    if settings.contraction not in (None, extent.contraction):
        raise UserError(
            f"{run} was trained with --contraction {extent.contraction}, not {settings.contraction}",
            "train into a new folder with -o, or again with --overwrite",
        )
    config = read_config(run)
    return EarlierDecisions(extent, config.components, config.selection)


def restore(fitting: Fitting, run: Path, tensors: dict[str, Tensor], description: dict[str, Any]) -> Totals:
    """Restore `fitting` from the run's last checkpoint.

    Raises:
        UserError: the checkpoint has another field or other components, or numbers that are not finite.
    """
    if settings_from_json(description["field"]) != fitting.field.settings:
        raise UserError(
            f"{run} was trained with another field ({description['field']})",
            "train into a new folder with -o, or again with --overwrite",
        )
    if missing := [name for name in fitting.appearance.state_dict() if f"parts.{name}" not in tensors]:
        raise UserError(
            f"{run} was trained without a component that --with now enables ({missing[0]})",
            "train into a new folder with -o, or again with --overwrite",
        )
    refuse_non_finite(that_must_be_finite(tensors), run / STATE)
    fitting.restore(tensors, description)
    return Totals(**description["totals"])
