"""The gradient of the structural similarity of two pictures on CPU threads.

Pictures are (H, 3 W): rows of pixels with their channels side by side. Each output row reads the rows around it, so
that no sum under a window leaves the cache.
"""

from typing import Any

import numba
import numpy as np

from nerfcli.kernels.numba_cpu.splat_projection import FUSED
from nerfcli.kernels.numba_cpu.threads import use_threads

# Window and constants of Wang et al.: 11 pixels of a Gaussian of sigma 1.5, K1^2 and K2^2 for levels in [0, 1].
RADIUS, SIGMA = 5, 1.5
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
_TAPS = np.exp(-0.5 * (np.arange(RADIUS + 1) / SIGMA) ** 2)
TAPS = (_TAPS / (2.0 * _TAPS.sum() - _TAPS[0])).astype(np.float32)
TWO, ONE = np.float32(2), np.float32(1)


def similarity_gradient(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the derivative (H, W, 3) by `image` of the sum of the structural similarity over all windows and channels.

    SSIM = (2 x y + C1) (2 cov + C2) / ((x^2 + y^2 + C1) (var x + var y + C2)), with means x and y, variances and
    covariance under a window. Beyond its border, a picture is black.

    Source: Wang et al. 2004, Image quality assessment, IEEE TIP 13(4).
    """
    shape, rows = image.shape, (image.shape[0], 3 * image.shape[1])
    flat, other = np.ascontiguousarray(image).reshape(rows), np.ascontiguousarray(target).reshape(rows)
    slopes, out = np.empty((3, *rows), np.float32), np.empty(rows, np.float32)
    threads = use_threads()
    _slopes(flat, other, slopes, threads)
    _gathered(flat, other, slopes, out, threads)
    return out.reshape(shape)


@numba.njit(inline="always")
def _blur_row(source: Any, out: Any) -> None:
    """Write the means of a row (3 W,) under the window, across pixels; beyond its ends it is 0."""
    size = len(source)
    for j in range(size):
        out[j] = TAPS[0] * source[j]
    for k in range(1, RADIUS + 1):
        shift, tap = 3 * k, TAPS[k]
        for j in range(size - shift):
            out[j] += tap * source[j + shift]
        for j in range(shift, size):
            out[j] += tap * source[j - shift]


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy", fastmath=FUSED)
def _slopes(image: Any, target: Any, slopes: Any, threads: Any) -> None:
    """Write the derivatives of each window's similarity by its means of image^2, image * target, and image."""
    height, width = image.shape
    for thread in numba.prange(threads):
        sums, means = np.empty((5, width), np.float32), np.empty((5, width), np.float32)
        for row in range(thread * height // threads, (thread + 1) * height // threads):
            sums[:] = np.float32(0)
            for r in range(max(0, row - RADIUS), min(height, row + RADIUS + 1)):
                tap = TAPS[abs(r - row)]
                for j in range(width):
                    x, y = image[r, j], target[r, j]
                    sums[0, j] += tap * x
                    sums[1, j] += tap * y
                    sums[2, j] += tap * x * x
                    sums[3, j] += tap * y * y
                    sums[4, j] += tap * x * y
            for part in range(5):
                _blur_row(sums[part], means[part])
            for j in range(width):
                x, y = means[0, j], means[1, j]
                light, lights = TWO * x * y + C1, x * x + y * y + C1
                structure = TWO * (means[4, j] - x * y) + C2
                structures = means[2, j] - x * x + (means[3, j] - y * y) + C2
                scale = ONE / (lights * structures)
                similarity = light * structure * scale
                slopes[0, row, j] = -similarity / structures
                slopes[1, row, j] = TWO * light * scale
                by_variance, by_light = similarity / structures, similarity / lights
                slopes[2, row, j] = TWO * (y * scale * (structure - light) + x * (by_variance - by_light))


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy", fastmath=FUSED)
def _gathered(image: Any, target: Any, slopes: Any, out: Any, threads: Any) -> None:
    """Write the sum of what each pixel contributes to the windows around it."""
    height, width = image.shape
    for thread in numba.prange(threads):
        sums, means = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
        for row in range(thread * height // threads, (thread + 1) * height // threads):
            sums[:] = np.float32(0)
            for part in range(3):
                for r in range(max(0, row - RADIUS), min(height, row + RADIUS + 1)):
                    tap = TAPS[abs(r - row)]
                    for j in range(width):
                        sums[part, j] += tap * slopes[part, r, j]
                _blur_row(sums[part], means[part])
            for j in range(width):
                out[row, j] = means[2, j] + TWO * image[row, j] * means[0, j] + target[row, j] * means[1, j]
