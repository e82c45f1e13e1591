"""Contraction of space into the unit cube of the field's grids: none, or with distant space mapped into it.

none    only the cube [-1, 1]^3 of the training frame is represented
l2      the unit ball is unchanged; everything beyond it is mapped into the ball of radius 2
"""

import torch
from torch import Tensor

from nerfcli.kernels.interface import Rays

# The names, in the order of their numbers in compiled kernels.
CONTRACTIONS = ("none", "l2")


def contract(points: Tensor) -> Tensor:
    """Map all of space, points (..., 3), into the ball of radius 2, leaving the unit ball unchanged.

    contract(x) = x for |x| <= 1, else (2 - 1/|x|) x / |x|, for components up to half of the dtype's largest number

    Differentiable everywhere, even at 0: norms below 1 are raised to 1, so that no gradient passes through a root at 0.
    Source: Barron et al. 2022, Mip-NeRF 360, arXiv:2111.12077, eq. 10.
    """
    limit = torch.finfo(points.dtype).max
    far = points.detach().abs().amax(-1, keepdim=True) > limit**0.25  # there, squares could overflow
    shrink = torch.where(far, limit**-0.5 / 4, 1.0).to(points)
    small = points * shrink
    norm = small.square().sum(-1, keepdim=True).maximum(shrink.square()).sqrt()
    return (2.0 - shrink / norm) * (small / norm)


def grid_coordinates(points: Tensor, contraction: str) -> Tensor:
    """Convert points (..., 3) of the training frame to coordinates of the unit cube that holds the field's grids.

    These are within [0, 1] for every point or, without contraction, only for points in [-1, 1]^3.

    Raises:
        ValueError: there is no such contraction.
    """
    match contraction:
        case "none":
            return points / 2.0 + 0.5
        case "l2":
            return contract(points) / 4.0 + 0.5
        case _:
            raise ValueError(f"contraction must be one of {CONTRACTIONS}, got {contraction!r}")


def cube_widths(points: Tensor, widths: Tensor, contraction: str) -> Tensor:
    """Compute the width (N,) of a pixel's footprint at points (N, 3), in coordinates of the cube of `grid_coordinates`.

    Widths are scaled as lengths across the line from the centre, along which distant points are seen: by 1/2 without
    contraction, else by 1/4 of (2 - 1/m) / m, where m is the norm of the point, at least 1.
    """
    if contraction == "none":
        return widths / 2.0
    norm = points.norm(dim=-1).clamp_min(1.0)
    return widths * ((2.0 - 1.0 / norm) / norm / 4.0)


def sample_widths(rays: Rays, starts: Tensor, ends: Tensor, *, index: Tensor, contraction: str) -> Tensor:
    """Return the `cube_widths` (N,) of pixels at the midpoints of intervals (N,) along rays `index` (N,) with cones."""
    assert rays.cones is not None
    middles = (starts + ends) / 2
    points = rays.origins[index] + rays.directions[index] * middles[:, None]
    return cube_widths(points, rays.cones[index] * middles, contraction)
