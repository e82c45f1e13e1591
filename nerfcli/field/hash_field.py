"""The radiance field: a multiresolution hash grid with a small density network and a small colour network."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from nerfcli import kernels
from nerfcli.field.encodings import spherical_harmonics

# Outputs of the density network, the logarithm of the density first; all of them go on to the colour network.
GEOMETRY = 16
HARMONICS = 16


@dataclass(frozen=True)
class HashFieldSettings:
    """Size of the field.

    Args:
        unbounded: whether space beyond the central ball is contracted into the grid.
        levels, features: grids from coarse to fine, and numbers per table row.
        log2_rows: rows per level as a power of two.
        coarsest, finest: cells per axis of the first and the last level; those between are in geometric progression.
        width: neurons of the hidden layers.
        view_degree: spherical harmonics of the direction that colours may depend on, 0 (not at all) to 3.
    """

    unbounded: bool
    levels: int = 8
    features: int = 4
    log2_rows: int = 16
    coarsest: int = 16
    finest: int = 1024
    width: int = 32
    view_degree: int = 3

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells per axis of each level."""
        growth = math.log(self.finest / self.coarsest) / max(1, self.levels - 1)
        return tuple(round(self.coarsest * math.exp(growth * level)) for level in range(self.levels))

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


class HashField(nn.Module):
    """Density by position, colour by position and direction, on coordinates of the unit cube.

    Positions are those of `kernels.grid_coordinates`. The table starts near zero and the networks have no biases, so a
    fresh field is a grey fog of density 1: thin enough that every sample of a ray gets a gradient.
    """

    def __init__(self, settings: HashFieldSettings):
        super().__init__()
        self.settings = settings
        width, encoded = settings.width, settings.levels * settings.features
        shape = (settings.levels, 2**settings.log2_rows, settings.features)
        self.table = nn.Parameter(torch.empty(shape).uniform_(-1e-4, 1e-4))
        sizes = ((width, encoded), (GEOMETRY, width), (width, GEOMETRY + HARMONICS), (width, width), (3, width))
        self.weights = nn.ParameterList([_uniform_weights(*size) for size in sizes])

    def density(self, coordinates: Tensor) -> Tensor:
        """Density (N,) in 1 / training unit at coordinates (N, 3) of the unit cube."""
        encoded = kernels.hash_encode(coordinates, self.table, self.settings.resolutions)
        return kernels.density(encoded, tuple(self.weights))

    def radiance(self, coordinates: Tensor, directions: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Density (N,) and sRGB colour (N, 3) at coordinates (N, 3), seen along `directions` (R, 3) of `rays` (N,)."""
        encoded = kernels.hash_encode(coordinates, self.table, self.settings.resolutions)
        return self.radiance_of_encoded(encoded, directions, rays)

    def radiance_of_encoded(self, encoded: Tensor, directions: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        """The same for positions that `kernels.hash_encode` has been asked about already, (N, L * F)."""
        harmonics = spherical_harmonics(directions, self.settings.view_degree)
        return kernels.radiance(encoded, harmonics, rays, tuple(self.weights))


def _uniform_weights(outputs: int, inputs: int) -> nn.Parameter:
    """Weights that keep the variance of rectified inputs: uniform within sqrt(6 / inputs).

    Source: He et al. 2015, arXiv:1502.01852, eq. 10.
    """
    bound = math.sqrt(6.0 / inputs)
    return nn.Parameter(torch.empty(outputs, inputs).uniform_(-bound, bound))
