"""From what a network puts out to what the volume integral takes."""

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
    """exp(x) for |x| <= 15, constant beyond, with a gradient that never vanishes or overflows.

    Args:
        log_density: x, any shape, finite.

    Returns:
        density in [3e-7, 3.3e6], in 1 / unit of the training frame.

    The gradient is density itself, also beyond the limits: a plain clamp would hold a value that went too far forever.
    """
    return _BoundedExp.apply(log_density)  # type: ignore[return-value]
