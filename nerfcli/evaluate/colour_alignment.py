"""Colour alignment by halves: separate the error of a held-out photo's exposure from that of the field.

The gains are fitted on the left half of the photo, with the field fixed, and the picture is measured on the right half,
which the fit did not see.
"""

import numpy as np

from nerfcli.media.srgb import linear_light

# Levels between which the ratio of two pixels determines the gain; other pixels are noisy or saturated.
DARKEST, BRIGHTEST = 20 / 255, 240 / 255
# Fewer pixels do not determine a gain against noise.
LEAST_PIXELS = 64


def align_gains(
    picture: np.ndarray, photo: np.ndarray, *, used: np.ndarray, log_gains: tuple[float, ...]
) -> tuple[float, ...]:
    """Return the logarithms (3,) of the gains that map a picture to a photo.

    median over pixels of log(linear(photo) / linear(picture)), channel by channel

    A median, because a field has regions that are entirely wrong: least squares would make the picture brighter or
    darker to hide them. Channels with fewer than 64 pixels from level 20 to 240 in both keep their given gain.

    Args:
        picture: (H, W, 3) float sRGB >= 0, as the model shows it without gains.
        photo: (H, W, 3) float in [0, 1].
        used: (H, W) bool, the pixels to use.
        log_gains: the photo's exposure, as in `protocol.HeldOutPhoto`.
    """
    shown, wanted = (colours[used].astype(np.float64) for colours in (picture, photo))
    usable = ((shown >= DARKEST) & (shown <= BRIGHTEST) & (wanted >= DARKEST) & (wanted <= BRIGHTEST)).T
    found = list(log_gains)
    for channel, rows in enumerate(usable):
        if rows.sum() >= LEAST_PIXELS:
            ratios = linear_light(wanted[rows, channel]) / linear_light(shown[rows, channel])
            found[channel] = float(np.median(np.log(ratios)))
    return tuple(found)
