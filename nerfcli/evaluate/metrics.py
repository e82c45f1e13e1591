"""How close a rendered picture is to a photo."""

import math

import numpy as np
from skimage.metrics import structural_similarity


def to_8_bit(picture: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] as they would stand in a PNG: clipped, rounded to the nearest of 256 levels."""
    return np.round(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8)


def psnr(picture: np.ndarray, photo: np.ndarray, *, used: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB: -10 log10 of the mean squared error of values in [0, 1].

    Args:
        picture, photo: (H, W, 3) uint8.
        used: (H, W) bool, the pixels that count; at least one.

    Returns:
        dB; identical pictures give 100.
    """
    difference = (picture[used].astype(np.float64) - photo[used]) / 255.0
    return -10.0 * math.log10(max(float(np.square(difference).mean()), 1e-10))


def ssim(picture: np.ndarray, photo: np.ndarray, *, used: np.ndarray) -> float:
    """Structural similarity, mean over the pixels that count, in [-1, 1].

    Gaussian window of sigma 1.5 (11 x 11), K1 0.01, K2 0.03, population covariance, per channel, as in the paper;
    pictures narrower than the window get the largest odd window that fits.

    Args:
        picture, photo: (H, W, 3) uint8.
        used: (H, W) bool.

    Source: Wang et al. 2004, Image quality assessment, IEEE TIP 13(4); computed by scikit-image.
    """
    smallest = min(picture.shape[:2])
    window = {"win_size": smallest - 1 + smallest % 2} if smallest < 11 else {}
    similarity = structural_similarity(
        picture.astype(np.float64) / 255.0,
        photo.astype(np.float64) / 255.0,
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=not window,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
        **window,
    )[1]
    return float(np.asarray(similarity)[used].mean())
