"""The radiance field as a dense grid: a density and the harmonics of a colour at every vertex, interpolated."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from nerfcli.field.interface import Field, FieldSettings
from nerfcli.kernels import spherical_harmonics
from nerfcli.kernels.activations import density_from_log
from nerfcli.kernels.interface import FEATURES


@dataclass(frozen=True)
class VoxelFieldSettings(FieldSettings):
    """Size of the field.

    Args:
        log2_vertices: there is room for 2^log2_vertices vertices; the grid is the largest cube that fits.
    """

    kind: ClassVar[str] = "voxels"

    log2_vertices: int = 17

    @property
    def size_text(self) -> str:
        side = self.resolution
        return f"{side}x{side}x{side} voxels"

    @property
    def resolution(self) -> int:
        """Cells per axis."""
        side = round(2 ** (self.log2_vertices / 3))
        return side - 1 if side**3 <= 2**self.log2_vertices else side - 2

    @property
    def harmonics(self) -> int:
        """Number of spherical harmonics of each channel."""
        return (self.view_degree + 1) ** 2

    @property
    def layers(self) -> int:
        """Number of tables, of `FEATURES` values per vertex, that hold a log density and three times the harmonics."""
        return -(-(1 + 3 * self.harmonics) // FEATURES)


class VoxelField(Field):
    """Log density and harmonics of the colour are interpolated; exponential and sigmoid are applied afterwards.

    density = exp(v_0),  rgb = sigmoid(sum_k Y_k(direction) (v_(1 + 3k), v_(2 + 3k), v_(3 + 3k)))

    A surface may then be sharper than a cell. The grid is a hash grid without collisions whose levels all have the same
    resolution, and uses the same kernels. It starts near zero: a grey fog of density 1.
    Source: Yu et al. 2022, Plenoxels, arXiv:2112.05131, section 3.1; Sun et al. 2022, DVGO, arXiv:2111.11215,
    section 4.1 on activations after interpolation.
    """

    settings: VoxelFieldSettings
    rate_factor = 30.0

    def __init__(self, settings: VoxelFieldSettings):
        super().__init__(settings)
        shape = (settings.layers, 2**settings.log2_vertices, FEATURES)
        self.table = nn.Parameter(torch.empty(shape).uniform_(-1e-4, 1e-4))

    def rows(self) -> nn.Parameter:
        return self.table

    def medium(self, detail: float = 1.0) -> "VoxelField":
        return self

    def density(self, coordinates: Tensor) -> Tensor:
        """See `kernels.Medium`."""
        # The log density is in the first table; the other tables are not needed.
        values = self.backend.hash_encode(coordinates, self.table[:1], (self.settings.resolution,))
        return density_from_log(values[:, 0])

    def radiance(self, coordinates: Tensor, directions: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        """See `kernels.Medium`."""
        settings, count = self.settings, self.settings.harmonics
        # (N, layers * FEATURES): log density, then red, green and blue of each harmonic; numbers at the end unused.
        resolutions = (settings.resolution,) * settings.layers
        values = self.backend.hash_encode(coordinates, self.table, resolutions, table_grad=self.table_grad)
        harmonics = spherical_harmonics(directions, settings.view_degree)[:, :count]
        channels = values[:, 1 : 1 + 3 * count].unflatten(1, (count, 3))
        rgb = torch.sigmoid((harmonics[rays][:, :, None] * channels).sum(1))
        return density_from_log(values[:, 0]), rgb
