"""A trained field that renders pictures, and the file that holds it."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError
from nerfcli.field.background import Background, SphereBackground
from nerfcli.field.checkpoint import read_checkpoint, refuse_non_finite, save_tensors, tensors_of
from nerfcli.field.kinds import fresh_field, settings_from_json
from nerfcli.render.accuracy import measure_error
from nerfcli.render.pictures import render_picture
from nerfcli.render.trained_field import Marching, TrainedField

FORMAT = "nerfcli field 2"
BACKGROUND, FINE = "background.logits", "fine"


@dataclass(frozen=True)
class Model(TrainedField):
    """A trained field that renders pictures.

    See `TrainedField` for its data, `render_picture` for `render`, and `measure_error` for `measured_error`.
    """

    render = render_picture
    measured_error = measure_error


def save_model(path: Path, model: Model) -> None:
    """Write the model to one file."""
    behind, tensors = model.background, {**model.field.state_dict(), "occupied": model.occupied}
    if isinstance(behind, SphereBackground):
        tensors[BACKGROUND] = behind.logits
    if model.fine is not None:
        tensors[FINE] = torch.from_numpy(np.packbits(model.fine.cpu().numpy().reshape(len(model.fine), -1), axis=1))
    description: dict[str, Any] = {
        "format": FORMAT,
        "field": model.field.settings.to_json(),
        "marching": vars(model.marching),
        "background": {"side": behind.logits.shape[-1]} if isinstance(behind, SphereBackground) else list(behind),
        "training_from_scene": model.training_from_scene.to_json(),
        "unit": model.unit,
        "unit_source": model.unit_source,
    }
    save_tensors(path, tensors, description)


def load_model(path: Path, device: str) -> Model:
    """Read a model that `save_model` wrote.

    Raises:
        UserError: the file is missing, damaged, not a field of this version, or holds weights that are not finite.
    """
    content = read_checkpoint(path)
    tensors, description = tensors_of(content, path, device)
    if description.get("format") != FORMAT:
        raise UserError(
            f"{path} is of format {description.get('format')!r}, expected {FORMAT!r}",
            "train again with this version of nerfcli",
        )
    occupied, fine = tensors.pop("occupied"), tensors.pop(FINE, None)
    if fine is not None:
        bits = np.unpackbits(fine.cpu().numpy(), axis=1)
        fine = torch.from_numpy(bits.view(bool).reshape([len(bits)] * 3)).to(device)
    refuse_non_finite(tensors, path)
    background = _background(description["background"], tensors)
    field = fresh_field(settings_from_json(description["field"])).to(device)
    field.load_state_dict(tensors)
    return Model(
        field=field,
        occupied=occupied,
        marching=Marching(**description["marching"]),
        background=background,
        training_from_scene=Similarity.from_json(description["training_from_scene"]),
        unit=description["unit"],
        unit_source=description["unit_source"],
        sha256=hashlib.sha256(content).hexdigest(),
        fine=fine,
    )


def _background(described: Any, tensors: dict[str, Tensor]) -> Background:
    """Return the background that `save_model` described; removes its tensor from `tensors`."""
    if isinstance(described, dict):
        sphere = SphereBackground(described["side"])
        sphere.logits.data = tensors.pop(BACKGROUND)
        return sphere
    red, green, blue = described
    return red, green, blue
