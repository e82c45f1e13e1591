"""Similarity of a rendered picture to a photo: PSNR, SSIM.

Colours are sRGB in [0, 1], as float or rounded to 8 bits. Pixels that do not count (masked, or without a ray) are
left out entirely: from PSNR pixel by pixel, from SSIM with every window that contains one.
"""

import numpy as np
from scipy.ndimage import minimum_filter
from skimage.metrics import structural_similarity

from nerfcli.photos.colours import psnr_of

# From Wang et al.: the Gaussian's standard deviation, and the width at which scikit-image cuts it off (3.5 sigma).
SIGMA = 1.5
WINDOW = 11


def to_8_bit(picture: np.ndarray) -> np.ndarray:
    """Convert colours in [0, 1] to 8 bits as in a PNG: clipped, rounded to the nearest of 256 levels."""
    return np.round(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8)


def as_float(picture: np.ndarray) -> np.ndarray:
    """Return colours in [0, 1] as float64: 8-bit levels divided by 255, floats clipped."""
    if picture.dtype == np.uint8:
        return picture / 255.0
    return np.clip(picture, 0.0, 1.0).astype(np.float64)


def psnr(picture: np.ndarray, photo: np.ndarray, *, used: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB over the pixels that count and their channels, see `psnr_of`.

    Args:
        picture, photo: (H, W, 3) uint8, or float in [0, 1].
        used: (H, W) bool, the pixels that count; at least one.
    """
    return psnr_of(float(np.square(as_float(picture[used]) - as_float(photo[used])).mean()))


def whole_windows(used: np.ndarray) -> np.ndarray:
    """Return the centres (H, W), bool, of the `ssim` windows inside the picture with only pixels that count."""
    return minimum_filter(used, size=_window(used.shape), mode="constant", cval=False)


def ssim(picture: np.ndarray, photo: np.ndarray, *, used: np.ndarray) -> float | None:
    """Return the structural similarity in [-1, 1], the mean over `whole_windows`; None if there are none.

    Gaussian window of sigma 1.5 (11 x 11), K1 0.01, K2 0.03, data range 1, population covariance, per channel. Without
    a mask this is the mean of scikit-image and dm_pix (used by nerfbaselines); torchmetrics (used by nerfstudio) has
    the same map inside, but its mean includes a border of windows that extend beyond the picture. Pictures narrower
    than the window get the largest odd window that fits, with equal weights.

    Args:
        picture, photo: (H, W, 3) uint8, or float in [0, 1].
        used: (H, W) bool.

    Source: Wang et al. 2004, Image quality assessment, IEEE TIP 13(4); computed by scikit-image.
    """
    whole = whole_windows(used)
    if not whole.any():
        return None
    width = _window(used.shape)
    similarity = structural_similarity(
        as_float(picture),
        as_float(photo),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=width == WINDOW,
        sigma=SIGMA,
        win_size=width,
        use_sample_covariance=False,
        full=True,
    )[1]
    return float(np.asarray(similarity)[whole].mean())


def _window(shape: tuple[int, ...]) -> int:
    smallest = min(shape[:2])
    return WINDOW if smallest >= WINDOW else smallest - 1 + smallest % 2
