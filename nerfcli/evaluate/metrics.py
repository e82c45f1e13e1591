"""Comparison of a rendered picture with a photo: PSNR, SSIM, LPIPS where it is installed, and with colours aligned.

Colours are sRGB in [0, 1], as float or rounded to 8 bits. Pixels that do not count (masked, or without a ray) are
left out entirely: from PSNR pixel by pixel, from SSIM with every window that contains one.
"""

import functools
import importlib
import socket
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from scipy.ndimage import minimum_filter
from skimage.metrics import structural_similarity

from nerfcli.photos.colours import psnr_of, to_8_bit

# From Wang et al.: the Gaussian's standard deviation, and the width at which scikit-image cuts it off (3.5 sigma).
SIGMA = 1.5
WINDOW = 11


@dataclass(frozen=True)
class Metrics:
    """Similarity of a picture to a photo, or the mean over photos; None where it was not measured.

    Args:
        psnr, ssim, lpips: of the picture rounded to 8 bits.
        psnr_float, ssim_float: of the picture before rounding.
        psnr_colour_aligned, ssim_colour_aligned, lpips_colour_aligned: after `colour_aligned`.
    """

    psnr: float
    ssim: float | None = None
    lpips: float | None = None
    psnr_float: float | None = None
    ssim_float: float | None = None
    psnr_colour_aligned: float | None = None
    ssim_colour_aligned: float | None = None
    lpips_colour_aligned: float | None = None

    @staticmethod
    def mean(measured: Sequence["Metrics"]) -> "Metrics":
        """Return the mean of each metric; None if one of them does not have it."""
        values = {name: [getattr(metrics, name) for metrics in measured] for name in NAMES}
        means: dict[str, Any] = {
            name: None if None in found else statistics.fmean(found) for name, found in values.items()
        }
        return Metrics(**means)


NAMES = tuple(field.name for field in fields(Metrics))


def compare(rendered: np.ndarray, photo: np.ndarray, *, used: np.ndarray) -> Metrics:
    """Compare a picture, rounded to 8 bits, with a photo: PSNR, and SSIM unless they are lists of pixels.

    Args:
        rendered: (H, W, 3) or (N, 3) float sRGB in [0, 1].
        photo: the same shape, uint8.
        used: (H, W) or (N,) bool, the pixels that count; at least one.
    """
    rounded = to_8_bit(rendered)
    similarity = ssim(rounded, photo, used=used) if photo.ndim == 3 else None
    return Metrics(psnr(rounded, photo, used=used), similarity)


def compare_fully(
    rendered: np.ndarray, photo: np.ndarray, *, used: np.ndarray, perceptual: "Perceptual | None", align: bool
) -> Metrics:
    """Compare a picture with a photo by all metrics; `align`: whether its colours may be aligned. See `compare`."""
    found = replace(
        compare(rendered, photo, used=used),
        lpips=_lpips(to_8_bit(rendered), photo, used=used, perceptual=perceptual),
        psnr_float=psnr(rendered, photo, used=used),
        ssim_float=ssim(rendered, photo, used=used),
    )
    if not align:
        return found
    corrected = colour_aligned(as_float(rendered), as_float(photo), used=used)
    aligned = compare(corrected, photo, used=used)
    return replace(
        found,
        psnr_colour_aligned=aligned.psnr,
        ssim_colour_aligned=aligned.ssim,
        lpips_colour_aligned=_lpips(to_8_bit(corrected), photo, used=used, perceptual=perceptual),
    )


def as_float(picture: np.ndarray) -> np.ndarray:
    """Return colours in [0, 1] as float64: 8-bit levels divided by 255, floats clipped."""
    if picture.dtype == np.uint8:
        return picture / 255.0
    return np.clip(picture, 0.0, 1.0).astype(np.float64)


def psnr(picture: np.ndarray, photo: np.ndarray, *, used: np.ndarray) -> float:
    """Return the PSNR in dB of pictures (H, W, 3), uint8 or float in [0, 1], over `used` pixels (H, W): `psnr_of`."""
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


# Returns the distance of (picture, photo), both (H, W, 3) float in [0, 1].
Perceptual = Callable[[np.ndarray, np.ndarray], float]

LPIPS_NAME = "LPIPS AlexNet v0.1"
INSTALL = "pip install 'nerfcli[lpips]'"
# AlexNet halves a picture so often that nothing is left of a smaller one.
SMALLEST = 32


def find_perceptual(notify: Callable[[str], None]) -> Perceptual | None:
    """Load the perceptual distance; None, with one line for the user, if it is not available.

    Source: Zhang et al. 2018, The unreasonable effectiveness of deep features as a perceptual metric,
    arXiv:1801.03924; computed by torchmetrics.
    """
    found = _perceptual()
    if isinstance(found, str):
        notify(f"LPIPS is not available: {found}")
        return None
    return found


@functools.cache  # without a network, a second attempt would wait for it again
def _perceptual() -> Perceptual | str:
    """Return the perceptual distance, or why it is not available."""
    try:
        importlib.import_module("torchvision")
        metric = importlib.import_module("torchmetrics.image.lpip").LearnedPerceptualImagePatchSimilarity
    # A torchvision that was built for another torch fails with a RuntimeError or OSError.
    except (ImportError, RuntimeError, OSError) as error:
        return f"{_first_line(error)}; install it with {INSTALL}"
    try:
        with _socket_timeout():
            network = metric(net_type="alex", normalize=True)
    except (RuntimeError, OSError) as error:  # no network (URLError is an OSError), or a truncated file
        return f"its weights could not be loaded ({_first_line(error)})"

    def measure(picture: np.ndarray, photo: np.ndarray) -> float:
        pair = [torch.from_numpy(np.ascontiguousarray(p, dtype=np.float32)) for p in (picture, photo)]
        with torch.no_grad():
            return float(network(*(values.permute(2, 0, 1)[None] for values in pair)))

    return measure


def _lpips(picture: np.ndarray, truth: np.ndarray, *, used: np.ndarray, perceptual: Perceptual | None) -> float | None:
    if perceptual is None or min(used.shape) < SMALLEST:
        return None
    # The network needs whole pictures: both get the photo's colours where pixels do not count.
    return perceptual(as_float(np.where(used[..., None], picture, truth)), as_float(truth))


@contextmanager
def _socket_timeout() -> Iterator[None]:
    """Limit the wait for servers that do not answer, for which torch waits forever."""
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(20.0)
    try:
        yield
    finally:
        socket.setdefaulttimeout(before)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


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
