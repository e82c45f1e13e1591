"""Losses of the training."""

import torch
from torch import Tensor

HUBER_DELTA = 0.1
# Fraction of the light on target at which the slope of this likelihood is half of its largest.
FAINT = 0.1


def colour_losses(rendered: Tensor, measured: Tensor) -> Tensor:
    """Return the Huber loss of sRGB colours, delta 0.1: quadratic for noise, linear for outliers.

    Args:
        rendered, measured: (R, 3).

    Returns:
        (R,) the mean over channels, divided by delta so that its slope is at most 1.
    """
    losses = torch.nn.functional.huber_loss(rendered, measured, delta=HUBER_DELTA, reduction="none")
    return losses.mean(-1) / HUBER_DELTA


def emerging_losses(depth_loss: Tensor) -> Tensor:
    """Return the negative log likelihood of known distances, which lets thin surfaces emerge.

    (1 + c) log((1 + c) / (1 + c - off target)),  c = 0.1

    The gradient of a nearly empty sample is in proportion to the light that it absorbs. The likelihood divides it by
    this light, down to c, so that thin surfaces come back that the free space around them has nearly erased.

    Args:
        depth_loss: (K,) in [0, 1], see `kernels.RaySums`.

    Returns:
        (K,) The likelihood is 0, with a slope of 1, where all light is absorbed at the known distance, and
        (1 + c) log(1 + 1 / c), with a slope of 1 + 1 / c, where none is. Differentiable.
    """
    most = 1.0 + FAINT
    return -most * torch.log1p(-depth_loss / most)


def over_background(colours: Tensor, background: Tensor) -> Tensor:
    """Return measured colours over `background` (R, 3): alpha * rgb + (1 - alpha) * background for RGBA.

    Args:
        colours: (R, 3) or (R, 4) with straight alpha.
    """
    if colours.shape[-1] == 3:
        return colours
    alpha = colours[:, 3:]
    return alpha * colours[:, :3] + (1.0 - alpha) * background
