"""Number of parameters and storage of a field, by arithmetic."""

from collections.abc import Sequence
from itertools import pairwise

from torch import nn

from nerfcli.field.fourier_field import FourierFieldSettings
from nerfcli.field.hash_field import GEOMETRY, HARMONICS, HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.voxel_field import FEATURES, VoxelFieldSettings


def parameter_bytes(settings: FieldSettings) -> int:
    """Return the bytes of a field's float32 parameters, before it is made; see `parameter_count`."""
    return 4 * parameter_count(settings)


def field_bytes(field: nn.Module) -> int:
    """Return the bytes of a field's parameters."""
    return sum(parameter.nbytes for parameter in field.parameters())


def parameter_count(settings: FieldSettings) -> int:
    """Return how many numbers a field with these settings learns.

    Raises:
        ValueError: an unknown kind.
    """
    match settings:
        case HashFieldSettings():
            width = settings.width
            density = (settings.levels * settings.features, width, GEOMETRY)
            colour = (GEOMETRY + HARMONICS, width, width, 3)
            return settings.levels * 2**settings.log2_rows * settings.features + _products(density) + _products(colour)
        case VoxelFieldSettings():
            return settings.layers * 2**settings.log2_vertices * FEATURES
        case FourierFieldSettings():
            trunk = (6 * settings.octaves, *[settings.width] * settings.layers)
            colour = (settings.width + HARMONICS, settings.width // 2, 3)
            biases = sum(trunk[1:]) + 1 + sum(colour[1:])
            return _products(trunk) + settings.width + _products(colour) + biases
        case _:
            raise ValueError(f"the size of {type(settings).__name__} is unknown")


def _products(sizes: Sequence[int]) -> int:
    """Return the number of weights of consecutive layers, without biases."""
    return sum(inputs * outputs for inputs, outputs in pairwise(sizes))
