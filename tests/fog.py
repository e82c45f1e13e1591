"""A model whose every ray is known in closed form: fog of density 1 and colour 1/2 in chosen cells of the cube.

One path through the networks carries a constant to the density, all else in them is 0: the colour is sigmoid(0). What
is in the picture is then the occupancy grid's business alone.
"""

import torch
from torch import Tensor

from nerfcli.cameras.rigid import Similarity
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.render.model import Marching, Model

# Rays are cut into steps of this length; a border of the fog is seen at most half a step off.
STEP = 1 / 256
SIDE = 16
TINY = HashFieldSettings(contraction="none", levels=2, log2_rows=8, coarsest=4, finest=16, width=16)


def foggy_cells(low: tuple[float, float, float], high: tuple[float, float, float]) -> Tensor:
    """(SIDE, SIDE, SIDE) bool, indexed [z, y, x]: the cells of [-1, 1]^3 whose centres lie in a box along the axes."""
    centres = (torch.arange(SIDE) + 0.5) / SIDE * 2 - 1
    x, y, z = ((centres >= a) & (centres <= b) for a, b in zip(low, high, strict=True))
    return z[:, None, None] & y[None, :, None] & x[None, None, :]


def fog(
    occupied: Tensor,
    training_from_scene: Similarity,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    step: float = STEP,
    unit: str = "arbitrary",
) -> Model:
    """The model; `training_from_scene.scale` is the density in 1 / scene unit."""
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
