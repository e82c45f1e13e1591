"""The transfer function of sRGB."""

import numpy as np


def linear_light(srgb: np.ndarray) -> np.ndarray:
    """Return the linear light of sRGB values in [0, 1], in their dtype. Source: IEC 61966-2-1."""
    low = srgb / 12.92
    high = ((np.maximum(srgb, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(srgb <= 0.04045, low, high).astype(srgb.dtype)
