"""nerfcli.training.open_cells: which cells training rays look into, against fields and samples that are known."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from kernel_parts import KnownField
from present import present
from torch import Tensor

from nerfcli import distributed, kernels
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.kernels import March, Rays, numba_cpu, reference
from nerfcli.kernels.numba_cpu.backend import NumbaBackend
from nerfcli.render.trained_field import Marching
from nerfcli.training.open_cells import (
    DECAY,
    FINE_SIDE,
    OCCUPANCY_SIDE,
    REFRESH_EVERY,
    REFRESH_TURNS,
    Occupancy,
    OpenCells,
    training_points,
)
from nerfcli.training.schedule import THRESHOLD

CPU = torch.device("cpu")
MARCHING = Marching(0.1, 10.0, 0.05, 0.0)
KEEPERS = {"reference": reference.keep_largest, "numba_cpu": numba_cpu.keep_largest}


class Slab(KnownField):
    """A field of optical depth 1 per step up to x = 1/2 of the unit cube, and empty beyond."""

    def density(self, coordinates: Tensor) -> Tensor:
        return torch.where(coordinates[:, 0] < 0.5, 20.0, 0.0)


def cells_of(field: Any) -> OpenCells:
    return OpenCells(field, MARCHING, CPU)


def refresh(cells: OpenCells, step: int) -> None:
    generator = torch.Generator().manual_seed(step)
    cells.refresh(step, threshold=THRESHOLD, detail=1.0, generator=generator)


def visit(cells: OpenCells, where: tuple[int, int, int], depth: float) -> None:
    depths = present(cells.cell_depths)
    depths[where] = max(float(depths[where]), depth)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("name", KEEPERS)
def test_the_largest_value_of_a_cell_is_kept(name, threads):
    """Against NumPy's `maximum.at`, with points on and beyond the border, several in a cell, and none in most."""
    g = torch.Generator().manual_seed(threads)
    coordinates = torch.rand(500, 3, generator=g) * 1.2 - 0.1
    coordinates[0], coordinates[1], coordinates[2] = 0.0, 1.0, torch.tensor([0.0, 1.0, 0.5])
    values, before = torch.randn(500, generator=g), torch.randn(5, 5, 5, generator=g)
    expected = before.numpy().copy()
    place = np.clip(np.floor(coordinates.numpy() * np.float32(5)).astype(int), 0, 4)
    np.maximum.at(expected, (place[:, 2], place[:, 1], place[:, 0]), values.numpy())
    torch.set_num_threads(threads)
    KEEPERS[name](before, coordinates, values)
    assert np.array_equal(before.numpy(), expected)


@pytest.mark.parametrize("name", KEEPERS)
def test_nan_is_no_value_and_no_sample_changes_nothing(name):
    cells = torch.full((2, 2, 2), 0.5)
    KEEPERS[name](cells, torch.full((3, 3), 0.9), torch.tensor([torch.nan, 0.1, torch.nan]))
    KEEPERS[name](cells, torch.zeros(0, 3), torch.zeros(0))
    assert (cells == 0.5).all()
    KEEPERS[name](cells, torch.full((2, 3), 0.9), torch.tensor([torch.nan, 0.7]))
    assert cells[1, 1, 1] == 0.7


@pytest.mark.parametrize("backend", [kernels.Backend, NumbaBackend])
def test_rendering_notes_the_optical_depths_of_its_samples(backend):
    """Against the samples that a step shows to `trace`."""
    torch.manual_seed(0)
    field = HashField(HashFieldSettings(contraction="l2", log2_rows=8, coarsest=4, finest=16))
    with torch.no_grad():
        field.table.normal_(0.0, 0.5)
    field.backend = backend(CPU)
    origins, directions = torch.zeros(9, 3), torch.nn.functional.normalize(torch.randn(9, 3), dim=-1)
    edges = torch.linspace(0.0, 2.0, 22)  # steps of 2/21
    march = March(edges, torch.ones(4, 4, 4, dtype=torch.bool), "l2", 5.0)
    cell_depths, shown = torch.full((6, 6, 6), -1.0), dict[str, Tensor]()
    field.backend.render_rays(
        Rays(origins, directions, torch.zeros(9)), march, field.medium(), background=torch.zeros(9, 3),
        cell_depths=cell_depths, trace=lambda name, values, rays: shown.update({name: values.detach()}),
    )  # fmt: skip
    expected = torch.full((6, 6, 6), -1.0)
    reference.keep_largest(expected, shown["coordinates of samples"], shown["density of samples"] * 2 / 21)
    torch.testing.assert_close(cell_depths, expected, rtol=1e-4, atol=1e-6)
    assert 0.1 < (cell_depths < 0).float().mean() < 0.95


def test_cells_close_where_samples_found_nothing_and_only_there():
    cells = cells_of(Slab())
    full, empty = (3, 4, 5), (3, 4, 6)
    visit(cells, full, 0.5)
    visit(cells, empty, 1e-3)
    refresh(cells, REFRESH_EVERY)
    fine, coarse = cells.at(1), cells.at(REFRESH_EVERY)
    assert fine.shape == (FINE_SIDE,) * 3
    assert coarse.shape == (OCCUPANCY_SIDE,) * 3
    assert coarse[:, :, : OCCUPANCY_SIDE // 2].all()
    assert not coarse[:, :, OCCUPANCY_SIDE // 2 :].any()
    # All other fine cells are as open as the coarse cells that contain them.
    assert fine[full]
    assert not fine[empty]
    assert int(fine.sum()) == FINE_SIDE**3 // 2 - 1


def test_fine_cells_of_thin_fog_stay_open():
    """Like the coarse ones: after a short training everything is thinner than the threshold."""

    class Fog(Slab):
        def density(self, coordinates: Tensor) -> Tensor:
            return torch.where(coordinates[:, 0] < 0.5, 0.02, 0.0)  # optical depths of 1e-3 and 0, 5e-4 on average

    cells = cells_of(Fog())
    visit(cells, (0, 0, 0), 1e-3)
    visit(cells, (0, 0, 1), 1e-4)
    refresh(cells, REFRESH_EVERY)
    assert cells.at(1)[0, 0, 0]
    assert not cells.at(1)[0, 0, 1]


def test_a_closed_cell_opens_as_soon_as_a_sample_finds_something():
    cells, place = cells_of(Slab()), (0, 0, 0)
    visit(cells, place, 0.0)
    refresh(cells, REFRESH_EVERY)
    assert not cells.at(1)[place]
    visit(cells, place, 0.02)
    refresh(cells, 2 * REFRESH_EVERY)
    assert cells.at(1)[place]


def test_what_samples_found_fades_where_they_find_less_and_stays_where_none_is():
    cells, seen, unseen = cells_of(Slab()), (0, 0, 0), (0, 0, 1)
    visit(cells, seen, 0.02)
    visit(cells, unseen, 0.02)
    for turn in range(1, 6):  # 0.02 * 0.8^4 is below the threshold of 0.01
        refresh(cells, turn * REFRESH_EVERY)
        assert cells.at(1)[unseen]
        assert cells.at(1)[seen] == (turn < 5)
        visit(cells, seen, 0.0)


def test_a_coarse_cell_stays_open_while_samples_hit_what_random_points_miss():
    """Here these never hit it: the field is empty wherever it is evaluated at random."""
    cells, needle = cells_of(Slab()), (10, 12, FINE_SIDE - 7)
    coarse = (5, 6, OCCUPANCY_SIDE - 4)
    for turn in range(1, 4 * REFRESH_TURNS):
        visit(cells, needle, 0.02)
        refresh(cells, turn * REFRESH_EVERY)
        assert cells.coarse[coarse]
        assert cells.at(1)[needle]
    assert int(cells.coarse[:, :, OCCUPANCY_SIDE // 2 :].sum()) == 1
    for turn in range(4 * REFRESH_TURNS, 4 * REFRESH_TURNS + 5):  # 0.02 * 0.8^4 is below the threshold
        visit(cells, needle, 1e-4)
        refresh(cells, turn * REFRESH_EVERY)
    assert not cells.coarse[coarse]


def test_nothing_is_looked_at_between_refreshes_nor_before_the_first_step():
    cells = cells_of(Slab())
    for step in (0, 1, REFRESH_EVERY - 1):
        refresh(cells, step)
        assert cells.at(step).all()


def test_visited_cells_are_the_open_ones_in_which_there_was_a_sample():
    cells = cells_of(Slab())
    assert not cells.visited.any()
    visit(cells, (2, 3, 5), 0.5)
    visit(cells, (2, 3, FINE_SIDE - 1), 1e-3)  # where the slab has ended
    assert cells.visited.nonzero().tolist() == [[1, 1, 2], [1, 1, OCCUPANCY_SIDE - 1]]
    for turn in range(1, 3):
        refresh(cells, turn * REFRESH_EVERY)
        assert cells.visited.nonzero().tolist() == [[1, 1, 2]]


def test_a_field_without_detail_has_the_coarse_cells_alone():
    cells = cells_of(Slab(detailed=False))
    refresh(cells, REFRESH_EVERY)
    assert cells.visited is cells.coarse
    assert cells.cell_depths is None
    assert cells.at(1) is cells.coarse
    assert set(cells.state()) == {"optical_depth", "occupied"}


def test_the_samples_of_every_process_count(monkeypatch):
    def keep_largest(tensor: Tensor) -> None:
        tensor[0, 0, 0] = max(float(tensor[0, 0, 0]), 0.0)  # the other process found this cell empty

    monkeypatch.setattr(distributed, "keep_largest", keep_largest)
    cells = cells_of(Slab())
    refresh(cells, REFRESH_EVERY)
    assert not cells.at(1)[0, 0, 0]
    assert cells.at(1)[0, 0, 1]


def test_a_restored_state_goes_on_as_the_saved_one():
    """The state includes what samples have found since the last refresh."""
    first, second = cells_of(Slab()), cells_of(Slab())
    visit(first, (0, 0, 0), 0.02)
    refresh(first, REFRESH_EVERY)
    visit(first, (0, 0, 1), 0.0)
    second.restore({name: tensor.clone() for name, tensor in first.state().items()})
    for turn in (1, 2):
        for step in (1, REFRESH_EVERY):
            assert torch.equal(first.at(step), second.at(step))
        for cells in (first, second):
            refresh(cells, (turn + 1) * REFRESH_EVERY)
    assert not second.at(1)[0, 0, 1]


# Optical depths of the coarse grid: which cells are taken for empty, in fields whose density is known


SIDE = 4


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


def refreshed(grid: Occupancy, field: Any, *, cells: slice = slice(None), step: float = 0.5, growth: float = 0.0):
    generator = torch.Generator().manual_seed(1)
    marching = Marching(near=0.1, far=10.0, shortest_step=step, growth=growth)
    grid.refresh(field, marching, detail=0.25, cells=cells, generator=generator)
    assert field.detail == 0.25
    return grid


@pytest.fixture
def grid() -> Occupancy:
    return Occupancy(SIDE, CPU)


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
