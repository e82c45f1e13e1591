"""Single kernel operations, and fields evaluated at single points, for tests of one of them alone."""

from types import ModuleType

import torch
from torch import Tensor

from nerfcli.field.interface import Field
from nerfcli.kernels import HashGrid, numba_cpu, reference, spherical_harmonics


def parts_for(dtype: torch.dtype) -> ModuleType:
    """Return the module of operations that compute a field of this precision on a CPU."""
    return numba_cpu if dtype == torch.float32 else reference


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
