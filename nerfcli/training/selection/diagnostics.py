"""Diagnostics from the residuals of a short training, which suggest components to try, and the colours of its sky."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerfcli.field.background import SphereBackground
from nerfcli.field.exposure import linear_from_srgb
from nerfcli.photos.colours import psnr_of
from nerfcli.training.appearance import LEAST_LEVEL
from nerfcli.training.optimiser import Adam

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


# Levels that are compared in brightness: lower ones are noise, higher ones saturated.
DARKEST, BRIGHTEST = 0.06, 0.95


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostics of a scene from a short training.

    Args:
        log_gains: (photos, 3) logarithm of the ratio of each photo to its rendering, in linear light; their mean is 0.
        exposure_spread: standard deviation of the photos' log brightness, without the noise of its estimates.
        far_share: fraction of the pixels whose light comes mostly from so far away that it shows no parallax.
        sky_psnr: PSNR of these pixels predicted by one colour, and by a colour for each direction; see
            `sky.explained_by_direction`.
    """

    log_gains: Tensor
    exposure_spread: float
    far_fraction: float
    sky_psnr: tuple[float, float]


def diagnose(
    rendered: Tensor, measured: Tensor, photos: Tensor, *, directions: Tensor, from_beyond: Tensor, count: int
) -> Diagnostics:
    """Compute the diagnostics from some pixels.

    The gain of a photo is the median over its pixels of log(measured / rendered), channel by channel: highlights and
    edges that the model does not have yet do not affect it.

    Args:
        rendered, measured: (N, 3) sRGB.
        photos: (N,) the photo index of each pixel.
        directions: (N, 3) unit directions of their rays.
        from_beyond: (N,) fractions of their light from beyond the distance at which a background would begin.
        count: of the photos.
    """
    compared = ((measured > DARKEST) & (measured < BRIGHTEST) & (rendered > DARKEST)).cpu().numpy()
    ratios = (linear_from_srgb(measured).log() - linear_from_srgb(rendered.clamp_min(DARKEST)).log()).cpu().numpy()
    of_photo = photos.cpu().numpy()
    far = from_beyond > 0.5
    far_fraction = float(far.float().mean())
    sky_psnr = explained_by_direction(directions[far], measured[far], photos[far])
    gains, errors = np.zeros((count, 3)), np.full(count, np.nan)
    for photo in range(count):
        mine = of_photo == photo
        good = mine & compared.all(-1)
        if good.sum() >= FEWEST_PIXELS:
            gains[photo] = np.median(ratios[good], axis=0)
            common = ratios[good].mean(-1)
            # Of a normal distribution: its deviation from the median absolute one, and the error of its median.
            deviation = 1.4826 * np.median(np.abs(common - np.median(common)))
            errors[photo] = 1.2533 * deviation / np.sqrt(good.sum())
    finite = np.isfinite(errors)
    if finite.sum() < 2:
        return Diagnostics(torch.zeros(count, 3), 0.0, far_fraction, sky_psnr)
    gains[finite] -= gains[finite].mean(0)
    excess = gains[finite].mean(-1).var(ddof=1) - np.square(errors[finite]).mean()
    return Diagnostics(
        torch.tensor(gains, dtype=torch.float32), float(np.sqrt(max(0.0, excess))), far_fraction, sky_psnr
    )
