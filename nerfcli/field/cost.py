"""Storage and work, by arithmetic: what a field costs before anything is run."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from torch import nn

from nerfcli.field.fourier_field import FourierFieldSettings
from nerfcli.field.hash_field import GEOMETRY, HARMONICS, HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.voxel_field import FEATURES, VoxelFieldSettings

FLOAT_BYTES = 4
CORNERS = 8
# Cost of a forward and a backward pass, in forward passes, for operations and for bytes of rows: the gradients of a
# product are two more products of its size, and the gradient of a row is read and written.
TRAINING = 3


def parameter_bytes(count: int) -> int:
    """Return the bytes of `count` parameters, without activations and optimiser state."""
    return count * FLOAT_BYTES


def optimiser_bytes(count: int) -> int:
    """Return the bytes that training needs besides `count` parameters: their gradients and the two moments of Adam."""
    return 3 * parameter_bytes(count)


def occupancy_bytes(side: int) -> int:
    """Return the bytes of the occupancy grid that rendering needs: a flag per cell."""
    return side**3


def field_bytes(field: nn.Module) -> int:
    """Return the bytes of a field's parameters."""
    return sum(parameter.nbytes for parameter in field.parameters())


@dataclass(frozen=True)
class Work:
    """Cost of querying a field, per sample, forward.

    Operations are multiplications and additions of products and interpolations; activations, sines, harmonics and
    index arithmetic are left out. Bytes moved are those of the rows that a sample reads, each once; of a network
    without rows, those of its layers' values, written and read again. Weights that all samples share are left out.

    Args:
        parameters: numbers that are learned.
        density_operations, colour_operations: for the density, and for the colour on top of it.
        density_bytes, colour_bytes: moved for the density, and for the colour on top of it.
        kept_values: numbers of a sample that training keeps for the backward pass.
    """

    parameters: int
    density_operations: int
    colour_operations: int
    density_bytes: int
    colour_bytes: int
    kept_values: int

    @property
    def operations(self) -> int:
        return self.density_operations + self.colour_operations

    @property
    def bytes_moved(self) -> int:
        return self.density_bytes + self.colour_bytes

    def activation_bytes(self, samples: int) -> int:
        """Return the bytes that a training step over this many samples keeps for the backward pass."""
        return self.kept_values * samples * FLOAT_BYTES


def work(settings: FieldSettings) -> Work:
    """Return the storage and work of a field with these settings."""
    match settings:
        case HashFieldSettings():
            return _hash_grid(settings)
        case VoxelFieldSettings():
            return _voxels(settings)
        case FourierFieldSettings():
            return _network(settings)
        case _:
            raise ValueError(f"the cost of {type(settings).__name__} is unknown")


# Values kept of a sample of any field: its position, interval, density and colour, and the weight of its colour.
_OF_A_SAMPLE = 3 + 2 + 1 + 3 + 1


def _hash_grid(settings: HashFieldSettings) -> Work:
    encoded, width = settings.levels * settings.features, settings.width
    density = (encoded, width, GEOMETRY)
    colour = (GEOMETRY + HARMONICS, width, width, 3)
    weights = _products(density) + _products(colour)
    return Work(
        parameters=settings.levels * 2**settings.log2_rows * settings.features + weights,
        density_operations=_interpolation(settings.levels, settings.features) + 2 * _products(density),
        colour_operations=2 * _products(colour),
        density_bytes=settings.levels * CORNERS * settings.features * FLOAT_BYTES,
        colour_bytes=0,
        kept_values=encoded + _OF_A_SAMPLE,  # the compiled networks recompute their layers
    )


def _voxels(settings: VoxelFieldSettings) -> Work:
    layers, harmonics = settings.layers, settings.harmonics
    return Work(
        parameters=layers * 2**settings.log2_vertices * FEATURES,
        density_operations=_interpolation(1, FEATURES),
        colour_operations=_interpolation(layers - 1, FEATURES) + 2 * 3 * harmonics,
        density_bytes=CORNERS * FEATURES * FLOAT_BYTES,
        colour_bytes=(layers - 1) * CORNERS * FEATURES * FLOAT_BYTES,
        kept_values=layers * FEATURES + harmonics + 3 * harmonics + _OF_A_SAMPLE,
    )


def _network(settings: FourierFieldSettings) -> Work:
    trunk = (6 * settings.octaves, *[settings.width] * settings.layers)
    colour = (settings.width + HARMONICS, settings.width // 2, 3)
    biases = sum(trunk[1:]) + 1 + sum(colour[1:])
    return Work(
        parameters=_products(trunk) + settings.width + _products(colour) + biases,
        density_operations=2 * (_products(trunk) + settings.width),
        colour_operations=2 * _products(colour),
        density_bytes=2 * FLOAT_BYTES * sum(trunk),
        colour_bytes=2 * FLOAT_BYTES * sum(colour[:2]),
        kept_values=sum(trunk) + sum(colour[:2]) + _OF_A_SAMPLE,
    )


def _products(sizes: Sequence[int]) -> int:
    """Return the number of weights of consecutive layers, without biases: each multiplied and added once per sample."""
    return sum(inputs * outputs for inputs, outputs in pairwise(sizes))


def _interpolation(levels: int, features: int) -> int:
    """Return the cost of trilinear interpolation: per corner two products, then two operations per feature."""
    return levels * CORNERS * (2 + 2 * features)
