"""The radiance field: a multiresolution hash grid with a small density network and a small colour network."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from nerfcli import kernels
from nerfcli.field.activations import density_from_log
from nerfcli.field.encodings import spherical_harmonics

GEOMETRY_FEATURES = 15


@dataclass(frozen=True)
class HashFieldSettings:
    """Size of the field.

    Args:
        unbounded: whether space beyond the central ball is contracted into the grid.
        levels, features: grids from coarse to fine, and numbers per table row.
        log2_rows: rows per level as a power of two.
        coarsest, finest: cells per axis of the first and the last level; those between are in geometric progression.
        width: neurons of the hidden layers.
    """

    unbounded: bool
    levels: int = 8
    features: int = 4
    log2_rows: int = 17
    coarsest: int = 16
    finest: int = 1024
    width: int = 32

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells per axis of each level."""
        growth = math.log(self.finest / self.coarsest) / max(1, self.levels - 1)
        return tuple(round(self.coarsest * math.exp(growth * level)) for level in range(self.levels))

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


class HashField(nn.Module):
    """Density by position, colour by position and direction, on points of the training frame.

    The table starts near zero and the networks have no biases, so a fresh field is a thin grey fog of density 1:
    thin enough that every sample of a ray gets a gradient.
    """

    def __init__(self, settings: HashFieldSettings):
        super().__init__()
        self.settings = settings
        encoded = settings.levels * settings.features
        self.table = nn.Parameter(
            torch.empty(settings.levels, 2**settings.log2_rows, settings.features).uniform_(-1e-4, 1e-4)
        )
        self.density_network = nn.Sequential(
            nn.Linear(encoded, settings.width, bias=False),
            nn.ReLU(),
            nn.Linear(settings.width, 1 + GEOMETRY_FEATURES, bias=False),
        )
        self.colour_network = nn.Sequential(
            nn.Linear(GEOMETRY_FEATURES + 16, settings.width, bias=False),
            nn.ReLU(),
            nn.Linear(settings.width, settings.width, bias=False),
            nn.ReLU(),
            nn.Linear(settings.width, 3, bias=False),
        )

    def density(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density (N,) in 1 / training unit, and the features (N, 15) that `colour` wants, at points (N, 3)."""
        coordinates = kernels.grid_coordinates(points, self.settings.unbounded)
        encoded = kernels.hash_encode(coordinates, self.table, self.settings.resolutions)
        out = self.density_network(encoded)
        return density_from_log(out[:, 0]), out[:, 1:]

    def colour(self, features: Tensor, directions: Tensor) -> Tensor:
        """sRGB colour (N, 3) in (0, 1) seen along unit `directions` (N, 3)."""
        return torch.sigmoid(self.colour_network(torch.cat([features, spherical_harmonics(directions)], dim=-1)))

    def forward(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Density (N,) and colour (N, 3)."""
        density, features = self.density(points)
        return density, self.colour(features, directions)
