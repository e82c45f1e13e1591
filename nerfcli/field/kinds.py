"""The kinds of fields, by their names in checkpoints and on the command line."""

from typing import Any

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
    """Read settings from `FieldSettings.to_json`; without a kind, they are those of a hash grid.

    Raises:
        UserError: the kind is not known here.
    """
    sizes = {name: value for name, value in content.items() if name != "kind"}
    kind = content.get("kind", HashFieldSettings.kind)
    for settings in _FIELDS:
        if settings.kind == kind:
            return settings(**sizes)
    raise UserError(f"unknown type of field: {kind!r}", "use the version of nerfcli that trained it")
