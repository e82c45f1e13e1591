"""A model with a closed-form answer for every ray: fog of density 1 and colour 1/2 in chosen cells of the cube.

Features and networks are 0 except on one path to the log density, whose last weight is also 0: the density is exp(0),
the colour sigmoid(0). The picture therefore depends only on the occupancy grid. The sizes are those of the compiled
kernels, which render it ten times as fast as the reference.
"""

import torch
from torch import Tensor

from nerfcli.cameras.rigid import Similarity
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.render.model import Model
from nerfcli.render.trained_field import Marching

# Length of the steps into which rays are cut; it moves a border of the fog by at most half a step.
STEP = 1 / 256
SIDE = 16
TINY = HashFieldSettings(contraction="none", levels=8, log2_rows=8, coarsest=4, finest=16)


def foggy_cells(low: tuple[float, float, float], high: tuple[float, float, float]) -> Tensor:
    """Return the cells of [-1, 1]^3 with centres in an axis-aligned box: (SIDE, SIDE, SIDE) bool, indexed [z, y, x]."""
    centres = (torch.arange(SIDE) + 0.5) / SIDE * 2 - 1
    x, y, z = ((centres >= a) & (centres <= b) for a, b in zip(low, high, strict=True))
    return z[:, None, None] & y[None, :, None] & x[None, None, :]


CUBE = foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))


def fog(
    occupied: Tensor,
    training_from_scene: Similarity,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    step: float = STEP,
    unit: str = "arbitrary",
) -> Model:
    """Return the model; `training_from_scene.scale` is the density in 1 / scene unit."""
    field = HashField(TINY)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.zero_()
        field.table[0, :, 0] = 1.0
        field.weights[0][0, 0] = 1.0
        field.weights[1][0, 0] = 0.0
    return Model(
        field=field,
        occupied=occupied,
        marching=Marching(near=0.01, far=5.0, shortest_step=step, growth=0.0),
        background=background,
        training_from_scene=training_from_scene,
        unit=unit,
    )
