"""The samples of rays that light reaches: marching, encoding and density together, stopping where a ray is opaque.

Same operation as `reference.visible_samples`. A thread works on many rays at a time, each a few samples ahead, so that
encoding and network get full tiles although rays stop at different depths; when a ray ends, the next one takes its
lane. Except for those few samples, nothing behind a surface is computed.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
import torch

from nerfcli.kernels.interface import OUT, WIDTH, HashGrid, March, Rays, Samples
from nerfcli.kernels.numba_cpu.empty_space import WINDOW, chunks_near, empty_space_of
from nerfcli.kernels.numba_cpu.hash_grid import encode_range, new_scratch, table_of
from nerfcli.kernels.numba_cpu.marching import keep_largest
from nerfcli.kernels.numba_cpu.networks import TILE, density_range, flat_weights
from nerfcli.kernels.numba_cpu.rays import CHUNK, cut, look_ahead, ray_indices, walk_of
from nerfcli.kernels.numba_cpu.threads import use_threads

# Rays that a thread works on at a time, and samples that each of them looks ahead.
LANES = 256
AHEAD = 4
ROUND = LANES * AHEAD
# Room for the samples of each thread, 92 MB; if there are more, all are found again with room for every step of every
# ray. That would be up to 1.7 GB in each step, and trainings would keep the pages that any of them has touched.
USUAL_SAMPLES = 2**19


@numba.njit(inline="always")
def _stretch(walk: Any, ray: Any, t: Any) -> Any:
    """Return the factor that `contraction.cube_widths` applies to widths at distance t along a ray."""
    quarter, one, two = np.float32(0.25), np.float32(1), np.float32(2)
    if walk.contraction == 0:
        return np.float32(0.5)
    x = walk.origins[ray, 0] + walk.directions[ray, 0] * t
    y = walk.origins[ray, 1] + walk.directions[ray, 1] * t
    z = walk.origins[ray, 2] + walk.directions[ray, 2] * t
    norm = np.sqrt(max(x * x + y * y + z * z, one))
    return (two - one / norm) / norm * quarter


class Lanes(NamedTuple):
    """The rays that a thread works on, (LANES,) each.

    Args:
        ray: -1 for none.
        next: the interval that comes next.
        depth: the optical depth so far.
        near: the number of the window of chunks in which a ray is, and the bits of its `chunks_near`.
    """

    ray: Any
    next: Any
    depth: Any
    near: Any


class Round(NamedTuple):
    """Samples of a `fill_round`: lane (ROUND,), start and end (ROUND, 2), coordinates (3, ROUND), width (ROUND,)."""

    lane: Any
    span: Any
    points: Any
    widths: Any


@numba.njit(inline="always")
def new_round(walk: Any) -> Any:
    """Return lanes without rays, scratch space for looking ahead, and room for the samples of a `fill_round`."""
    lanes = Lanes(np.full(LANES, -1, np.int64), np.zeros(LANES, np.int64), np.zeros(LANES), np.zeros(LANES, np.int64))
    look = np.empty(3 * CHUNK, np.float32), np.empty(CHUNK, np.int32), np.empty(WINDOW, np.float32)
    widths = np.empty(ROUND if walk.cones.shape[0] > 0 else 0, np.float32)
    lane, span, points = np.empty(ROUND, np.int64), np.empty((ROUND, 2), np.float32), np.empty((3, ROUND), np.float32)
    return lanes, look, Round(lane, span, points, widths)


@numba.njit(nogil=True, error_model="numpy")
def fill_round(walk: Any, space: Any, coming: Any, last_ray: Any, lanes: Any, look: Any, samples: Any) -> Any:
    """Find the next samples of the rays in the lanes, up to AHEAD each; a lane without a ray takes the ray `coming`.

    Args:
        lanes, look, samples: of `new_round`; the samples are written to the last.

    Returns:
        number of samples found, and the ray that the next empty lane takes.
    """
    intervals = walk.edges.shape[0] - 2 - CHUNK
    places, cells, needed = look
    filled = 0
    for lane in range(LANES):
        taken = 0
        while taken == 0:
            if lanes.ray[lane] < 0:
                if coming == last_ray:
                    break
                lanes.ray[lane], lanes.next[lane], lanes.depth[lane], lanes.near[lane] = coming, 0, 0.0, -1
                coming += 1
            ray, k = lanes.ray[lane], lanes.next[lane]
            while k < intervals and taken == 0:
                chunk = k // CHUNK
                window = chunk // WINDOW
                if lanes.near[lane] >> WINDOW != window:
                    near = chunks_near(walk, space, ray, window * WINDOW, cells, needed)
                    lanes.near[lane] = window << WINDOW | near
                near = lanes.near[lane]
                while chunk // WINDOW == window and not near >> chunk % WINDOW & 1:
                    chunk += 1
                if chunk > k // CHUNK:
                    k = chunk * CHUNK
                    continue
                look_ahead(walk, ray, k, places, cells)
                past = min(CHUNK, intervals - k)
                for i in range(past):
                    if cells[i] >= 0 and walk.occupied[cells[i]]:
                        samples.lane[filled] = lane
                        samples.span[filled, 0] = cut(walk.edges, walk.jitter[ray], k + i)
                        samples.span[filled, 1] = cut(walk.edges, walk.jitter[ray], k + i + 1)
                        for axis in range(3):
                            samples.points[axis, filled] = places[axis * CHUNK + i]
                        if walk.cones.shape[0] > 0:
                            t = (samples.span[filled, 0] + samples.span[filled, 1]) * np.float32(0.5)
                            samples.widths[filled] = walk.cones[ray] * t * _stretch(walk, ray, t)
                        filled += 1
                        taken += 1
                        if taken == AHEAD:
                            past = i + 1
                            break
                k += past
            lanes.next[lane] = k
            if taken == 0:
                lanes.ray[lane] = -1
    return filled, coming


@numba.njit(nogil=True, error_model="numpy")
def _follow(
    walk: Any, space: Any, table: Any, weights: Any, deepest: Any, least: Any, coming: Any, last_ray: Any, counts: Any,
    owner: Any, record: Any, code: Any, left: Any,
) -> Any:  # fmt: skip
    """Write the samples of rays from `coming` up to `last_ray`, in the order in which they are found.

    A sample's ray goes to `owner`, its start, end, density and coordinates to `record`, its features to `code`. If it
    is left out for its weight, its coordinates and optical depth go to `left` instead. Returns the number of both, the
    first -1 if there is not enough room.
    """
    intervals = walk.edges.shape[0] - 2 - CHUNK
    lanes, look, samples = new_round(walk)
    points = samples.points.reshape(-1)
    encoded = np.empty((ROUND, WIDTH), np.float32)
    density = np.empty(ROUND, np.float32)
    scratch = new_scratch()
    x, h = np.empty(TILE * WIDTH, np.float32), np.empty(TILE * WIDTH, np.float32)
    geometry = np.empty(TILE * OUT, np.float32)
    found = missing = 0
    while True:
        filled, coming = fill_round(walk, space, coming, last_ray, lanes, look, samples)
        if filled == 0:
            return found, missing
        if max(found, missing) + filled > len(owner):
            return -1, missing
        encode_range(points, ROUND, samples.widths, 0, filled, table, scratch, encoded.reshape(-1))
        density_range(encoded, 0, filled, weights, x, h, geometry, density)
        for i in range(filled):
            lane = samples.lane[i]
            before = lanes.depth[lane]
            if not before < deepest:
                continue
            start, end = samples.span[i, 0], samples.span[i, 1]
            own = np.float64(density[i]) * np.float64(end - start)
            lanes.depth[lane] += own
            if not (own < least or own * np.exp(-before) < least):  # most faint samples need no exponential
                ray = lanes.ray[lane]
                counts[ray] += 1
                owner[found] = ray
                record[found, 0], record[found, 1], record[found, 2] = start, end, density[i]
                for axis in range(3):
                    record[found, 3 + axis] = samples.points[axis, i]
                for feature in range(WIDTH):
                    code[found, feature] = encoded[i, feature]
                found += 1
            else:
                for axis in range(3):
                    left[missing, axis] = samples.points[axis, i]
                left[missing, 3] = own
                missing += 1
        for lane in range(LANES):
            if lanes.ray[lane] >= 0 and (lanes.depth[lane] >= deepest or lanes.next[lane] >= intervals):
                lanes.ray[lane] = -1


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _visible(
    walk: Any, space: Any, table: Any, weights: Any, deepest: Any, least: Any, borders: Any, counts: Any, owner: Any,
    record: Any, code: Any, left: Any, found: Any, missing: Any,
) -> None:  # fmt: skip
    """Call `_follow` in parallel, with one thread for the rays from each border to the next."""
    counts[:] = 0
    for thread in numba.prange(len(borders) - 1):
        found[thread], missing[thread] = _follow(
            walk, space, table, weights, deepest, least, borders[thread], borders[thread + 1], counts, owner[thread],
            record[thread], code[thread], left[thread],
        )  # fmt: skip


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _sort(
    borders: Any, offsets: Any, owner: Any, record: Any, code: Any, found: Any, spans: Any, coordinates: Any,
    encoded: Any,
) -> None:  # fmt: skip
    """Sort the samples of `_visible` by ray; along each ray they are already in order."""
    for thread in numba.prange(len(borders) - 1):
        place = offsets[borders[thread] : borders[thread + 1]].copy()
        for i in range(found[thread]):
            ray = owner[thread, i] - borders[thread]
            to = place[ray]
            place[ray] += 1
            for j in range(3):
                spans[j, to] = record[thread, i, j]
                coordinates[to, j] = record[thread, i, 3 + j]
            for feature in range(WIDTH):
                encoded[to, feature] = code[thread, i, feature]


def arrays_of(rays: Rays, along: March, grid: HashGrid, layers: tuple[torch.Tensor, ...]) -> tuple[Any, ...]:
    """Return rays, empty space, table and layers as `_follow` takes them."""
    walk = walk_of(rays, along, has_width=grid.antialias)
    table = table_of(grid.table.detach().contiguous(), grid.resolutions)
    return walk, empty_space_of(along, walk.edges), table, flat_weights(layers)


def visible_samples(rays: Rays, along: March, grid: HashGrid, cell_depths: torch.Tensor | None = None) -> Samples:
    """See `reference.visible_samples`; float32 on the CPU."""
    threads, count, intervals = use_threads(), len(rays.origins), len(along.edges) - 2
    given = (*arrays_of(rays, along, grid, grid.layers[:2]), along.max_optical_depth, along.least_weight)
    borders = np.arange(threads + 1) * count // threads
    counts, (found, missing) = np.empty(count, np.int64), np.empty((2, threads), np.int64)
    most = -(-count // threads) * intervals
    for samples in (min(USUAL_SAMPLES, most), most):
        room = (threads, samples)
        owner, record = np.empty(room, np.int64), np.empty((*room, 6), np.float32)
        code, left = np.empty((*room, WIDTH), np.float32), np.empty((*room, 4), np.float32)
        _visible(*(*given, borders, counts, owner, record, code, left, found, missing))
        if (found >= 0).all():
            break
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    samples = int(offsets[-1])
    if samples == 0 and along.least_weight > 0.0:  # all are faint
        return visible_samples(rays, along._replace(least_weight=0.0), grid, cell_depths)
    spans, coordinates, encoded = torch.empty(3, samples), torch.empty(samples, 3), torch.empty(samples, WIDTH)
    _sort(borders, offsets, owner, record, code, found, spans.numpy(), coordinates.numpy(), encoded.numpy())
    starts, ends, density = spans
    if cell_depths is not None:
        keep_largest(cell_depths, coordinates, density * (ends - starts))
        for faint, number in zip(torch.from_numpy(left), missing.tolist(), strict=True):
            keep_largest(cell_depths, faint[:number, :3], faint[:number, 3])
    packed = torch.from_numpy(offsets)
    return Samples(starts, ends, density, encoded, coordinates, packed, ray_indices(packed))
