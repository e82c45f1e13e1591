"""Fields evaluated at single points."""

from torch import Tensor

from nerfcli.field.interface import Field
from nerfcli.kernels import HashGrid, reference, spherical_harmonics


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
