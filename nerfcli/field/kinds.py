"""Kinds of fields: how each is made, how large it is, what it costs."""

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import nn

from nerfcli.errors import UserError
from nerfcli.field.fourier_field import FourierField, FourierFieldSettings
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.field.interface import Field, FieldSettings
from nerfcli.field.voxel_field import VoxelField, VoxelFieldSettings

_FIELDS: dict[type[FieldSettings], type[Field]] = {
    HashFieldSettings: HashField,
    VoxelFieldSettings: VoxelField,
    FourierFieldSettings: FourierField,
}
KINDS = tuple(settings.kind for settings in _FIELDS)


def fresh_field(settings: FieldSettings) -> Field:
    """Return an untrained field, initialised from torch's random numbers."""
    return _FIELDS[type(settings)](settings)


def settings_from_json(content: dict[str, Any]) -> FieldSettings:
    """Read settings from `FieldSettings.to_json`.

    Raises:
        UserError: the kind is not known here.
    """
    sizes = dict(content)
    kind = sizes.pop("kind")
    for settings in _FIELDS:
        if settings.kind == kind:
            return settings(**sizes)
    raise UserError(f"unknown type of field: {kind!r}", "use the version of nerfcli that trained it")


# A field may be larger than requested by this fraction: a hash grid of 2^20 bytes and its networks are 1 MB, too.
SLACK = 0.07
# Memory of a dense grid and of a network by default.
VOXEL_BYTES, NETWORK_BYTES = 2**26, 2**18
# Harmonics above this degree would make a vertex of a dense grid larger by three quarters.
VOXEL_DEGREE = 2
LOG2_ROWS = range(8, 25)
# A detailed hash grid has cells as small as a pixel's footprint, but at most this many along the side of its cube.
MOST_CELLS = 4096
LOG2_VERTICES = range(6, 28)
WIDTHS = range(16, 8193, 16)
OCTAVES = (4, 12)


def chosen_size(
    kind: str, *, hash_grid: HashFieldSettings, footprint: float, memory_bytes: int | None
) -> FieldSettings:
    """Return the settings of a field of a kind, sized for a capture.

    No photo shows detail finer than a pixel: a dense grid has no cells smaller than a pixel's footprint, the finest
    octave of Fourier features has a period of at least two footprints, and the cells of a large hash grid's finest
    level are at most as large as the footprint, all within the limits above. The memory sets the number of parameters.

    Args:
        hash_grid: settings of a hash grid, whose `contraction` and `view_degree` hold for every kind; its `log2_rows`
            is replaced if `memory_bytes` is given.
        footprint: width of a pixel at the centre of the scene, in units of the training frame, in the median photo.
        memory_bytes: limit for the field's parameters; None keeps the rows of a hash grid, and means 64 MiB for a
            dense grid and 1/4 MiB for a network, each of whose parameters costs time at every sample.

    Raises:
        UserError: the smallest field is larger than the memory.
        ValueError: an unknown kind.
    """
    contraction, view_degree = hash_grid.contraction, hash_grid.view_degree
    cells = cube_side(contraction) / footprint  # as wide as a pixel, along the side of the cube

    def tables(log2_rows: int) -> HashFieldSettings:
        size = replace(hash_grid, log2_rows=log2_rows)
        return replace(size, finest=max(size.finest, min(round(cells), MOST_CELLS))) if size.detailed else size

    def voxels(log2_vertices: int) -> VoxelFieldSettings:
        degree = min(view_degree, VOXEL_DEGREE)
        return VoxelFieldSettings(contraction=contraction, view_degree=degree, log2_vertices=log2_vertices)

    def network(width: int) -> FourierFieldSettings:
        octaves = min(max(math.floor(math.log2(cells)), OCTAVES[0]), OCTAVES[1])
        return FourierFieldSettings(contraction=contraction, view_degree=view_degree, width=width, octaves=octaves)

    match kind:
        case HashFieldSettings.kind:
            if memory_bytes is None:
                return tables(hash_grid.log2_rows)
            return _largest_within(LOG2_ROWS, tables, memory_bytes)
        case VoxelFieldSettings.kind:
            sizes = [size for size in LOG2_VERTICES if voxels(size).resolution <= cells] or LOG2_VERTICES[:1]
            return _largest_within(sizes, voxels, memory_bytes or VOXEL_BYTES)
        case FourierFieldSettings.kind:
            return _largest_within(WIDTHS, network, memory_bytes or NETWORK_BYTES)
        case _:
            raise ValueError(f"unknown type of field: {kind!r}")


def cube_side(contraction: str) -> float:
    """Return the side of the cube of `grid_coordinates` in training units, those at its centre if it is contracted."""
    return 2.0 if contraction == "none" else 4.0


def _largest_within(sizes: Sequence[int], settings: Callable[[int], FieldSettings], memory_bytes: int) -> FieldSettings:
    """Return the settings of the last of increasing sizes whose parameters fit into the memory, enlarged by `SLACK`."""
    limit = memory_bytes * (1 + SLACK)
    fitting = bisect_right(sizes, limit, key=lambda size: parameter_bytes(settings(size)))
    if fitting == 0:
        smallest = parameter_bytes(settings(sizes[0]))
        raise UserError(
            f"no field fits into {memory_bytes} bytes: the smallest needs {smallest}", "give a larger --field-memory"
        )
    return settings(sizes[fitting - 1])


def parameter_bytes(settings: FieldSettings) -> int:
    """Return the bytes of a field's parameters, before it is made."""
    with torch.device("meta"):  # which takes neither memory nor random numbers
        return field_bytes(fresh_field(settings))


def field_bytes(field: nn.Module) -> int:
    """Return the bytes of a field's parameters."""
    return sum(parameter.nbytes for parameter in field.parameters())
