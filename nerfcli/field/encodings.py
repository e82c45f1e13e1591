"""Functions that lift positions and directions to what a small network can use."""

import math

import torch
from torch import Tensor


def fourier_features(x: Tensor, octaves: int) -> Tensor:
    """Sines and cosines at octave frequencies.

    gamma(x) = [sin(pi x), cos(pi x), ..., sin(2^(octaves - 1) pi x), cos(2^(octaves - 1) pi x)]

    Args:
        x: (..., D).
        octaves: number of frequencies, >= 1.

    Returns:
        (..., D * 2 * octaves): component after component, octave after octave, sine before cosine.

    Differentiable. In float32 the highest octave has an absolute error of about 2^(octaves - 1) * pi * |x| * 6e-8.
    Source: Mildenhall et al. 2020, NeRF, arXiv:2003.08934, eq. 4.
    """
    frequencies = math.pi * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    phases = x[..., None] * frequencies  # (..., D, octaves)
    return torch.stack([phases.sin(), phases.cos()], dim=-1).flatten(-3)


def spherical_harmonics(directions: Tensor, degree: int = 3) -> Tensor:
    """The 16 real spherical harmonics of degree 0 to 3, orthonormal on the sphere.

    Args:
        directions: (..., 3) unit norm.
        degree: 0 to 3; the harmonics above it are 0.

    Returns:
        (..., 16), ordered by degree l, then by order m = -l .. l, with the Condon-Shortley phase left out.

    Differentiable.
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
