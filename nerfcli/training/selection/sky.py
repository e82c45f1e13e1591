"""Sky: a colour for every direction, for things so far away that all photos see them in the same direction."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from nerfcli.field.background import SphereBackground
from nerfcli.photos.colours import psnr_of
from nerfcli.training.adam import Adam
from nerfcli.training.appearance import LEAST_LEVEL

# Fewer pixels tell nothing about a sky, nor about the exposure of a photo.
FEWEST_PIXELS = 12


def paint(background: SphereBackground, seen: Callable[[], tuple[Tensor, Tensor]]) -> None:
    """Fit a background so that each direction has about the median colour of the pixels that look along it.

    Args:
        seen: returns directions (N, 3) and the sRGB colours (N, 3) along them; called once per step.
    """
    adam = Adam(background.parameters())
    for _ in range(30):
        directions, colours = seen()
        adam.zero_grad()
        (background(directions) - colours).abs().sum().backward()
        adam.step(0.3)
    adam.zero_grad()


def explained_by_direction(directions: Tensor, colours: Tensor, photos: Tensor) -> tuple[float, float]:
    """Return how well half of the photos predict the other half by one colour, and by a colour for each direction.

    A sky is in the same direction for all photos; surfaces are in a different one for each. Photos with even indices
    predict those with odd ones, their neighbours, which see the same part of a sky.

    Args:
        directions: (N, 3) unit directions of rays.
        colours: (N, 3) sRGB.
        photos: (N,) the indices of their photos.

    Returns:
        PSNR in dB of one colour, and of a colour by direction; infinite if either half has too few pixels.
    """
    tells = photos % 2 == 0
    if min(int(tells.sum()), int((~tells).sum())) < FEWEST_PIXELS:
        return math.inf, math.inf
    one = colours[tells].median(0).values
    with torch.enable_grad():
        background = SphereBackground(8).to(colours.device)  # coarse, because of the noise of few pixels
        background.logits.data += torch.logit(one.clamp(LEAST_LEVEL, 1.0 - LEAST_LEVEL))[:, None, None, None]
        paint(background, lambda: (directions[tells], colours[tells]))
    with torch.no_grad():
        predictions = (one, background(directions[~tells]))
    one_psnr, painted = (psnr_of(float((c - colours[~tells]).square().mean())) for c in predictions)
    return one_psnr, painted
