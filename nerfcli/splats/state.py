"""RUN/splats.safetensors: the splats of a run, with the state of their refinement so that it can go on."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError
from nerfcli.field.checkpoint import load_tensors, save_tensors
from nerfcli.kernels.numba_cpu.splats import SplatAdam
from nerfcli.splats.gaussians import Gaussians, gaussians_of
from nerfcli.splats.refine import Refinement

FORMAT = "nerfcli splats 1"


@dataclass(frozen=True)
class RunSplats:
    """Splats of a run.

    Args:
        refinement: in the training frame.
        log_gains: (P, 3) of the training photos, see `Start`.
        background: sRGB.
        training_from_scene: the normalisation of the field.
        field_sha256: of the field that they began with.
        count: the largest number of Gaussians that was asked for.
    """

    refinement: Refinement
    log_gains: np.ndarray
    background: tuple[float, float, float]
    training_from_scene: Similarity
    field_sha256: str
    count: int

    @property
    def degree(self) -> int:
        """Degree of the harmonics."""
        return gaussians_of(self.refinement.rows[:1]).degree

    def gaussians(self) -> Gaussians:
        """Return the Gaussians in the scene's frame."""
        return gaussians_of(self.refinement.rows).moved(self.training_from_scene.inverse())


def save_splats(path: Path, splats: RunSplats) -> None:
    """Write splats with their state; the file appears whole or not at all."""
    state = splats.refinement
    arrays = {
        "rows": state.rows,
        "sizes": state.sizes,
        "first": state.adam.first,
        "second": state.adam.second,
        "steps_of_rows": state.adam.steps,
        "log_gains": splats.log_gains,
    }
    description = {
        "format": FORMAT,
        "steps": state.steps,
        "seconds": state.seconds,
        "background": list(splats.background),
        "training_from_scene": splats.training_from_scene.to_json(),
        "field_sha256": splats.field_sha256,
        "count": splats.count,
    }
    save_tensors(path, {name: torch.from_numpy(values) for name, values in arrays.items()}, description)


def load_splat_state(path: Path) -> RunSplats:
    """Read splats that `save_splats` wrote.

    Raises:
        UserError: the file is missing, damaged, or of another version.
    """
    tensors, description = load_tensors(path, "cpu")
    if description.get("format") != FORMAT:
        raise UserError(
            f"{path} is of format {description.get('format')!r}, expected {FORMAT!r}", "delete it and export again"
        )
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    adam = SplatAdam(arrays["first"], arrays["second"], arrays["steps_of_rows"])
    red, green, blue = description["background"]
    return RunSplats(
        Refinement(arrays["rows"], adam, arrays["sizes"], description["steps"], description["seconds"]),
        arrays["log_gains"],
        (red, green, blue),
        Similarity.from_json(description["training_from_scene"]),
        description["field_sha256"],
        description["count"],
    )
