"""The losses of a training: what a step minimises is the sum of `LOSSES`, each times its weight from the step's plan.

To add one, write a function of what the rays show, name it in `LOSSES`, and weigh it in `schedule.loss_weights`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

HUBER_DELTA = 0.1
# Fraction of the light on target at which the slope of `emerging_losses` is half of its largest.
FAINT = 0.1


@dataclass(frozen=True)
class Shown:
    """What R rays of a step show, the last K of which have a known distance.

    Args:
        colours: (R,) `colour_losses` of the rays.
        transmittance: (R,) fraction of the light that passes through the field.
        distortion: (R,) see `kernels.RaySums`; empty if it has no weight.
        distances: (K,) losses of the known distances, times the trust in them.
        sky: (R,) bool, whether a ray's pixel shows the sky; None if no sky is known.
        roughness: () of a learned background, see `SphereBackground`; None without one.
        rays, points: R and K of the whole step, of which these may be a part. Parts add up to the losses of the whole.
    """

    colours: Tensor
    transmittance: Tensor
    distortion: Tensor
    distances: Tensor
    sky: Tensor | None
    roughness: Tensor | None
    rays: int
    points: int


def colour(shown: Shown) -> Tensor:
    """Return the mean loss of the rays' colours."""
    return shown.colours.sum() / shown.rays


def distortion(shown: Shown) -> Tensor:
    """Return the mean distortion of the rays, which concentrates the density along each of them."""
    return shown.distortion.sum() / shown.rays


def points(shown: Shown) -> Tensor:
    """Return the mean loss of the known distances."""
    return shown.distances.sum() / max(1, shown.points)


def sky(shown: Shown) -> Tensor:
    """Return the opacity of rays that see the sky, as a mean over all rays; 0 where no sky is known."""
    if shown.sky is None:
        return shown.transmittance.new_zeros(())
    return ((1.0 - shown.transmittance) * shown.sky).sum() / shown.rays


def roughness(shown: Shown) -> Tensor:
    """Return the roughness of the background.

    Directions that no photo shows take the colours of their neighbours. Without it, Adam makes large steps from the
    little light that leaks through surfaces, and their colours are arbitrary.
    """
    assert shown.roughness is not None  # it has a weight only where a background is learned
    return shown.roughness * (len(shown.colours) / shown.rays)


LOSSES: Mapping[str, Callable[[Shown], Tensor]] = {
    "colour": colour,
    "distortion": distortion,
    "points": points,
    "sky": sky,
    "roughness": roughness,
}


def colour_losses(rendered: Tensor, measured: Tensor) -> Tensor:
    """Return the Huber loss of sRGB colours (R, 3), delta 0.1: quadratic for noise, linear for outliers.

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
