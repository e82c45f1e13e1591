"""nerfcli.training.open_cells: which cells are taken for empty, against a field whose density is known."""

import math
from typing import Any

import pytest
import torch
from kernel_parts import KnownField
from torch import Tensor

from nerfcli.render.trained_field import Marching
from nerfcli.training.open_cells import DECAY, Occupancy, training_points

SIDE = 4
EVERYTHING = slice(None)


class Ramp(KnownField):
    """Density x + 10 y + 100 z in the unit cube; records where it was evaluated."""

    queried = torch.zeros(0, 3)

    def density(self, coordinates: Tensor) -> Tensor:
        self.queried = torch.cat([self.queried, coordinates])
        return coordinates @ torch.tensor([1.0, 10.0, 100.0])


class Even(KnownField):
    """The same density everywhere."""

    def __init__(self, density: float):
        super().__init__()
        self._density = density

    def density(self, coordinates: Tensor) -> Tensor:
        return torch.full((len(coordinates),), self._density)


def refreshed(grid: Occupancy, field: Any, *, cells: slice = EVERYTHING, step: float = 0.5, growth: float = 0.0):
    generator = torch.Generator().manual_seed(1)
    marching = Marching(near=0.1, far=10.0, shortest_step=step, growth=growth)
    grid.refresh(field, marching, detail=0.25, cells=cells, generator=generator)
    assert field.detail == 0.25
    return grid


@pytest.fixture
def grid() -> Occupancy:
    return Occupancy(SIDE, torch.device("cpu"))


def test_each_cell_is_evaluated_at_its_own_random_point(grid):
    """Cells are indexed [z, y, x]; each point is inside its cell, and not in a corner of it."""
    field = Ramp()
    refreshed(grid, field)
    x, y, z = (field.queried * SIDE).floor().to(torch.int64).T
    assert torch.equal((z * SIDE + y) * SIDE + x, torch.arange(SIDE**3))
    inside = field.queried * SIDE % 1
    assert 0.4 < inside.mean() < 0.6
    assert inside.std() > 0.2  # 0.29 for a uniform distribution
    expected = field.queried @ torch.tensor([1.0, 10.0, 100.0]) * 0.5
    torch.testing.assert_close(grid.optical_depth.view(-1), expected)


def test_the_length_of_a_step_grows_with_the_distance_from_the_origin(grid):
    """Closed form: growth r max(1, r), at least the shortest step; r from the origin of the training frame."""
    field = Ramp("l2")
    refreshed(grid, field, step=0.3, growth=0.25)
    radius = training_points(field.queried, "l2").norm(dim=-1)
    length = torch.where(radius > 1, 0.25 * radius**2, 0.25 * radius).clamp_min(0.3)
    assert (radius < 1).any()
    assert (length == 0.3).any()
    density = field.queried @ torch.tensor([1.0, 10.0, 100.0])
    torch.testing.assert_close(grid.optical_depth.view(-1), density * length)


def test_cells_are_a_maximum_that_decays(grid):
    refreshed(grid, Even(8.0))
    for density, expected in ((0.0, 4 * DECAY), (0.0, 4 * DECAY**2), (20.0, 10.0), (1.0, 10 * DECAY)):
        refreshed(grid, Even(density))
        torch.testing.assert_close(grid.optical_depth, torch.full((SIDE,) * 3, expected))
    assert 0 < DECAY < 1


def test_only_the_chosen_cells_are_looked_at(grid):
    refreshed(grid, Even(2.0), cells=slice(1, None, 8))
    measured = grid.optical_depth.view(-1).isfinite()
    assert torch.equal(measured.nonzero()[:, 0], torch.arange(1, SIDE**3, 8))
    # Cells that were never evaluated count as full, and cells exactly at the threshold as empty.
    assert torch.equal(grid.above(1.0).view(-1), ~measured)
    assert grid.above(1 - 1e-6).all()


def test_a_cell_with_nan_is_looked_into(grid):
    refreshed(grid, Even(math.nan))
    assert grid.above(1e9).all()


def test_the_fullest_cells_of_thin_fog_stay_open(grid):
    """With nothing above the threshold, cells above the mean stay open; a NaN in one cell is left out of the mean."""
    refreshed(grid, Ramp())
    depth = grid.optical_depth
    assert torch.equal(grid.above(1e9), depth > depth.double().mean())
    assert torch.equal(grid.above(1e-3), depth > 1e-3)
    depth[0, 0, 0] = math.nan
    assert torch.equal(grid.above(1e9), ~(depth <= depth[depth.isfinite()].double().mean()))
