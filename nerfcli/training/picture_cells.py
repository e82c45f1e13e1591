"""Empty cells between the cameras and the surfaces of a trained field, which pictures need not sample.

The cells of the occupancy grid are much larger than the steps along rays, so most samples of a picture lie in air just
before a surface. After a training, all cells of a finer grid that its rays cross are examined once.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.frame import Frame
from nerfcli.kernels.reference import sample_coordinates
from nerfcli.render.model import Model
from nerfcli.render.tracing import pixel_rays, render_rays
from nerfcli.training.open_cells import step_depths

SIDE = 256
# Steps after which a field has surfaces; before, it is fog, which leaves no cell empty.
FEWEST_STEPS = 200
# Rays of all photos together that mark the cells to examine, and the number at a time.
NUM_RAYS, AT_A_TIME = 150_000, 2**14
# Random points of a cell, one in each of 3 x 3 x 3 parts.
PARTS = 3
# Optical depth of a step below which a point is empty. What a ray loses in such cells is below 0.2 % of its light.
EMPTY = 3e-4


@torch.no_grad()
def with_picture_cells(model: Model, frames: Sequence[Frame]) -> Model:
    """Return the model with the open cells of a fine grid: those that hold something, or that no ray of a photo meets.

    Args:
        frames: training photos with their cameras; the rays are those of random pixels, the same for the same model.
    """
    crossed = _crossed_cells(model, frames).nonzero()[:, 0]
    cells = crossed[_are_empty(model, crossed)]
    fine = model.occupied
    for axis in range(3):
        fine = fine.repeat_interleave(SIDE // len(model.occupied), dim=axis)
    fine = fine.contiguous()
    fine.view(-1)[cells] = False
    return replace(model, fine=fine)


def _crossed_cells(model: Model, frames: Sequence[Frame]) -> Tensor:
    """Mark the cells (SIDE^3,) in which rays of the photos have samples before they end."""
    crossed = torch.zeros(SIDE**3, dtype=torch.bool, device=model.device)
    chosen = np.random.default_rng(0)
    for frame in frames:
        pixels = frame.camera.width * frame.camera.height
        some = np.sort(chosen.choice(pixels, min(pixels, max(1, NUM_RAYS // len(frames))), replace=False))
        rays = pixel_rays(frame, model.training_from_scene, pixels=some, device=model.device)
        for directions, cones in zip(rays.directions.split(AT_A_TIME), rays.cones.split(AT_A_TIME), strict=True):
            origins = rays.origin.expand_as(directions).contiguous()
            seen = render_rays(model, origins, directions, background=origins.new_zeros(3), cones=cones).intervals
            coordinates = sample_coordinates(
                origins, directions, seen.starts, seen.ends, offsets=seen.offsets, contraction=model.contraction
            )
            x, y, z = (coordinates * SIDE).long().clamp(0, SIDE - 1).unbind(1)
            crossed[(z * SIDE + y) * SIDE + x] = True
    return crossed


def _are_empty(model: Model, cells: Tensor) -> Tensor:
    """Return whether nothing is at the examined points of each cell, given by number (z * SIDE + y) * SIDE + x."""
    generator = torch.Generator(model.device).manual_seed(0)
    places = torch.stack([cells % SIDE, cells // SIDE % SIDE, cells // SIDE**2], dim=-1)
    empty = torch.ones_like(cells, dtype=torch.bool)
    for part in torch.cartesian_prod(*[torch.arange(PARTS, device=model.device)] * 3):
        left = empty.nonzero()[:, 0]
        inside = torch.rand(len(left), 3, generator=generator, device=model.device)
        coordinates = (places[left] + (part + inside) / PARTS) / SIDE
        empty[left] = step_depths(model.field, coordinates, model.marching) <= EMPTY  # False at NaN
    return empty
