"""Rays on CPU threads: cutting them into occupied intervals, and where the samples lie in the field's cube.

Same operations as in `reference`, for float32. A thread owns whole rays.
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.numba_cpu.threads import thread_count

# Steps of a ray that are looked at together: LLVM makes no vectors of a loop over fewer.
CHUNK = 16


@numba.njit(inline="always")
def cube(x: Any, y: Any, z: Any, unbounded: Any) -> Any:
    """`reference.grid_coordinates` of one point; without branches, so that loops over it become vectors."""
    half, quarter, one, two = np.float32(0.5), np.float32(0.25), np.float32(1), np.float32(2)
    if not unbounded:
        return x * half + half, y * half + half, z * half + half
    norm = np.sqrt(max(x * x + y * y + z * z, one))
    scale = (two - one / norm) / norm * quarter
    return x * scale + half, y * scale + half, z * scale + half


@numba.njit(inline="always")
def cut(edges: Any, shift: Any, k: Any) -> Any:
    """The jittered edge number k."""
    return edges[k] + shift * (edges[k + 1] - edges[k])


@numba.njit(inline="always")
def look_ahead(
    origins: Any, directions: Any, edges: Any, jitter: Any, ray: Any, first: Any, side: Any, unbounded: Any,
    places: Any, cells: Any,
) -> None:  # fmt: skip
    """Coordinates (3, CHUNK) of the middles of CHUNK intervals from `first`, and their cells; -1 outside of the grid.

    `edges` are `padded`: what lies beyond the last interval is for the caller to leave out.
    """
    ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
    dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
    shift, half, scale = jitter[ray], np.float32(0.5), np.float32(side)
    zero, one, last = np.float32(0), np.float32(1), np.int32(side - 1)
    near, middle, far = edges[first : first + CHUNK], edges[first + 1 :], edges[first + 2 :]
    xs, ys, zs = places[0], places[1], places[2]
    for i in range(CHUNK):
        start, end = near[i] + shift * (middle[i] - near[i]), middle[i] + shift * (far[i] - middle[i])
        t = (start + end) * half
        x, y, z = cube(ox + dx * t, oy + dy * t, oz + dz * t, unbounded)
        xs[i], ys[i], zs[i] = x, y, z
        inside = (x >= zero) & (y >= zero) & (z >= zero) & (x <= one) & (y <= one) & (z <= one)
        # Clamped before they become integers: a far point outside of a bounded scene would not fit into one.
        column = min(np.int32(min(max(x, zero), one) * scale), last)
        row = min(np.int32(min(max(y, zero), one) * scale), last)
        layer = min(np.int32(min(max(z, zero), one) * scale), last)
        cells[i] = (layer * side + row) * side + column if inside else -1


def padded(edges: Tensor) -> np.ndarray:
    """Edges with as many copies of the last as `look_ahead` may look at."""
    return torch.nn.functional.pad(edges[None], (0, CHUNK), mode="replicate")[0].numpy()


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _mark(
    origins: Any, directions: Any, edges: Any, jitter: Any, occupied: Any, side: Any, unbounded: Any, kept: Any,
    counts: Any,
) -> None:  # fmt: skip
    intervals = kept.shape[1]
    for ray in numba.prange(origins.shape[0]):
        places, cells = np.empty((3, CHUNK), np.float32), np.empty(CHUNK, np.int32)
        count = 0
        for first in range(0, intervals, CHUNK):
            look_ahead(origins, directions, edges, jitter, ray, first, side, unbounded, places, cells)
            for i in range(min(CHUNK, intervals - first)):
                keep = cells[i] >= 0 and occupied[cells[i]]
                kept[ray, first + i] = keep
                count += keep
        counts[ray] = count


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _collect(edges: Any, jitter: Any, kept: Any, offsets: Any, starts: Any, ends: Any) -> None:
    for ray in numba.prange(kept.shape[0]):
        shift = jitter[ray]
        at = offsets[ray]
        for k in range(kept.shape[1]):
            if kept[ray, k]:
                starts[at], ends[at] = cut(edges, shift, k), cut(edges, shift, k + 1)
                at += 1


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _sample_coordinates(
    origins: Any, directions: Any, starts: Any, ends: Any, offsets: Any, unbounded: Any, out: Any
) -> None:
    for ray in numba.prange(origins.shape[0]):
        for i in range(offsets[ray], offsets[ray + 1]):
            t = (starts[i] + ends[i]) * np.float32(0.5)
            out[i, 0], out[i, 1], out[i, 2] = cube(
                origins[ray, 0] + directions[ray, 0] * t,
                origins[ray, 1] + directions[ray, 1] * t,
                origins[ray, 2] + directions[ray, 2] * t,
                unbounded,
            )


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
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
        origins.contiguous().numpy(), directions.contiguous().numpy(), padded(edges), jitter.numpy(),
        occupied.contiguous().view(-1).numpy(), occupied.shape[0], unbounded, kept, counts,
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
