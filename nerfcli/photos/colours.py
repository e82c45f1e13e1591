"""Colours: sRGB and linear light, 8 bits, alpha on white, the PSNR of a difference, colour maps from matplotlib."""

import math
from functools import cache

import numpy as np

# Our names -> matplotlib's. turbo shows the most detail (Mikhailov 2019); viridis has perceptually even steps, also for
# colour-blind people.
COLOUR_MAPS = {"turbo": "turbo", "viridis": "viridis", "grey": "gray"}


def linear_light(srgb: np.ndarray) -> np.ndarray:
    """Return the linear light of sRGB values in [0, 1], in their dtype. Source: IEC 61966-2-1."""
    low = srgb / 12.92
    high = ((np.maximum(srgb, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(srgb <= 0.04045, low, high).astype(srgb.dtype)


def to_8_bit(colours: np.ndarray) -> np.ndarray:
    """Convert colours in [0, 1] to 8 bits as in a PNG: clipped, rounded to the nearest of 256 levels."""
    return np.round(np.clip(colours, 0.0, 1.0) * 255.0).astype(np.uint8)


def over_white(pixels: np.ndarray) -> np.ndarray:
    """Return 8-bit RGBA composited on white as 8-bit RGB, as in published tables; RGB unchanged."""
    if pixels.shape[-1] == 3:
        return pixels
    alpha = pixels[..., 3:].astype(np.float64) / 255.0
    return to_8_bit(pixels[..., :3] / 255.0 * alpha + 1.0 - alpha)


def psnr_of(error: float) -> float:
    """Return the PSNR in dB of a mean squared error of values in [0, 1]: -10 log10, at most 100.

    The logarithm diverges for identical pictures. 100 dB are an RMS error of 1e-5, 0.003 grey levels of 255.
    """
    return -10.0 * math.log10(max(error, 1e-10))


@cache
def levels_of(colour_map: str) -> np.ndarray:
    """Return the colours of one of `COLOUR_MAPS`, uint8 sRGB (256, 3), from the lowest level to the highest."""
    from matplotlib import colormaps  # imported here because it takes 0.2 s

    # Not bytes=True, which rounds down.
    colours = np.asarray(colormaps[COLOUR_MAPS[colour_map]](np.arange(256)))
    return np.rint(colours[:, :3] * 255).astype(np.uint8)
