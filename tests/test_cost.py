"""Storage and work: counts against the modules themselves, torch's own count of operations, and hand arithmetic."""

from dataclasses import replace

import pytest
import torch
from kernel_parts import radiance_of
from torch.utils.flop_counter import FlopCounterMode

from nerfcli import kernels
from nerfcli.errors import UserError
from nerfcli.field.comparison import described_cost, other_kinds_with_equal_storage
from nerfcli.field.cost import field_bytes, optimiser_bytes, parameter_bytes, work
from nerfcli.field.fourier_field import FourierField, FourierFieldSettings
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.kinds import KINDS, fresh_field
from nerfcli.field.sizes import chosen_size
from nerfcli.field.voxel_field import VoxelFieldSettings
from nerfcli.fit.optimiser import FieldOptimiser
from nerfcli.kernels import reference

HASH = HashFieldSettings(contraction="none")
SEVERAL: list[FieldSettings] = [
    replace(HASH, log2_rows=8),
    replace(HASH, log2_rows=6, levels=3, width=16),
    VoxelFieldSettings(contraction="l2", view_degree=2, log2_vertices=9),
    VoxelFieldSettings(contraction="l2", view_degree=0, log2_vertices=9),
    FourierFieldSettings(contraction="none", octaves=4, width=24, layers=3),
]
MIB = 2**20


@pytest.mark.parametrize("settings", SEVERAL, ids=str)
def test_bytes_are_those_of_the_module_and_of_its_optimiser(settings):
    field = fresh_field(settings)
    assert parameter_bytes(work(settings).parameters) == field_bytes(field)
    optimiser = FieldOptimiser(field)
    density, rgb = radiance_of(field, torch.rand(3, 3), torch.eye(3), torch.arange(3))
    (density.sum() + rgb.sum()).backward()
    optimiser.step(1, 0.0, decay=0.0)
    moments = [value for name, value in optimiser.state().items() if not name.endswith("step")]
    held = sum(4 * value.numel() for value in moments) + field_bytes(field)  # and a gradient per parameter
    assert optimiser_bytes(work(settings).parameters) == held


def test_operations_of_the_network_are_those_that_torch_counts():
    settings = FourierFieldSettings(contraction="none", octaves=4, width=24, layers=3)
    field, samples = FourierField(settings), 100
    with FlopCounterMode(display=False) as density:
        field.density(torch.rand(samples, 3))
    with FlopCounterMode(display=False) as both:
        field.radiance(torch.rand(samples, 3), torch.eye(3), torch.zeros(samples, dtype=torch.int64))
    assert density.get_total_flops() == samples * work(settings).density_operations
    assert both.get_total_flops() == samples * work(settings).operations


def test_operations_of_the_hash_grids_networks_are_those_that_torch_counts():
    field, samples = fresh_field(HASH), 100
    rays = torch.zeros(samples, dtype=torch.int64)
    weights = tuple(field.parameters())[1:]
    with FlopCounterMode(display=False) as counted:
        reference.radiance(torch.rand(samples, 32), torch.rand(2, 16), rays, weights)
    interpolation = 8 * 8 * (2 + 2 * 4)  # levels, corners, two products for the weight, a multiply-add per feature
    assert counted.get_total_flops() == samples * (work(HASH).operations - interpolation)


def test_the_default_hash_grid_by_hand():
    counts = work(HASH)
    assert counts.parameters == 8 * 65536 * 4 + 32 * 32 + 16 * 32 + 32 * 32 + 32 * 32 + 3 * 32 == 2_100_832
    assert counts.density_operations == 640 + 2 * (32 * 32 + 32 * 16) == 3712
    assert counts.colour_operations == 2 * (32 * 32 + 32 * 32 + 32 * 3) == 4288
    assert counts.density_bytes == 8 * 8 * 16  # a row of 16 bytes at 8 corners of 8 levels


def test_dense_grids_by_the_worked_example():
    """A 128^3 grid: 8 MiB for one number, 32 MiB for density and colour; twice the side is eight times as much."""
    grey = VoxelFieldSettings(contraction="none", view_degree=0, log2_vertices=21)
    assert grey.resolution == 127  # between 128^3 vertices
    assert parameter_bytes(work(grey).parameters) == 4 * 128**3 * 4 == 32 * MIB
    assert work(replace(grey, log2_vertices=24)).parameters == 8 * work(grey).parameters
    # One million numbers are four million bytes, and three times that again in training.
    assert (parameter_bytes(10**6), optimiser_bytes(10**6)) == (4_000_000, 12_000_000)


def test_a_picture_of_the_worked_example():
    """256 x 256 pixels at 64 samples: 4,194,304 queries."""
    reported = described_cost(HASH, occupancy_side=64, batch=2**16, samples_per_ray=64.0, picture_px=256 * 256)
    assert reported["per_picture"] == {
        "samples": 4_194_304,
        "operations": 4_194_304 * 8000,
        "bytes_moved": 4_194_304 * 1024,
    }
    assert reported["bytes"]["occupancy"] == 64**3
    assert reported["per_step"]["operations"] == 3 * 2**16 * 8000


@pytest.mark.parametrize(
    ("log2_rows", "contraction", "footprint", "finest"),
    [
        (16, "l2", 1 / 500, 1024),
        (17, "l2", 1 / 500, 2000),
        (18, "none", 1 / 1000, 2000),
        (18, "l2", 1 / 100, 1024),
        (18, "l2", 1 / 5000, 4096),
    ],
)
def test_large_tables_have_cells_as_small_as_a_footprint(log2_rows, contraction, footprint, finest):
    """The cube's side is 2 units of a bounded scene, and 4 of a contracted one."""
    grid = HashFieldSettings(contraction=contraction, log2_rows=log2_rows)
    chosen = chosen_size("hash", hash_grid=grid, footprint=footprint, memory_bytes=None)
    assert chosen == replace(grid, finest=finest)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("megabytes", [1, 4, 16, 64])
def test_the_chosen_size_is_the_largest_that_fits(kind, megabytes):
    memory = megabytes * 10**6
    settings = chosen_size(kind, hash_grid=HASH, footprint=1 / 500, memory_bytes=memory)
    taken = parameter_bytes(work(settings).parameters)
    assert 0.45 * memory < taken <= 1.07 * memory
    match settings:
        case HashFieldSettings():
            larger = replace(settings, log2_rows=settings.log2_rows + 1)
        case VoxelFieldSettings():
            larger = replace(settings, log2_vertices=settings.log2_vertices + 1)
        case FourierFieldSettings():
            larger = replace(settings, width=settings.width + 16)
        case _:
            raise AssertionError(settings)
    assert parameter_bytes(work(larger).parameters) > 1.07 * memory


@pytest.mark.parametrize("contraction", kernels.CONTRACTIONS)
def test_nothing_is_finer_than_a_pixel(contraction):
    """A pixel covers 1/100 of the training frame's unit: 200 cells across [-1, 1], 400 across the contracted ball."""
    cells = 200 if contraction == "none" else 400
    template = replace(HASH, contraction=contraction)
    sizes = {kind: chosen_size(kind, hash_grid=template, footprint=0.01, memory_bytes=2**34) for kind in KINDS[1:]}
    assert isinstance(sizes["voxels"], VoxelFieldSettings)
    assert cells / 2 ** (1 / 3) < sizes["voxels"].resolution + 1 <= cells + 1
    assert isinstance(sizes["mlp"], FourierFieldSettings)
    assert cells / 2 < 2 ** sizes["mlp"].octaves <= cells


def test_memory_that_holds_no_field_is_reported():
    with pytest.raises(UserError, match="no field fits into 100 bytes: the smallest needs"):
        chosen_size("voxels", hash_grid=HASH, footprint=0.01, memory_bytes=100)


def test_others_of_equal_storage_are_not_larger():
    for settings in (HASH, VoxelFieldSettings(contraction="l2", view_degree=2), FourierFieldSettings(contraction="l2")):
        others = other_kinds_with_equal_storage(settings, 1 / 300)
        assert set(others) == set(KINDS) - {settings.kind}
        for other in others.values():
            assert work(other).parameters <= 1.07 * work(settings).parameters
    # Nothing else is as small as this network.
    tiny = FourierFieldSettings(contraction="none", octaves=4, width=16, layers=1)
    assert set(other_kinds_with_equal_storage(tiny, 1 / 300)) == set()
