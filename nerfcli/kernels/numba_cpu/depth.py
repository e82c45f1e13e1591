"""Depth of rays on CPU threads, one ray at a time: mean, spread, heaviest interval and quantiles in one pass.

Same operation as `depth.light_ends`, for float32; everything is computed in float64. Mean and variance are updated
sample by sample around the mean so far, which cancels nothing.
Source: West 1979, Updating mean and variance estimates, CACM 22(9).
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.interface import LightEnds
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.reference.depth import BISECTIONS, SERIES_BELOW, VARIANCE_SERIES, VARIANCE_SERIES_BELOW

_SERIES = np.array(VARIANCE_SERIES)


@numba.njit(inline="always")
def _mean_fraction(x: Any, alpha: Any) -> Any:
    """`depth.mean_fraction` of an optical depth whose opacity is alpha."""
    if x < SERIES_BELOW:
        x2 = x * x
        tail = 1 / 30240 - x2 * (1 / 1209600 - x2 / 47900160)
        return 0.5 - x * (1 / 12 - x2 * (1 / 720 - x2 * tail))
    return 1.0 / x - (1.0 - alpha) / alpha


@numba.njit(inline="always")
def _variance_fraction(x: Any, alpha: Any) -> Any:
    """`depth.variance_fraction` of an optical depth whose opacity is alpha."""
    if x < VARIANCE_SERIES_BELOW:
        x2, series = x * x, 0.0
        for i in range(len(_SERIES) - 1, -1, -1):
            series = series * x2 + _SERIES[i]
        return series
    return 1.0 / (x * x) - (1.0 - alpha) / (alpha * alpha)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _light_ends(density: Any, starts: Any, ends: Any, offsets: Any, targets: Any, out: Any, quantiles: Any) -> None:
    """Columns of out: opacity, transmittance, mean, spread, heaviest, largest."""
    for ray in numba.prange(offsets.shape[0] - 1):
        depth, mass, mean, squares = 0.0, 0.0, 0.0, 0.0
        largest, heaviest, crossed = 0.0, np.nan, 0
        quantiles[ray, :] = np.nan
        for i in range(offsets[ray], offsets[ray + 1]):
            start, length = np.float64(starts[i]), np.float64(ends[i]) - np.float64(starts[i])
            sigma = np.float64(density[i])
            own = sigma * length
            alpha = -np.expm1(-own)
            weight = np.exp(-depth) * alpha
            if weight > 0.0:
                place = start + length * _mean_fraction(own, alpha)
                mass += weight
                step = place - mean
                mean += step * (weight / mass)
                squares += weight * (step * (place - mean) + length * length * _variance_fraction(own, alpha))
                if weight > largest:
                    largest, heaviest = weight, place
            # Targets increase.
            while crossed < targets.shape[0] and depth + own >= targets[crossed]:
                inside = (targets[crossed] - depth) / sigma if sigma > 0.0 else 0.0
                quantiles[ray, crossed] = start + min(max(inside, 0.0), length)
                crossed += 1
            depth += own
        out[ray, 0] = -np.expm1(-depth)
        out[ray, 1] = np.exp(-depth)
        out[ray, 2] = mean if mass > 0.0 else np.nan
        out[ray, 3] = np.sqrt(squares / mass) if mass > 0.0 else np.nan
        out[ray, 4] = heaviest
        out[ray, 5] = largest


def light_ends(
    density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, shares: tuple[float, ...]
) -> LightEnds:
    """See `depth.light_ends`; float32 on the CPU, without gradients."""
    use_threads()
    order = np.argsort(shares, kind="stable")
    targets = torch.from_numpy(-np.log1p(-np.asarray(shares, dtype=np.float64)[order]))
    rays = len(offsets) - 1
    out, quantiles = torch.empty(rays, 6), torch.empty(rays, len(shares))
    tensors = (density, starts, ends, offsets, targets, out, quantiles)
    _light_ends(*(x.detach().contiguous().numpy() for x in tensors))
    back = torch.from_numpy(np.argsort(order, kind="stable"))
    return LightEnds(*(out[:, column] for column in range(6)), quantiles=quantiles[:, back])


@numba.njit(inline="always")
def _passed(density: Any, starts: Any, ends: Any, offsets: Any, first: Any, count: Any, t: Any) -> Any:
    """The mean transmittance of some rays at distance t."""
    total = 0.0
    for ray in range(first, first + count):
        depth = 0.0
        for i in range(offsets[ray], offsets[ray + 1]):
            start = np.float64(starts[i])
            if start >= t:
                break
            depth += np.float64(density[i]) * (min(t, np.float64(ends[i])) - start)
        total += np.exp(-depth)
    return total / count


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _mixture_quantile(density: Any, starts: Any, ends: Any, offsets: Any, out: Any, asked: Any) -> None:
    count, wanted = np.int64(asked[0]), asked[1]
    for pixel in numba.prange(out.shape[0]):
        first, low, high = pixel * count, 0.0, 0.0
        for ray in range(first, first + count):
            if offsets[ray + 1] > offsets[ray]:
                high = max(high, np.float64(ends[offsets[ray + 1] - 1]))
        out[pixel] = np.nan
        if high > 0.0 and _passed(density, starts, ends, offsets, first, count, high) <= wanted:
            for _ in range(BISECTIONS):
                middle = (low + high) / 2
                if _passed(density, starts, ends, offsets, first, count, middle) <= wanted:
                    high = middle
                else:
                    low = middle
            out[pixel] = high


def mixture_quantile(
    density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, rays_per_pixel: int, share: float
) -> Tensor:
    """See `depth.mixture_quantile`; float32 on the CPU."""
    use_threads()
    out = torch.empty((len(offsets) - 1) // rays_per_pixel)
    wanted = torch.tensor([float(rays_per_pixel), 1.0 - share], dtype=torch.float64)
    tensors = (density, starts, ends, offsets, out, wanted)
    _mixture_quantile(*(x.detach().contiguous().numpy() for x in tensors))
    return out
