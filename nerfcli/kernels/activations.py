"""Activations: from network outputs to density and colour, and from optical depth to opacity."""

from typing import Any

import torch
from torch import Tensor

# exp(15) is opaque within a millionth of the scene and far from float32's overflow at exp(88.7).
LOG_DENSITY_LIMIT = 15.0


class _BoundedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, log_density: Tensor) -> Tensor:
        density = log_density.clamp(-LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT).exp()
        ctx.save_for_backward(density)
        return density

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (density,) = ctx.saved_tensors
        return gradients[0] * density


def density_from_log(log_density: Tensor) -> Tensor:
    """Return the density exp(x) in 1 / training unit, x clipped to [-15, 15], with a gradient that never vanishes.

    The gradient is the density itself, even beyond the limits: a plain clamp would trap values beyond them forever.
    """
    return _BoundedExp.apply(log_density)


class _Opacity(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, optical_depth: Tensor) -> Tensor:
        ctx.save_for_backward(optical_depth)
        return -torch.expm1(-optical_depth)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (optical_depth,) = ctx.saved_tensors
        return gradients[0] * torch.exp(-optical_depth)


def opacity(optical_depth: Tensor) -> Tensor:
    """Return 1 - exp(-x) at full precision for small x >= 0, with a gradient exp(-x) at full precision for large x.

    torch computes the gradient of expm1 as its value plus 1, which cancels to 0 where x is above 17 in float32, or
    above 37 in float64.
    """
    return _Opacity.apply(optical_depth)
