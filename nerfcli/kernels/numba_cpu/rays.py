"""Rays on CPU threads: cutting them into occupied intervals, and where the samples lie in the field's cube.

Same operations as in `reference`, for float32. A thread owns whole rays.
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.numba_cpu.threads import thread_count


@numba.njit(inline="always")
def _cube(x: Any, y: Any, z: Any, unbounded: Any) -> Any:
    """`reference.grid_coordinates` of one point."""
    half, quarter, one, two = np.float32(0.5), np.float32(0.25), np.float32(1), np.float32(2)
    if not unbounded:
        return x * half + half, y * half + half, z * half + half
    square = x * x + y * y + z * z
    if square <= one:
        return x * quarter + half, y * quarter + half, z * quarter + half
    norm = np.sqrt(square)
    scale = (two - one / norm) / norm * quarter
    return x * scale + half, y * scale + half, z * scale + half


@numba.njit(parallel=True, cache=True, nogil=True)
def _mark(
    origins: Any, directions: Any, edges: Any, jitter: Any, occupied: Any, unbounded: Any, kept: Any, counts: Any
) -> None:
    side = occupied.shape[0]
    cells = np.float32(side)
    intervals = edges.shape[0] - 2
    for ray in numba.prange(origins.shape[0]):
        ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        shift = jitter[ray]
        start = edges[0] + shift * (edges[1] - edges[0])
        count = 0
        for k in range(intervals):
            end = edges[k + 1] + shift * (edges[k + 2] - edges[k + 1])
            t = (start + end) * np.float32(0.5)
            start = end
            x, y, z = _cube(ox + dx * t, oy + dy * t, oz + dz * t, unbounded)
            keep = False
            if x >= 0 and y >= 0 and z >= 0 and x <= 1 and y <= 1 and z <= 1:
                keep = occupied[
                    min(int(z * cells), side - 1), min(int(y * cells), side - 1), min(int(x * cells), side - 1)
                ]
            kept[ray, k] = keep
            count += keep
        counts[ray] = count


@numba.njit(parallel=True, cache=True, nogil=True)
def _collect(edges: Any, jitter: Any, kept: Any, offsets: Any, starts: Any, ends: Any) -> None:
    for ray in numba.prange(kept.shape[0]):
        shift = jitter[ray]
        at = offsets[ray]
        for k in range(kept.shape[1]):
            if kept[ray, k]:
                starts[at] = edges[k] + shift * (edges[k + 1] - edges[k])
                ends[at] = edges[k + 1] + shift * (edges[k + 2] - edges[k + 1])
                at += 1


@numba.njit(parallel=True, cache=True, nogil=True)
def _sample_coordinates(
    origins: Any, directions: Any, starts: Any, ends: Any, offsets: Any, unbounded: Any, out: Any
) -> None:
    for ray in numba.prange(origins.shape[0]):
        for i in range(offsets[ray], offsets[ray + 1]):
            t = (starts[i] + ends[i]) * np.float32(0.5)
            out[i, 0], out[i, 1], out[i, 2] = _cube(
                origins[ray, 0] + directions[ray, 0] * t,
                origins[ray, 1] + directions[ray, 1] * t,
                origins[ray, 2] + directions[ray, 2] * t,
                unbounded,
            )


@numba.njit(parallel=True, cache=True, nogil=True)
def _ray_indices(offsets: Any, out: Any) -> None:
    for ray in numba.prange(offsets.shape[0] - 1):
        out[offsets[ray] : offsets[ray + 1]] = ray


def march(
    origins: Tensor, directions: Tensor, edges: Tensor, *, jitter: Tensor, occupied: Tensor, unbounded: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.march`; float32 on the CPU."""
    numba.set_num_threads(thread_count())
    kept = np.empty((len(origins), len(edges) - 2), np.bool_)
    counts = np.empty(len(origins), np.int64)
    _mark(
        origins.contiguous().numpy(), directions.contiguous().numpy(), edges.numpy(), jitter.numpy(),
        occupied.numpy(), unbounded, kept, counts,
    )  # fmt: skip
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    starts, ends = torch.empty(int(offsets[-1])), torch.empty(int(offsets[-1]))
    _collect(edges.numpy(), jitter.numpy(), kept, offsets, starts.numpy(), ends.numpy())
    return starts, ends, torch.from_numpy(offsets)


def sample_coordinates(
    origins: Tensor, directions: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, unbounded: bool
) -> Tensor:
    """See `reference.sample_coordinates`; float32 on the CPU, without gradients."""
    numba.set_num_threads(thread_count())
    out = torch.empty(len(starts), 3)
    _sample_coordinates(
        origins.contiguous().numpy(), directions.contiguous().numpy(), starts.numpy(), ends.numpy(),
        offsets.numpy(), unbounded, out.numpy(),
    )  # fmt: skip
    return out


def ray_indices(offsets: Tensor) -> Tensor:
    """See `reference.ray_indices`."""
    numba.set_num_threads(thread_count())
    out = torch.empty(int(offsets[-1]), dtype=torch.int64)
    _ray_indices(offsets.numpy(), out.numpy())
    return out


@numba.njit(cache=True, nogil=True)
def _scatter_max(grid: Any, coordinates: Any, values: Any) -> None:
    side = grid.shape[0]
    cells = np.float32(side)
    for i in range(values.shape[0]):
        x = min(max(int(coordinates[i, 0] * cells), 0), side - 1)
        y = min(max(int(coordinates[i, 1] * cells), 0), side - 1)
        z = min(max(int(coordinates[i, 2] * cells), 0), side - 1)
        if values[i] > grid[z, y, x]:
            grid[z, y, x] = values[i]


def scatter_max(grid: Tensor, coordinates: Tensor, values: Tensor) -> None:
    """See `reference.scatter_max`; float32 on the CPU. One thread: it is a thousandth of a step's work."""
    _scatter_max(grid.numpy(), coordinates.contiguous().numpy(), values.contiguous().numpy())
