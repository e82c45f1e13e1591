"""Encodings of positions as inputs of small networks."""

import math

import torch
from torch import Tensor


def fourier_features(x: Tensor, octaves: int) -> Tensor:
    """Return sines and cosines at octave frequencies.

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
