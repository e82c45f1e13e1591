"""A colour for every direction, for what is so far away that all photos see it along the same one."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from nerfcli.field.background import SphereBackground
from nerfcli.fit.adam import Adam
from nerfcli.photos.psnr import psnr_of

PAINT_RATE, PAINT_STEPS = 0.3, 30
# Vertices per axis, where few pixels have to tell: with 32, noise costs a sky of one colour 6 dB.
COARSE_SIDE = 8
# Fewer pixels of either half of the photos tell nothing.
FEWEST_PIXELS = 12
# Levels of a sigmoid's ends, which it does not reach.
DARKEST, BRIGHTEST = 0.02, 0.98


def paint(background: SphereBackground, seen: Callable[[], tuple[Tensor, Tensor]]) -> None:
    """Give each direction about the median colour of the pixels that look along it.

    Args:
        background: to be painted.
        seen: gives directions (N, 3) and the sRGB colours (N, 3) along them, once for each of the steps.
    """
    adam = Adam(background.parameters())
    for _ in range(PAINT_STEPS):
        directions, colours = seen()
        adam.zero_grad()
        (background(directions) - colours).abs().sum().backward()
        adam.step(PAINT_RATE)
    adam.zero_grad()


def explained_by_direction(directions: Tensor, colours: Tensor, photos: Tensor) -> tuple[float, float]:
    """Return how well colours that some photos have explain others: one colour for all directions, and one for each.

    A sky is where it is for all photos; surfaces are elsewhere in each. Photos of even numbers tell, and those of odd
    ones are explained: neighbours, which see the same part of a sky.

    Args:
        directions: (N, 3) of rays, unit.
        colours: (N, 3) sRGB.
        photos: (N,) the numbers of their photos.

    Returns:
        PSNR in dB of one colour, and of a colour by direction; infinite where either half has too few pixels.
    """
    tells = photos % 2 == 0
    if min(int(tells.sum()), int((~tells).sum())) < FEWEST_PIXELS:
        return math.inf, math.inf
    one = colours[tells].median(0).values
    with torch.enable_grad():
        background = SphereBackground(COARSE_SIDE).to(colours.device)
        background.logits.data += torch.logit(one.clamp(DARKEST, BRIGHTEST))[:, None, None, None]
        paint(background, lambda: (directions[tells], colours[tells]))
    with torch.no_grad():
        predictions = (one, background(directions[~tells]))
    one_psnr, painted = (psnr_of(float((c - colours[~tells]).square().mean())) for c in predictions)
    return one_psnr, painted
