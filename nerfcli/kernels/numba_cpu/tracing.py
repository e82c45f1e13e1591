"""Rendering of pictures of a hash grid: marching, encoding, both networks and compositing in one pass.

Same operation as `Backend.trace_rays`, two to three times as fast, because only the interval and the density of
a sample are kept. A sample's colour is evaluated or skipped as soon as the sample is found, when the number of samples
of its ray is not yet known; the weight of the skipped ones is summed, and bounds the error as before.
"""

import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.harmonics import spherical_harmonics
from nerfcli.kernels.interface import UNSEEN, HashGrid, Intervals, March, Rays, RaysSeen, TraceOptions
from nerfcli.kernels.numba_cpu.depth import add_interval, new_sums, ray_termination_of
from nerfcli.kernels.numba_cpu.hash_grid import encode_range, new_scratch
from nerfcli.kernels.numba_cpu.networks import OUT, TILE, WIDTH, colour_range, density_tile
from nerfcli.kernels.numba_cpu.rays import CHUNK
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.visible import LANES, ROUND, arrays_of, fill_round, new_round

# A sample's colour may be skipped if its weight is at most this fraction of `negligible`, the limit for its ray.
PART = 1 / 32


@numba.njit(nogil=True, error_model="numpy")
def _add_colours(
    inputs: Any, count: Any, ray: Any, weight: Any, weights: Any, x: Any, h: Any, out: Any, channels: Any, colours: Any
) -> None:
    """Add the weighted colours of the first `count` samples of a tile to those of their rays."""
    colour_range(inputs, weights, x, h, out, channels)
    for i in range(count):
        for channel in range(3):
            colours[ray[i], channel] += weight[i] * np.float64(channels[3 * i + channel])


@numba.njit(nogil=True, error_model="numpy")
def _trace(
    walk: Any, space: Any, table: Any, weights: Any, deepest: Any, harmonics: Any, negligible: Any, targets: Any,
    coming: Any, last_ray: Any, sums: Any, quantiles: Any, colours: Any, unseen: Any, counts: Any, owner: Any,
    record: Any,
) -> Any:  # fmt: skip
    """Trace rays from `coming` up to `last_ray`, adding to their rows of sums, quantiles, colours and unseen weight.

    Unless `owner` is empty, samples are written to `owner` and `record`, in the order in which they are found.

    Returns:
        number of samples written.
    """
    intervals = walk.edges.shape[0] - 2 - CHUNK
    lanes, look, samples = new_round(walk)
    points = samples.points.reshape(-1)
    encoded = np.empty(ROUND * WIDTH, np.float32)
    scratch = new_scratch()
    x, h = np.empty(TILE * WIDTH, np.float32), np.empty(TILE * WIDTH, np.float32)
    geometry, out = np.empty(TILE * OUT, np.float32), np.empty(TILE * OUT, np.float32)
    density, channels = np.empty(TILE, np.float32), np.empty(3 * TILE, np.float32)
    inputs, waiting = np.zeros(TILE * WIDTH, np.float32), 0
    waiting_ray, waiting_weight = np.empty(TILE, np.int64), np.empty(TILE, np.float64)
    found, keep = 0, len(owner) > 0
    while True:
        filled, coming = fill_round(walk, space, coming, last_ray, lanes, look, samples)
        if filled == 0:
            break
        encode_range(points, ROUND, samples.widths, 0, filled, table, scratch, encoded)
        for first in range(0, filled, TILE):
            count = min(TILE, filled - first)
            density_tile(encoded, first, weights, h, geometry, density)
            for i in range(count):
                lane = samples.lane[first + i]
                if not lanes.depth[lane] < deepest:
                    continue
                ray, start, end = lanes.ray[lane], samples.span[first + i, 0], samples.span[first + i, 1]
                length, own = np.float64(end) - np.float64(start), np.float64(density[i])
                weight = add_interval(sums, ray, np.float64(start), length, own, targets, quantiles)
                lanes.depth[lane] += own * length
                if keep:
                    owner[found] = ray
                    record[found, 0], record[found, 1], record[found, 2] = start, end, density[i]
                    counts[ray] += 1
                    found += 1
                if weight <= PART * negligible and unseen[ray] + weight <= negligible:
                    unseen[ray] += weight
                    continue
                for j in range(OUT):
                    inputs[waiting * WIDTH + j] = geometry[i * OUT + j]
                    inputs[waiting * WIDTH + OUT + j] = harmonics[ray, j]
                waiting_ray[waiting], waiting_weight[waiting] = ray, weight
                waiting += 1
                if waiting == TILE:
                    _add_colours(inputs, waiting, waiting_ray, waiting_weight, weights, x, h, out, channels, colours)
                    waiting = 0
        for lane in range(LANES):
            if lanes.ray[lane] >= 0 and (not lanes.depth[lane] < deepest or lanes.next[lane] >= intervals):
                lanes.ray[lane] = -1
    _add_colours(inputs, waiting, waiting_ray, waiting_weight, weights, x, h, out, channels, colours)
    return found


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _trace_all(
    walk: Any, space: Any, table: Any, weights: Any, deepest: Any, harmonics: Any, negligible: Any, targets: Any,
    borders: Any, sums: Any, quantiles: Any, colours: Any, unseen: Any, counts: Any, owner: Any, record: Any,
    found: Any,
) -> None:  # fmt: skip
    """Call `_trace` in parallel, with one thread for the rays from each border to the next."""
    for thread in numba.prange(len(borders) - 1):
        found[thread] = _trace(
            walk, space, table, weights, deepest, harmonics, negligible, targets, borders[thread],
            borders[thread + 1], sums, quantiles, colours, unseen, counts, owner[thread], record[thread],
        )  # fmt: skip


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _sort(borders: Any, offsets: Any, owner: Any, record: Any, found: Any, spans: Any) -> None:
    """Sort intervals by ray; along each ray they are already in order."""
    for thread in numba.prange(len(borders) - 1):
        place = offsets[borders[thread] : borders[thread + 1]].copy()
        for i in range(found[thread]):
            ray = owner[thread, i] - borders[thread]
            for j in range(3):
                spans[j, place[ray]] = record[thread, i, j]
            place[ray] += 1


def trace_rays(rays: Rays, along: March, grid: HashGrid, options: TraceOptions, *, background: Tensor) -> RaysSeen:
    """See `Backend.trace_rays`; float32 on the CPU."""
    fractions, negligible, keep_intervals = options
    threads, count, intervals = use_threads(), len(rays.origins), len(along.edges) - 2
    borders = np.arange(threads + 1) * count // threads
    # Room for all samples of all rays: the system allocates memory only when it is first written to.
    room = (threads, -(-count // threads) * intervals if keep_intervals else 0)
    owner, record = np.empty(room, np.int64), np.empty((*room, 3), np.float32)
    counts, found = np.zeros(count if keep_intervals else 0, np.int64), np.zeros(threads, np.int64)
    sums, quantiles, targets = new_sums(count, fractions)
    colours, unseen = np.zeros((count, 3)), np.zeros(count)
    harmonics = spherical_harmonics(rays.directions, grid.view_degree).contiguous().numpy()
    given = (*arrays_of(rays, along, grid, grid.layers), along.max_optical_depth, harmonics, negligible, targets)
    _trace_all(*(*given, borders, sums, quantiles, colours, unseen, counts, owner, record, found))
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    spans = torch.empty(3, int(offsets[-1]))
    if keep_intervals:
        _sort(borders, offsets, owner, record, found, spans.numpy())
    starts, ends, density = spans
    light, left = ray_termination_of(sums, quantiles, fractions), torch.from_numpy(np.exp(-sums[:, 0]))
    seen = torch.from_numpy(colours + UNSEEN * unseen[:, None]) + left[:, None] * background
    stopped = left <= math.exp(-along.max_optical_depth) * (1 + 1e-5)  # rounding must not hide a stop
    behind = torch.maximum(background, 1.0 - background).amax(-1)  # largest difference from the background's colour
    error = UNSEEN * torch.from_numpy(unseen) + torch.where(stopped, left * behind, 0.0)
    return RaysSeen(seen.float(), light, error.float(), Intervals(density, starts, ends, torch.from_numpy(offsets)))
