"""Volumes on CPU threads: line integrals, their transpose, and denoising by total variation; see `reference.volumes`.

Forwards, lines are processed in parallel. Backwards, each thread owns some planes across the axis that lines are most
aligned with, and a line touches only four voxels of a plane: no two threads write to the same voxel, and the order of
sums does not depend on the threads. Which planes a line crosses is computed once, since most lines cross few of the
planes that a thread owns.
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.numba_cpu.threads import use_threads

# Planes per work item backwards: few enough to keep all threads busy, enough to cut each line rarely.
SLAB = 16


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _enter(start: Any, slope: Any, count: Any, low: Any, high: Any) -> tuple[Any, Any]:
    """Return the planes from `low` up to `high` where start + plane * slope is, or almost is, between -1 and count."""
    if slope == 0.0:
        if start <= -1.0 or start >= count:
            return 0, 0
        return low, high
    one, two = (-1.0 - start) / slope, (count - start) / slope
    if one > two:
        one, two = two, one
    # Bounds are compared before conversion to integers: a line may pass very far away.
    if one >= high or two < low:
        return 0, 0
    if one >= low:
        low = int(np.ceil(one))
    if two < high:
        high = int(np.ceil(two))
    return low, high


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _line(origin: Any, direction: Any, first: Any, size: Any, counts: Any) -> tuple:
    """Return a line's main and other axes, its planes, start and slope of its other coordinates, length per plane."""
    axis = 0
    for j in range(1, 3):
        if abs(direction[j]) > abs(direction[axis]):
            axis = j
    b = 1 if axis == 0 else 0
    c = 1 if axis == 2 else 2
    at = (origin[axis] - first[axis]) / size
    slope_b, slope_c = direction[b] / direction[axis], direction[c] / direction[axis]
    start_b = (origin[b] - first[b]) / size - at * slope_b
    start_c = (origin[c] - first[c]) / size - at * slope_c
    low, high = _enter(start_b, slope_b, counts[b], 0, counts[axis])
    low, high = _enter(start_c, slope_c, counts[c], low, high)
    length = size * np.sqrt(1.0 + slope_b * slope_b + slope_c * slope_c)
    return axis, b, c, low, high, start_b, slope_b, start_c, slope_c, length


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _project(volume: Any, origins: Any, directions: Any, first: Any, size: Any, counts: Any, out: Any) -> None:
    strides = np.array([1, counts[0], counts[0] * counts[1]])
    for r in numba.prange(len(origins)):
        axis, b, c, low, high, start_b, slope_b, start_c, slope_c, length = _line(
            origins[r], directions[r], first, size, counts
        )
        step_a, step_b, step_c = strides[axis], strides[b], strides[c]
        total = 0.0
        for k in range(low, high):
            place_b, place_c = start_b + k * slope_b, start_c + k * slope_c
            floor_b, floor_c = np.floor(place_b), np.floor(place_c)
            i, j = int(floor_b), int(floor_c)
            fraction_b, fraction_c = place_b - floor_b, place_c - floor_c
            at = k * step_a + i * step_b + j * step_c
            if i >= 0 and i < counts[b]:
                if j >= 0 and j < counts[c]:
                    total += (1.0 - fraction_b) * (1.0 - fraction_c) * volume[at]
                if j >= -1 and j + 1 < counts[c]:
                    total += (1.0 - fraction_b) * fraction_c * volume[at + step_c]
            if i >= -1 and i + 1 < counts[b]:
                if j >= 0 and j < counts[c]:
                    total += fraction_b * (1.0 - fraction_c) * volume[at + step_b]
                if j >= -1 and j + 1 < counts[c]:
                    total += fraction_b * fraction_c * volume[at + step_b + step_c]
        out[r] = total * length


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _back_project(values: Any, origins: Any, directions: Any, first: Any, size: Any, counts: Any, out: Any) -> None:
    strides = np.array([1, counts[0], counts[0] * counts[1]])
    lines = len(origins)
    axes, lows, highs = np.empty(lines, np.int8), np.empty(lines, np.int64), np.empty(lines, np.int64)
    for r in numba.prange(lines):
        axis, _, _, low, high, _, _, _, _, _ = _line(origins[r], directions[r], first, size, counts)
        axes[r], lows[r], highs[r] = axis, low, high
    for wanted in range(3):
        for slab in numba.prange((counts[wanted] + SLAB - 1) // SLAB):
            begin, end = slab * SLAB, (slab + 1) * SLAB
            for r in range(lines):
                if axes[r] != wanted or highs[r] <= begin or lows[r] >= end:
                    continue
                axis, b, c, low, high, start_b, slope_b, start_c, slope_c, length = _line(
                    origins[r], directions[r], first, size, counts
                )
                step_a, step_b, step_c = strides[axis], strides[b], strides[c]
                value = values[r] * length
                for k in range(max(low, begin), min(high, end)):
                    place_b, place_c = start_b + k * slope_b, start_c + k * slope_c
                    floor_b, floor_c = np.floor(place_b), np.floor(place_c)
                    i, j = int(floor_b), int(floor_c)
                    fraction_b, fraction_c = place_b - floor_b, place_c - floor_c
                    at = k * step_a + i * step_b + j * step_c
                    if i >= 0 and i < counts[b]:
                        if j >= 0 and j < counts[c]:
                            out[at] += value * (1.0 - fraction_b) * (1.0 - fraction_c)
                        if j >= -1 and j + 1 < counts[c]:
                            out[at + step_c] += value * (1.0 - fraction_b) * fraction_c
                    if i >= -1 and i + 1 < counts[b]:
                        if j >= 0 and j < counts[c]:
                            out[at + step_b] += value * fraction_b * (1.0 - fraction_c)
                        if j >= -1 and j + 1 < counts[c]:
                            out[at + step_b + step_c] += value * fraction_b * fraction_c


def project(
    volume: Tensor, origins: Tensor, directions: Tensor, *, first: tuple[float, float, float], size: float
) -> Tensor:
    """See `reference.project`; a float32 volume, lines in float64. No gradients: see `back_project`."""
    use_threads()
    out = np.empty(len(origins), dtype=np.float32)
    lines_and_grid = _arguments(origins, directions, first, size, tuple(volume.shape))
    _project(volume.detach().contiguous().view(-1).numpy(), *lines_and_grid, out)
    return torch.from_numpy(out)


def back_project(
    values: Tensor,
    origins: Tensor,
    directions: Tensor,
    *,
    shape: tuple[int, int, int],
    first: tuple[float, float, float],
    size: float,
) -> Tensor:
    """See `reference.back_project`; float32 values, lines in float64."""
    use_threads()
    out = np.zeros(shape[0] * shape[1] * shape[2], dtype=np.float32)
    _back_project(values.detach().contiguous().numpy(), *_arguments(origins, directions, first, size, shape), out)
    return torch.from_numpy(out).view(shape)


def _arguments(
    origins: Tensor, directions: Tensor, first: tuple[float, float, float], size: float, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray]:
    """Return lines and grid as the loops take them."""
    lines = origins.contiguous().numpy(), directions.contiguous().numpy()
    return *lines, np.array(first, dtype=np.float64), float(size), np.array(shape[::-1])


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _primal(target: Any, threshold: Any, dual: Any, out: Any) -> None:
    depth, height, width = target.shape
    zero = np.float32(0)
    for k in numba.prange(depth):
        for j in range(height):
            for i in range(width):
                value = zero
                if i + 1 < width:
                    value -= dual[0, k, j, i]
                if i > 0:
                    value += dual[0, k, j, i - 1]
                if j + 1 < height:
                    value -= dual[1, k, j, i]
                if j > 0:
                    value += dual[1, k, j - 1, i]
                if k + 1 < depth:
                    value -= dual[2, k, j, i]
                if k > 0:
                    value += dual[2, k - 1, j, i]
                moved = target[k, j, i] - threshold[k, j, i] * value
                out[k, j, i] = moved if moved > zero else zero


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _step(volume: Any, threshold: Any, dual: Any) -> None:
    depth, height, width = volume.shape
    zero, one, bound = np.float32(0), np.float32(1), np.float32(12)
    for k in numba.prange(depth):
        for j in range(height):
            for i in range(width):
                here = volume[k, j, i]
                largest = threshold[k, j, i]
                x, y, z = zero, zero, zero
                if i + 1 < width:
                    x = volume[k, j, i + 1] - here
                    largest = max(largest, threshold[k, j, i + 1])
                if j + 1 < height:
                    y = volume[k, j + 1, i] - here
                    largest = max(largest, threshold[k, j + 1, i])
                if k + 1 < depth:
                    z = volume[k + 1, j, i] - here
                    largest = max(largest, threshold[k + 1, j, i])
                rate = one / (bound * largest)
                x = dual[0, k, j, i] + rate * x
                y = dual[1, k, j, i] + rate * y
                z = dual[2, k, j, i] + rate * z
                length = np.sqrt(x * x + y * y + z * z)
                if length > one:
                    x, y, z = x / length, y / length, z / length
                dual[0, k, j, i], dual[1, k, j, i], dual[2, k, j, i] = x, y, z


def denoise_total_variation(target: Tensor, threshold: Tensor, dual: Tensor, *, iterations: int) -> Tensor:
    """See `reference.denoise_total_variation`; float32 on the CPU."""
    use_threads()
    wanted, limits, pushes = (x.detach().contiguous().numpy() for x in (target, threshold, dual))
    out = np.empty_like(wanted)
    for _ in range(iterations):
        _primal(wanted, limits, pushes, out)
        _step(out, limits, pushes)
    _primal(wanted, limits, pushes, out)
    return torch.from_numpy(out)
