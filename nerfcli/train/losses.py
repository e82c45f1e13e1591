"""What training minimises."""

import torch
from torch import Tensor

HUBER_DELTA = 0.1


def colour_loss(rendered: Tensor, measured: Tensor) -> Tensor:
    """Mean Huber loss of sRGB colours, delta 0.1: quadratic for noise, linear for what does not fit.

    Args:
        rendered, measured: (R, 3).

    Returns:
        Scalar, divided by delta so that its slope is at most 1.
    """
    return torch.nn.functional.huber_loss(rendered, measured, delta=HUBER_DELTA) / HUBER_DELTA


def over_background(colours: Tensor, background: Tensor) -> Tensor:
    """Measured colours in front of `background` (R, 3): alpha * rgb + (1 - alpha) * background for RGBA.

    Args:
        colours: (R, 3) or (R, 4) with straight alpha.
    """
    if colours.shape[-1] == 3:
        return colours
    alpha = colours[:, 3:]
    return alpha * colours[:, :3] + (1.0 - alpha) * background
