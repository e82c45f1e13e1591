"""Fields evaluated at single points, and fields whose density is known."""

import math
from types import SimpleNamespace

import torch
from torch import Tensor

from nerfcli.field.interface import Field
from nerfcli.kernels import HashGrid, backend_for, reference, spherical_harmonics


class KnownField:
    """A field that is its own medium, at any detail; records the requested detail. Subclasses have a `density`."""

    def __init__(self, contraction: str = "none", *, detailed: bool = True):
        self.settings = SimpleNamespace(contraction=contraction, detailed=detailed)
        self.backend = backend_for(torch.device("cpu"), torch.float64)
        self.detail = math.nan

    def medium(self, detail: float) -> "KnownField":
        self.detail = detail
        return self


def density_of(field: Field, coordinates: Tensor) -> Tensor:
    """Return the density (N,) of a field at coordinates (N, 3)."""
    return field.backend.density(coordinates, field.medium())


def radiance_of(
    field: Field, coordinates: Tensor, directions: Tensor, rays: Tensor, *, detail: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Return density (N,) and colour (N, 3) at coordinates (N, 3), seen along directions (R, 3) of rays (N,)."""
    medium = field.medium(detail)
    if not isinstance(medium, HashGrid):
        return medium.radiance(coordinates, directions, rays)
    encoded = reference.hash_encode(coordinates, medium.table, medium.resolutions)
    return reference.radiance(encoded, spherical_harmonics(directions, medium.view_degree), rays, medium.layers)
