"""A trained field with everything that rendering needs: its frame, its empty space, the steps along rays."""

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError
from nerfcli.field.background import Background, SphereBackground
from nerfcli.field.checkpoint import read_checkpoint, refuse_non_finite, save_tensors, tensors_of
from nerfcli.field.interface import Field
from nerfcli.field.kinds import fresh_field, settings_from_json
from nerfcli.render.depth import DepthRequest

if TYPE_CHECKING:
    from nerfcli.render.pictures import RenderedPicture

FORMAT = "nerfcli field 2"
# Format without a choice of contractions; still read.
FORMAT_1 = "nerfcli field 1"
BACKGROUND = "background.logits"


@dataclass(frozen=True)
class Marching:
    """Sampling of rays in steps that grow with distance, in units of the training frame.

    step(t) = max(shortest_step, growth * t * max(1, t)): a pixel covers more the farther away it is, and beyond the
    unit ball equal steps in 1 / t are about equal steps in contracted space.

    Args:
        near, far: 0 <= near < far.
        shortest_step: > 0.
        growth: step per distance at distance 1, >= 0; 0 gives equal steps.
    """

    near: float
    far: float
    shortest_step: float
    growth: float

    def edges(self) -> Tensor:
        """Return the distances that cut every ray.

        Returns:
            (S + 2,) float64, increasing, the first at `near`, the last but one at or beyond `far`; one more edge than
            the intervals need, so that a jittered cut always has a right neighbour.

        Raises:
            ValueError: the distances are not in order or the step is not positive.
        """
        near, far, shortest_step, growth = self.near, self.far, self.shortest_step, self.growth
        if not 0 <= near < far < math.inf or shortest_step <= 0 or growth < 0:
            raise ValueError(f"need 0 <= near < far and a positive step, got {near}, {far}, {shortest_step}, {growth}")
        edges = [near]
        while len(edges) < 2 or edges[-2] < far:
            distance = edges[-1]
            edges.append(distance + max(shortest_step, growth * distance * max(1.0, distance)))
        return torch.tensor(edges, dtype=torch.float64)

    def stretched(self, factor: float) -> "Marching":
        """Return the same span with steps `factor` (> 0) times as long."""
        return replace(self, shortest_step=factor * self.shortest_step, growth=factor * self.growth)


@dataclass(frozen=True)
class Model:
    """A trained field with everything that rendering needs.

    Args:
        field: the radiance field, on points of the training frame.
        occupied: (G, G, G) bool over the field's unit cube.
        marching: the steps along rays.
        background: sRGB behind everything, for pictures without alpha.
        training_from_scene: normalisation of the scene to the training frame.
        unit: unit of length of the scene's frame, "arbitrary" or "metre".
        unit_source: how the metre is known; None where unknown.
        log_exposure: mean log exposure of the training photos by EXIF, if the model has gains of photos; see
            `photos.exif_exposure`.
        exif_slope: factor by which gains follow the exposures in EXIF, see `held_out_exposure.exif_slope`.
        exposures: log gains (3,) of held-out photos by name, estimated from the training photos where EXIF does not
            give them; see `render.held_out_exposure`.
        beyond_exif: offsets (3,) to the gains that EXIF predicts, of held-out photos by name.
        sha256: SHA-256 of the file that the model was read from.
    """

    field: Field
    occupied: Tensor
    marching: Marching
    background: Background
    training_from_scene: Similarity
    unit: str
    unit_source: str | None = None
    log_exposure: float | None = None
    exif_slope: float = 1.0
    exposures: Mapping[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    beyond_exif: Mapping[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    sha256: str | None = None

    @property
    def contraction(self) -> str:
        """Contraction of space to the unit cube of the field."""
        return self.field.settings.contraction

    @property
    def device(self) -> torch.device:
        return self.occupied.device

    @property
    def thread_safe(self) -> bool:
        """Whether several threads may render it at the same time; only on a CPU."""
        return self.device.type == "cpu" and kernels.thread_safe()

    def render(
        self,
        frame: Frame,
        *,
        background: Background,
        depth: DepthRequest | None = None,
        on_tile: Callable[[int], None] | None = None,
    ) -> "RenderedPicture":
        """Render a frame, see `render_picture`."""
        from nerfcli.render.pictures import render_picture

        return render_picture(self, frame, background=background, depth=depth, on_tile=on_tile)

    def measured_error(self, frame: Frame, *, depth: DepthRequest | None) -> dict[str, float]:
        """Return the measured error of the rendering, see `measure_error`."""
        from nerfcli.render.accuracy import measure_error
        from nerfcli.render.tracing import TOLERANCE

        return measure_error(self, frame, depth=depth, tolerance=TOLERANCE).to_json()

    def stretched(self, factor: float) -> "Model":
        """Return the same model with steps along rays `factor` times as long."""
        return replace(self, marching=self.marching.stretched(factor))


def save_model(path: Path, model: Model) -> None:
    """Write the model to one file."""
    behind, tensors = model.background, {**model.field.state_dict(), "occupied": model.occupied}
    if isinstance(behind, SphereBackground):
        tensors[BACKGROUND] = behind.logits
    description: dict[str, Any] = {
        "format": FORMAT,
        "field": model.field.settings.to_json(),
        "marching": vars(model.marching),
        "background": {"side": behind.logits.shape[-1]} if isinstance(behind, SphereBackground) else list(behind),
        "training_from_scene": model.training_from_scene.to_json(),
        "unit": model.unit,
        "unit_source": model.unit_source,
        "log_exposure": model.log_exposure,
        "exif_slope": model.exif_slope,
        "exposures": {name: list(gains) for name, gains in model.exposures.items()},
        "beyond_exif": {name: list(gains) for name, gains in model.beyond_exif.items()},
    }
    save_tensors(path, tensors, description)


def load_model(path: Path, device: str) -> Model:
    """Read a model that `save_model` wrote.

    Raises:
        UserError: the file is missing, damaged, not a field of this version, or holds weights that are not finite.
    """
    content = read_checkpoint(path)
    tensors, description = tensors_of(content, path, device)
    if description.get("format") == FORMAT_1:
        description["format"] = FORMAT
        description["field"]["contraction"] = "l2" if description["field"].pop("unbounded") else "none"
    if description.get("format") != FORMAT:
        raise UserError(
            f"{path} is of format {description.get('format')!r}, expected {FORMAT!r}",
            "train again with this version of nerfcli",
        )
    occupied = tensors.pop("occupied")
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
        unit_source=description.get("unit_source"),
        log_exposure=description.get("log_exposure"),
        exif_slope=description.get("exif_slope", 1.0),
        exposures={name: tuple(gains) for name, gains in description.get("exposures", {}).items()},
        beyond_exif={name: tuple(gains) for name, gains in description.get("beyond_exif", {}).items()},
        sha256=hashlib.sha256(content).hexdigest(),
    )


def _background(described: Any, tensors: dict[str, Tensor]) -> Background:
    """Return the background that `save_model` described; removes its tensor from `tensors`."""
    if isinstance(described, dict):
        sphere = SphereBackground(described["side"])
        sphere.logits.data = tensors.pop(BACKGROUND)
        return sphere
    red, green, blue = described
    return red, green, blue
