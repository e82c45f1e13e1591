"""The other forward model: a source behind an absorbing body, with no emission and no background term.

I = I0 * exp(-integral of mu),  so  -log(I / I0) = the line integral of mu.
"""

import torch
from torch import Tensor

from nerfcli import kernels


def line_integral(attenuation: Tensor, lengths: Tensor, offsets: Tensor) -> Tensor:
    """Integral of a piecewise constant attenuation along each ray.

    Args:
        attenuation: (N,) mu, in 1 / unit of length.
        lengths: (N,) >= 0.
        offsets: (R + 1,), packed as in `kernels.reference`.

    Returns:
        (R,), dimensionless. Differentiable.
    """
    return kernels.sum_along_rays(attenuation * lengths, offsets)


def transmitted(intensity: Tensor | float, integral: Tensor) -> Tensor:
    """Intensity behind the body, I0 * exp(-line integral). Differentiable.

    Source: Beer-Lambert law.
    """
    return intensity * torch.exp(-integral)
