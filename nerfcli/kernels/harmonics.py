"""Spherical harmonics of the view directions on which colours may depend."""

import math

import torch
from torch import Tensor


def spherical_harmonics(directions: Tensor, degree: int = 3) -> Tensor:
    """Return the 16 real spherical harmonics of unit directions (..., 3), orthonormal; 0 above the degree.

    They are ordered by degree l, then by order m = -l .. l, with the Condon-Shortley phase left out. Differentiable.
    Source: Sloan 2013, Efficient spherical harmonic evaluation, JCGT 2(2), appendix A2.
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    harmonics = torch.stack(
        [
            torch.full_like(x, math.sqrt(1 / (4 * math.pi))),
            math.sqrt(3 / (4 * math.pi)) * y,
            math.sqrt(3 / (4 * math.pi)) * z,
            math.sqrt(3 / (4 * math.pi)) * x,
            math.sqrt(15 / (4 * math.pi)) * x * y,
            math.sqrt(15 / (4 * math.pi)) * y * z,
            math.sqrt(5 / (16 * math.pi)) * (3 * zz - 1),
            math.sqrt(15 / (4 * math.pi)) * x * z,
            math.sqrt(15 / (16 * math.pi)) * (xx - yy),
            math.sqrt(35 / (32 * math.pi)) * y * (3 * xx - yy),
            math.sqrt(105 / (4 * math.pi)) * x * y * z,
            math.sqrt(21 / (32 * math.pi)) * y * (5 * zz - 1),
            math.sqrt(7 / (16 * math.pi)) * z * (5 * zz - 3),
            math.sqrt(21 / (32 * math.pi)) * x * (5 * zz - 1),
            math.sqrt(105 / (16 * math.pi)) * z * (xx - yy),
            math.sqrt(35 / (32 * math.pi)) * x * (xx - 3 * yy),
        ],
        dim=-1,
    )
    if degree == 3:
        return harmonics
    return harmonics * (torch.arange(16, device=x.device) < (degree + 1) ** 2)


def splat_harmonics(directions: Tensor) -> Tensor:
    """Return the 16 harmonics with the signs of splat files: those of odd order m are negated.

    In the order of `spherical_harmonics` these are all with an odd number. Differentiable.
    Source: Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering, released code.
    """
    signs = torch.tensor([1.0, -1.0] * 8, dtype=directions.dtype, device=directions.device)
    return spherical_harmonics(directions) * signs
