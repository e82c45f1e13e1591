"""Storage: counts against what a checkpoint holds; sizes chosen for a capture."""

from dataclasses import replace

import pytest

from nerfcli import kernels
from nerfcli.errors import UserError
from nerfcli.field.fourier_field import FourierFieldSettings
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.kinds import KINDS, chosen_size, field_bytes, fresh_field, parameter_bytes
from nerfcli.field.voxel_field import VoxelFieldSettings

HASH = HashFieldSettings(contraction="none")
SEVERAL: list[FieldSettings] = [
    replace(HASH, log2_rows=8),
    replace(HASH, log2_rows=6, levels=3, width=16),
    VoxelFieldSettings(contraction="l2", view_degree=2, log2_vertices=9),
    VoxelFieldSettings(contraction="l2", view_degree=0, log2_vertices=9),
    FourierFieldSettings(contraction="none", octaves=4, width=24, layers=3),
]


@pytest.mark.parametrize("settings", SEVERAL, ids=str)
def test_bytes_are_those_of_the_checkpoint(settings):
    field = fresh_field(settings)
    stored = sum(4 * tensor.numel() for tensor in field.state_dict().values())
    assert parameter_bytes(settings) == field_bytes(field) == stored


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
    taken = parameter_bytes(settings)
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
    assert parameter_bytes(larger) > 1.07 * memory


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
