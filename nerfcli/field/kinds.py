"""The kinds of fields, by their names in checkpoints and on the command line."""

import math
from typing import Any

import torch

from nerfcli.errors import UserError
from nerfcli.field.blocks_field import Block, BlocksField, BlocksFieldSettings, cell_end
from nerfcli.field.fourier_field import FourierField, FourierFieldSettings
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.field.interface import Field, FieldSettings
from nerfcli.field.voxel_field import VoxelField, VoxelFieldSettings

# The kinds that can be trained.
_TRAINED: dict[type[FieldSettings], type[Field]] = {
    HashFieldSettings: HashField,
    VoxelFieldSettings: VoxelField,
    FourierFieldSettings: FourierField,
}
KINDS = tuple(settings.kind for settings in _TRAINED)


def fresh_field(settings: FieldSettings) -> Field:
    """Return an untrained field, initialised from torch's random numbers."""
    if not isinstance(settings, BlocksFieldSettings):
        return _TRAINED[type(settings)](settings)
    fields = [fresh_field(block.field) for block in settings.blocks]
    shape = (len(fields), *[settings.occupancy_side] * 3)
    return BlocksField(settings, fields, torch.zeros(shape, dtype=torch.bool))


def settings_from_json(content: dict[str, Any]) -> FieldSettings:
    """Read settings from `FieldSettings.to_json`; without a kind, they are those of a hash grid.

    Raises:
        UserError: the kind is not known here.
    """
    sizes = {name: value for name, value in content.items() if name != "kind"}
    kind = content.get("kind", HashFieldSettings.kind)
    if kind == BlocksFieldSettings.kind:
        sizes["ground"], sizes["blocks"] = tuple(map(tuple, sizes["ground"])), tuple(map(_block, sizes["blocks"]))
        return BlocksFieldSettings(**sizes)
    for settings in _TRAINED:
        if settings.kind == kind:
            return settings(**sizes)
    raise UserError(f"unknown type of field: {kind!r}", "use the version of nerfcli that trained it")


def _block(content: dict[str, Any]) -> Block:
    return Block(
        field=settings_from_json(content["field"]),
        centre=tuple(content["centre"]),
        radius=content["radius"],
        low=cell_end(content["low"], -math.inf),
        high=cell_end(content["high"], math.inf),
    )
