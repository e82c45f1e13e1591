"""Gaussian splats in plain torch: their projection through any lens, and what pixels see of them.

N Gaussians, as in `Splats`. The compositing is that of a field: a Gaussian is an interval with an optical depth.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from nerfcli.kernels.harmonics import splat_harmonics
from nerfcli.kernels.interface import (
    BEYOND,
    LARGEST_ALPHA,
    LOW_PASS,
    SMALLEST_ALPHA,
    Footprints,
    RayTermination,
    Splats,
)
from nerfcli.kernels.reference.compositing import composite
from nerfcli.kernels.reference.depth import ray_termination

# Extent of a Gaussian along a ray, as a fraction of its distance: all of its light ends at its mean.
THICKNESS = 1e-9


def project_splats(
    splats: Splats,
    *,
    cam_from_world: Tensor,
    lens: Callable[[Tensor], Tensor],
    size: tuple[int, int],
    near: float = 0.0,
) -> Footprints:
    """Project Gaussians to Gaussians in the picture.

    The lens is replaced by its tangent at the mean, with the Jacobian J (2, 3) of pixels by points in camera axes:

        covariance = J W R diag(s)^2 R^T W^T J^T + 0.3 I,  W the rotation to camera axes, R that of the Gaussian

    Args:
        splats: the Gaussians.
        cam_from_world: (4, 4).
        lens: the pixel (2,) of a point (3,) in camera axes; twice differentiable; NaN where it does not see.
        size: width and height of the picture; a Gaussian whose mean is `BEYOND` its edge has opacity 0.
        near: so has one whose mean is nearer to the camera.

    Returns:
        Footprints in the order of the Gaussians. Differentiable in the Gaussians.

    Source: Zwicker et al. 2001, EWA volume splatting, eqs. 26 to 32; Kerbl et al. 2023, eqs. 5 and 6.
    """
    rotation = cam_from_world[:3, :3]
    points = splats.means @ rotation.T + cam_from_world[:3, 3]
    distances = points.norm(dim=-1)
    axes = rotation_matrices(splats.quaternions) * splats.log_scales.exp()[:, None, :]
    in_pixels = vmap(jacrev(lens))(points) @ rotation @ axes  # (N, 2, 3)
    low_pass = LOW_PASS * torch.eye(2, dtype=points.dtype)
    covariances = in_pixels @ in_pixels.transpose(1, 2) + low_pass
    centres, full = vmap(lens)(points), torch.tensor(size, dtype=points.dtype)
    seen = ((centres - full / 2).abs() < (0.5 + BEYOND) * full).all(-1) & (distances > near)
    directions = torch.nn.functional.normalize(points @ rotation, dim=-1)
    rgb = colours(splats.harmonics, directions)
    return Footprints(centres, covariances, torch.where(seen, torch.sigmoid(splats.logits), 0.0), rgb, distances)


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Return the rotations (N, 3, 3) of quaternions (N, 4), w x y z, of any norm above 0. Differentiable."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def colours(harmonics: Tensor, directions: Tensor) -> Tensor:
    """Return the sRGB colours (N, 3) of harmonics (N, K, 3) in unit directions (N, 3): max(0, 0.5 + sum_k Y_k h_k).

    Differentiable.
    """
    values = splat_harmonics(directions)[:, : harmonics.shape[1]]
    return (0.5 + (values[..., None] * harmonics).sum(1)).clamp_min(0.0)


def alphas(footprints: Footprints, pixels: Tensor) -> Tensor:
    """Return the opacities (P, N) of Gaussians at pixels (P, 2): min(0.99, o exp(-d^T C^-1 d / 2)), 0 below 1/255.

    Differentiable in the footprints.
    """
    offsets = pixels[:, None] - footprints.centres  # (P, N, 2)
    exponents = torch.einsum("pni,nij,pnj->pn", offsets, torch.linalg.inv(footprints.covariances), offsets)
    alpha = footprints.opacities * torch.exp(-exponents / 2)
    return torch.where(alpha < SMALLEST_ALPHA, 0.0, alpha.clamp_max(LARGEST_ALPHA))


def composite_splats(
    footprints: Footprints, pixels: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, RayTermination]:
    """Composite Gaussians at pixels (P, 2) from front to back, in the order of their distances.

    Args:
        footprints: in any order.
        background: (3,).

    Returns:
        colour (P, 3), transmittance (P,), and where the light ends, each Gaussian at its own distance. Colour and
        transmittance are differentiable.
    """
    order, count = footprints.distances.argsort(stable=True), len(pixels)
    offsets = torch.arange(count + 1) * len(order)
    starts = footprints.distances.detach()[order].repeat(count)
    lengths = THICKNESS * starts
    density = -torch.log1p(-alphas(footprints, pixels)[:, order]).reshape(-1) / lengths
    rgb = footprints.colours[order].repeat(count, 1)
    colour, transmittance, _ = composite(density, rgb, lengths, offsets=offsets, background=background)
    ends = ray_termination(density.detach(), starts, starts + lengths, offsets=offsets, fractions=(0.5,))
    return colour, transmittance, ends
