"""Denoising of a volume by its total variation, on CPU threads; as `reference.denoise_total_variation`."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.numba_cpu.threads import use_threads


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
