"""Depth of rays on CPU threads, one ray at a time: mean, spread, heaviest interval and quantiles in one pass.

Same operation as `reference.ray_termination`, for float32; everything is computed in float64. Mean and variance are
updated sample by sample around the mean so far, which avoids cancellation.
Source: West 1979, Updating mean and variance estimates, CACM 22(9).
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.interface import RayTermination
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.reference.depth import SERIES_BELOW, VARIANCE_SERIES, VARIANCE_SERIES_BELOW

_SERIES = np.array(VARIANCE_SERIES)


@numba.njit(inline="always")
def _mean_fraction(x: Any, alpha: Any) -> Any:
    """Return `depth.mean_fraction` of an optical depth x with opacity alpha."""
    if x < SERIES_BELOW:
        x2 = x * x
        tail = 1 / 30240 - x2 * (1 / 1209600 - x2 / 47900160)
        return 0.5 - x * (1 / 12 - x2 * (1 / 720 - x2 * tail))
    return 1.0 / x - (1.0 - alpha) / alpha


@numba.njit(inline="always")
def _variance_fraction(x: Any, alpha: Any) -> Any:
    """Return `depth.variance_fraction` of an optical depth x with opacity alpha."""
    if x < VARIANCE_SERIES_BELOW:
        x2, series = x * x, 0.0
        for i in range(len(_SERIES) - 1, -1, -1):
            series = series * x2 + _SERIES[i]
        return series
    return 1.0 / (x * x) - (1.0 - alpha) / (alpha * alpha)


# Columns of the running sums of a ray: optical depth, weight, mean and sum of squared differences from it, mean of
# the heaviest interval and its weight, number of quantiles passed.
DEPTH, MASS, MEAN, SQUARES, HEAVIEST, LARGEST, PASSED = range(7)


@numba.njit(inline="always")
def add_interval(sums: Any, ray: Any, start: Any, length: Any, density: Any, targets: Any, quantiles: Any) -> Any:
    """Add the next interval of a ray to its row of `sums`, initially zero, and return its weight.

    `targets` are increasing optical depths; the distances where the ray passes them go to its row of `quantiles`.
    """
    depth, own = sums[ray, DEPTH], density * length
    alpha = -np.expm1(-own)
    weight = (1.0 - sums[ray, MASS]) * alpha  # exp(-depth) within 1e-15, without computing it
    if weight > 0.0:
        place = start + length * _mean_fraction(own, alpha)
        sums[ray, MASS] += weight
        step = place - sums[ray, MEAN]
        sums[ray, MEAN] += step * (weight / sums[ray, MASS])
        within = length * length * _variance_fraction(own, alpha)
        sums[ray, SQUARES] += weight * (step * (place - sums[ray, MEAN]) + within)
        if weight > sums[ray, LARGEST]:
            sums[ray, LARGEST], sums[ray, HEAVIEST] = weight, place
    passed = np.int64(sums[ray, PASSED])
    while passed < targets.shape[0] and depth + own >= targets[passed]:
        inside = (targets[passed] - depth) / density if density > 0.0 else 0.0
        quantiles[ray, passed] = start + min(max(inside, 0.0), length)
        passed += 1
    sums[ray, PASSED] = passed
    sums[ray, DEPTH] = depth + own
    return weight


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _ray_termination(
    density: Any, starts: Any, ends: Any, offsets: Any, targets: Any, sums: Any, quantiles: Any
) -> None:
    for ray in numba.prange(offsets.shape[0] - 1):
        for i in range(offsets[ray], offsets[ray + 1]):
            start, length = np.float64(starts[i]), np.float64(ends[i]) - np.float64(starts[i])
            add_interval(sums, ray, start, length, np.float64(density[i]), targets, quantiles)


def ray_termination(
    density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, fractions: tuple[float, ...]
) -> RayTermination:
    """See `reference.ray_termination`; float32 on the CPU, without gradients."""
    use_threads()
    sums, quantiles, targets = new_sums(len(offsets) - 1, fractions)
    arrays = [x.detach().contiguous().numpy() for x in (density, starts, ends, offsets)]
    _ray_termination(arrays[0], arrays[1], arrays[2], arrays[3], targets, sums, quantiles)
    return ray_termination_of(sums, quantiles, fractions)


def new_sums(rays: int, fractions: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sums (R, 7) of 0, quantiles (R, Q) of NaN, and the sorted optical depths of the quantiles (Q,)."""
    targets = np.sort(-np.log1p(-np.asarray(fractions, dtype=np.float64)), kind="stable")
    return np.zeros((rays, PASSED + 1)), np.full((rays, len(fractions)), np.nan, np.float32), targets


def ray_termination_of(sums: np.ndarray, quantiles: np.ndarray, fractions: tuple[float, ...]) -> RayTermination:
    """Return the results of rays from their sums, after all their intervals have been added."""
    depth, mass, mean, squares, peak, largest, _ = torch.from_numpy(sums).unbind(1)
    seen = mass > 0.0
    spread = torch.sqrt(squares / torch.where(seen, mass, 1.0))
    back = np.argsort(np.argsort(fractions, kind="stable"), kind="stable")
    return RayTermination(
        opacity=-torch.expm1(-depth).float(),
        transmittance=torch.exp(-depth).float(),
        mean=torch.where(seen, mean, torch.nan).float(),
        spread=torch.where(seen, spread, torch.nan).float(),
        peak=torch.where(largest > 0.0, peak, torch.nan).float(),
        quantiles=torch.from_numpy(quantiles[:, back]),
    )
