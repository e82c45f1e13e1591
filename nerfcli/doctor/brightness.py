"""Brightness of photos: clipped pixels, and local brightness for comparing matched features between photos."""

from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.photos.colours import linear_light

# A channel shows no detail from this level on, of 255, or as near to 0.
WHITE_LEVEL = 253

# Linear light of each 8-bit sRGB level.
_LINEAR = linear_light(np.arange(256) / 255).astype(np.float32)
# Linear light below which noise and the black level dominate.
_DARKEST = 4e-3
# A colour is pale if its weakest channel is at least this fraction of its strongest.
_PALE = 0.3


@dataclass(frozen=True)
class Brightness:
    """Mean of all channels of a photo, sRGB in [0, 1], and the fractions of its pixels clipped at either end."""

    mean: float
    white: float
    black: float


def measure(rgb: np.ndarray, used: np.ndarray) -> Brightness:
    """Return the exposure of a photo (H, W, 3) uint8 where `used` (H, W) is True."""
    pixels = rgb[used]
    if not len(pixels):
        return Brightness(float("nan"), 0.0, 0.0)
    white, black = (pixels >= WHITE_LEVEL).all(axis=1).mean(), (pixels <= 255 - WHITE_LEVEL).all(axis=1).mean()
    return Brightness(float(pixels.mean() / 255), float(white), float(black))


def local_light(rgb: np.ndarray) -> np.ndarray:
    """Return brightness and colour around each pixel, (H, W, 2) float32; NaN where unknown.

    First log2 of the linear luminance, to which a stop of exposure adds 1; NaN where it is clipped or too dark.
    Second log2 of red over blue, which white balance shifts; NaN also where the colour is saturated, since a small
    highlight on it shifts the ratio by more than the white balance does. The picture is (H, W, 3) uint8 sRGB.
    """
    light = np.maximum(cv2.GaussianBlur(cv2.LUT(rgb, _LINEAR), (0, 0), 4.0), 1e-6)
    clipped = 255 * np.any((rgb >= WHITE_LEVEL) | (rgb <= 255 - WHITE_LEVEL), axis=2).astype(np.uint8)
    unsure = (cv2.blur(clipped, (15, 15)) > 0.05 * 255) | (light.min(axis=2) < _DARKEST)
    luminance = np.log2(light @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32))
    redness = np.log2(light[..., 0] / light[..., 2])
    luminance[unsure] = np.nan
    redness[unsure | (light.min(axis=2) < _PALE * light.max(axis=2))] = np.nan
    return np.stack([luminance, redness], axis=-1)
