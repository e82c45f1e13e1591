"""Colour alignment: separate the error of a held-out photo's exposure and white balance from that of the field."""

import numpy as np

# Values within half a grey level of 0 and 1 are saturated: they do not determine the true colour.
EDGE = 0.5 / 255


def colour_aligned(picture: np.ndarray, photo: np.ndarray, *, used: np.ndarray) -> np.ndarray:
    """Return the picture with its colours fitted to the photo's, by least squares over the pixels that count.

    Each channel becomes a quadratic polynomial of all three: products of two, the channels, and a constant, ten
    coefficients. A pixel is excluded for a channel if it is saturated there in the picture, in its latest correction,
    or in the photo. The fit is applied five times, each time clipped to [0, 1].

    Args:
        picture, photo: (H, W, 3) float in [0, 1].
        used: (H, W) bool.

    Returns:
        (H, W, 3) float64 in [0, 1]. A channel with fewer than ten pixels to fit is unchanged.

    Source: color_correct in multinerf, internal/image.py (Barron et al. 2022, Mip-NeRF 360; the "cc" metrics of
    Zip-NeRF), here without masked pixels.
    """
    wanted = photo.reshape(-1, 3).astype(np.float64)
    current = picture.reshape(-1, 3).astype(np.float64)
    counted = _unsaturated(current) & used.reshape(-1, 1)
    # The correction changes which pixels are saturated, so it is fitted several times.
    for _ in range(5):
        terms = _quadratic(current)
        fitted = counted & _unsaturated(current) & _unsaturated(wanted)
        corrected = current.copy()
        for channel in range(3):
            rows = fitted[:, channel]
            if rows.sum() < terms.shape[1]:
                continue
            weights = np.linalg.lstsq(terms[rows], wanted[rows, channel], rcond=None)[0]
            corrected[:, channel] = terms @ weights
        current = np.clip(corrected, 0.0, 1.0)
    return current.reshape(picture.shape)


def _quadratic(colours: np.ndarray) -> np.ndarray:
    """Return the terms (N, 10): products of two channels, the channels, 1."""
    products = [colours[:, i : i + 1] * colours[:, i:] for i in range(3)]
    return np.concatenate([*products, colours, np.ones_like(colours[:, :1])], axis=1)


def _unsaturated(colours: np.ndarray) -> np.ndarray:
    return (colours >= EDGE) & (colours <= 1.0 - EDGE)
