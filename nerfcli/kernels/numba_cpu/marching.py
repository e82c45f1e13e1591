"""The samples of rays in occupied cells, on CPU threads: for fields whose density is not compiled in `visible`."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.interface import March, Rays
from nerfcli.kernels.numba_cpu.rays import CHUNK, cut, look_ahead, walk_of
from nerfcli.kernels.numba_cpu.threads import use_threads


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _samples(walk: Any, offsets: Any, spans: Any, coordinates: Any) -> None:
    """Write the samples of each ray from its offset on; without room for them, write their number behind the offset."""
    intervals = walk.edges.shape[0] - 2 - CHUNK
    for ray in numba.prange(offsets.shape[0] - 1):
        places, cells = np.empty(3 * CHUNK, np.float32), np.empty(CHUNK, np.int32)
        at = offsets[ray] if spans is not None else 0  # decided when this is compiled
        for first in range(0, intervals, CHUNK):
            if spans is not None and at == offsets[ray + 1]:
                break
            look_ahead(walk, ray, first, places, cells)
            for i in range(min(CHUNK, intervals - first)):
                if cells[i] >= 0 and walk.occupied[cells[i]]:
                    if spans is not None:
                        spans[0, at] = cut(walk.edges, walk.jitter[ray], first + i)
                        spans[1, at] = cut(walk.edges, walk.jitter[ray], first + i + 1)
                        for axis in range(3):
                            coordinates[at, axis] = places[axis * CHUNK + i]
                    at += 1
        if spans is None:
            offsets[ray + 1] = at


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _keep_largest(cells: Any, coordinates: Any, values: Any, threads: Any) -> None:
    """See `keep_largest`; each thread owns layers of cells, so that no cell is written by two threads."""
    side = cells.shape[0]
    scale, zero, most = np.float32(side), np.float32(0), np.float32(side - 1)
    for thread in numba.prange(threads):
        first, last = thread * side // threads, (thread + 1) * side // threads
        for i in range(values.shape[0]):
            z = np.int64(min(max(coordinates[i, 2] * scale, zero), most))
            if first <= z < last:
                y = np.int64(min(max(coordinates[i, 1] * scale, zero), most))
                x = np.int64(min(max(coordinates[i, 0] * scale, zero), most))
                if values[i] > cells[z, y, x]:
                    cells[z, y, x] = values[i]


def keep_largest(cells: Tensor, coordinates: Tensor, values: Tensor) -> None:
    """See `reference.keep_largest`; float32 on the CPU."""
    _keep_largest(
        cells.numpy(), coordinates.detach().contiguous().numpy(), values.detach().contiguous().numpy(), use_threads()
    )


def occupied_samples(rays: Rays, along: March) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `reference.occupied_samples`; float32 on the CPU."""
    use_threads()
    walk, offsets = walk_of(rays, along), np.zeros(len(rays.origins) + 1, np.int64)
    _samples(walk, offsets, None, None)
    offsets = offsets.cumsum()
    spans, coordinates = torch.empty(2, int(offsets[-1])), torch.empty(int(offsets[-1]), 3)
    _samples(walk, offsets, spans.numpy(), coordinates.numpy())
    return spans[0], spans[1], coordinates, torch.from_numpy(offsets)
