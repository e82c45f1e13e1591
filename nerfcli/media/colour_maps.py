"""Perceptual colour maps, as the plotting library has them."""

from functools import cache

import numpy as np

# Ours -> matplotlib's. turbo shows most detail (Mikhailov 2019); viridis has even steps, for the colour-blind too.
COLOUR_MAPS = {"turbo": "turbo", "viridis": "viridis", "grey": "gray"}


@cache
def levels_of(colour_map: str) -> np.ndarray:
    """(256, 3) uint8 sRGB from the lowest level to the highest.

    Args:
        colour_map: one of `COLOUR_MAPS`.
    """
    from matplotlib import colormaps  # a fifth of a second, for those who colour alone

    # Not bytes=True, which rounds down.
    colours = np.asarray(colormaps[COLOUR_MAPS[colour_map]](np.arange(256)))
    return np.rint(colours[:, :3] * 255).astype(np.uint8)
