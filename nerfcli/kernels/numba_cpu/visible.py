"""The samples of rays that light reaches: marching, encoding and density together, stopping where a ray is opaque.

Same operation as `reference.visible_samples`. A thread works on many rays at a time, each a few samples ahead, so that
encoding and network get full tiles although rays stop at different depths; when a ray ends, the next one takes its
lane. Except for those few samples, nothing behind a surface is computed.
"""

from typing import Any

import numba
import numpy as np
import torch

from nerfcli.kernels.contraction import CONTRACTIONS
from nerfcli.kernels.interface import OUT, WIDTH, HashGrid, March, Rays, Samples
from nerfcli.kernels.numba_cpu.empty_space import WINDOW, blocks_of, chunks_near, chunks_of
from nerfcli.kernels.numba_cpu.hash_grid import encode_range, new_scratch
from nerfcli.kernels.numba_cpu.marching import keep_largest
from nerfcli.kernels.numba_cpu.networks import TILE, density_range, flat_weights
from nerfcli.kernels.numba_cpu.rays import CHUNK, cut, look_ahead, padded
from nerfcli.kernels.numba_cpu.threads import use_threads

# Rays that a thread works on at a time, and samples that each of them looks ahead.
LANES = 256
AHEAD = 4
ROUND = LANES * AHEAD
# Room for the samples of each thread, 92 MB; if there are more, all are found again with room for every step of every
# ray. That would be up to 1.7 GB in each step, and trainings would keep the pages that any of them has touched.
USUAL_SAMPLES = 2**19


@numba.njit(inline="always")
def _stretch(origins: Any, directions: Any, ray: Any, t: Any, contraction: Any) -> Any:
    """Return the factor that `contraction.cube_widths` applies to widths at distance t along a ray."""
    quarter, one, two = np.float32(0.25), np.float32(1), np.float32(2)
    if contraction == 0:
        return np.float32(0.5)
    x, y = origins[ray, 0] + directions[ray, 0] * t, origins[ray, 1] + directions[ray, 1] * t
    z = origins[ray, 2] + directions[ray, 2] * t
    norm = np.sqrt(max(x * x + y * y + z * z, one))
    return (two - one / norm) / norm * quarter


@numba.njit(inline="always")
def new_round() -> Any:
    """Return lanes without rays, scratch space for looking ahead, and room for the samples of a `fill_round`."""
    lanes = np.full(LANES, -1, np.int64), np.zeros(LANES, np.int64), np.zeros(LANES), np.zeros(LANES, np.int64)
    look = np.empty(3 * CHUNK, np.float32), np.empty(CHUNK, np.int32), np.empty(WINDOW, np.float32)
    samples = np.empty(ROUND, np.int64), np.empty((ROUND, 2), np.float32), np.empty((3, ROUND), np.float32)
    return lanes, look, samples


@numba.njit(nogil=True, error_model="numpy")
def fill_round(
    origins: Any, directions: Any, edges: Any, chunks: Any, jitter: Any, occupied: Any, blocks: Any, side: Any,
    contraction: Any, cones: Any, coming: Any, last_ray: Any, lane_ray: Any, lane_next: Any, lane_depth: Any,
    lane_near: Any, places: Any, cells: Any, needed: Any, sample_lane: Any, sample_span: Any, points: Any, widths: Any,
) -> Any:  # fmt: skip
    """Find the next samples of the rays in the lanes, up to AHEAD each; a lane without a ray takes the ray `coming`.

    `lane_near` holds the number of the window of chunks in which a lane is, and the bits of its `chunks_near`.
    A sample's lane, start and end, coordinates and width are written to the last four arrays.

    Returns:
        number of samples found, and the ray that the next empty lane takes.
    """
    intervals = edges.shape[0] - 2 - CHUNK
    flat_blocks, width = blocks.reshape(-1), np.float32(-(-side // blocks.shape[0]) / side)
    filled = 0
    for lane in range(LANES):
        taken = 0
        while taken == 0:
            if lane_ray[lane] < 0:
                if coming == last_ray:
                    break
                lane_ray[lane], lane_next[lane], lane_depth[lane], lane_near[lane] = coming, 0, 0.0, -1
                coming += 1
            ray, k = lane_ray[lane], lane_next[lane]
            while k < intervals and taken == 0:
                chunk = k // CHUNK
                window = chunk // WINDOW
                if lane_near[lane] >> WINDOW != window:
                    near = chunks_near(
                        origins, directions, ray, chunks, window * WINDOW, flat_blocks, blocks.shape[0], width,
                        contraction, cells, needed,
                    )  # fmt: skip
                    lane_near[lane] = window << WINDOW | near
                near = lane_near[lane]
                while chunk // WINDOW == window and not near >> chunk % WINDOW & 1:
                    chunk += 1
                if chunk > k // CHUNK:
                    k = chunk * CHUNK
                    continue
                look_ahead(origins, directions, edges, jitter, ray, k, side, contraction, places, cells)
                past = min(CHUNK, intervals - k)
                for i in range(past):
                    if cells[i] >= 0 and occupied[cells[i]]:
                        sample_lane[filled] = lane
                        sample_span[filled, 0] = cut(edges, jitter[ray], k + i)
                        sample_span[filled, 1] = cut(edges, jitter[ray], k + i + 1)
                        for axis in range(3):
                            points[axis, filled] = places[axis * CHUNK + i]
                        if cones.shape[0] > 0:
                            t = (sample_span[filled, 0] + sample_span[filled, 1]) * np.float32(0.5)
                            widths[filled] = cones[ray] * t * _stretch(origins, directions, ray, t, contraction)
                        filled += 1
                        taken += 1
                        if taken == AHEAD:
                            past = i + 1
                            break
                k += past
            lane_next[lane] = k
            if taken == 0:
                lane_ray[lane] = -1
    return filled, coming


@numba.njit(nogil=True, error_model="numpy")
def _follow(
    origins: Any, directions: Any, edges: Any, chunks: Any, jitter: Any, occupied: Any, blocks: Any, side: Any,
    contraction: Any, flat: Any, rows: Any, resolutions: Any, weights: Any, deepest: Any, least: Any, cones: Any,
    coming: Any, last_ray: Any, counts: Any, owner: Any, record: Any, code: Any, left: Any,
) -> Any:  # fmt: skip
    """Write the samples of rays from `coming` up to `last_ray`, in the order in which they are found.

    A sample's ray goes to `owner`, its start, end, density and coordinates to `record`, its features to `code`. If it
    is left out for its weight, its coordinates and optical depth go to `left` instead. Returns the number of both, the
    first -1 if there is not enough room.
    """
    intervals = edges.shape[0] - 2 - CHUNK
    (lane_ray, lane_next, lane_depth, lane_near), (places, cells, needed), (sample_lane, sample_span, points) = (
        new_round()
    )
    widths = np.empty(ROUND if cones.shape[0] > 0 else 0, np.float32)
    encoded = np.empty((ROUND, WIDTH), np.float32)
    density = np.empty(ROUND, np.float32)
    scratch = new_scratch()
    x, h = np.empty(TILE * WIDTH, np.float32), np.empty(TILE * WIDTH, np.float32)
    geometry = np.empty(TILE * OUT, np.float32)
    found = missing = 0
    while True:
        filled, coming = fill_round(
            origins, directions, edges, chunks, jitter, occupied, blocks, side, contraction, cones, coming, last_ray,
            lane_ray, lane_next, lane_depth, lane_near, places, cells, needed, sample_lane, sample_span, points, widths,
        )  # fmt: skip
        if filled == 0:
            return found, missing
        if max(found, missing) + filled > len(owner):
            return -1, missing
        encode_range(
            points.reshape(-1), ROUND, widths, 0, filled, flat, rows, resolutions, scratch, encoded.reshape(-1)
        )
        density_range(encoded, 0, filled, weights, x, h, geometry, density)
        for i in range(filled):
            lane = sample_lane[i]
            before = lane_depth[lane]
            if not before < deepest:
                continue
            own = np.float64(density[i]) * np.float64(sample_span[i, 1] - sample_span[i, 0])
            lane_depth[lane] += own
            if not (own < least or own * np.exp(-before) < least):  # most faint samples need no exponential
                ray = lane_ray[lane]
                counts[ray] += 1
                owner[found] = ray
                record[found, 0], record[found, 1], record[found, 2] = sample_span[i, 0], sample_span[i, 1], density[i]
                for axis in range(3):
                    record[found, 3 + axis] = points[axis, i]
                for feature in range(WIDTH):
                    code[found, feature] = encoded[i, feature]
                found += 1
            else:
                for axis in range(3):
                    left[missing, axis] = points[axis, i]
                left[missing, 3] = own
                missing += 1
        for lane in range(LANES):
            if lane_ray[lane] >= 0 and (lane_depth[lane] >= deepest or lane_next[lane] >= intervals):
                lane_ray[lane] = -1


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _visible(
    origins: Any, directions: Any, edges: Any, chunks: Any, jitter: Any, occupied: Any, blocks: Any, side: Any,
    contraction: Any, flat: Any, rows: Any, resolutions: Any, weights: Any, deepest: Any, least: Any, cones: Any,
    borders: Any, counts: Any, owner: Any, record: Any, code: Any, left: Any, found: Any, missing: Any,
) -> None:  # fmt: skip
    """Call `_follow` in parallel, with one thread for the rays from each border to the next."""
    counts[:] = 0
    for thread in numba.prange(len(borders) - 1):
        found[thread], missing[thread] = _follow(
            origins, directions, edges, chunks, jitter, occupied, blocks, side, contraction, flat, rows,
            resolutions, weights, deepest, least, cones, borders[thread], borders[thread + 1], counts, owner[thread],
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


def flat_arguments(rays: Rays, along: March, grid: HashGrid, layers: tuple[torch.Tensor, ...]) -> tuple[Any, ...]:
    """Return rays, occupied cells, table and layers as the arrays that `_follow` takes, up to `deepest`."""
    edges = padded(along.edges)
    return (
        rays.origins.contiguous().numpy(), rays.directions.contiguous().numpy(), edges, chunks_of(edges),
        rays.jitter.numpy(), along.occupied.contiguous().view(-1).numpy(), blocks_of(along),
        along.occupied.shape[0], CONTRACTIONS.index(along.contraction),
        grid.table.detach().contiguous().view(-1).numpy(), grid.table.shape[1],
        np.array(grid.resolutions, dtype=np.int32), flat_weights(layers), along.max_optical_depth,
    )  # fmt: skip


def visible_samples(rays: Rays, along: March, grid: HashGrid, cell_depths: torch.Tensor | None = None) -> Samples:
    """See `reference.visible_samples`; float32 on the CPU."""
    threads, count, intervals = use_threads(), len(rays.origins), len(along.edges) - 2
    cones = rays.cones if grid.antialias and rays.cones is not None else rays.origins.new_empty(0)
    borders = np.arange(threads + 1) * count // threads
    counts, (found, missing) = np.empty(count, np.int64), np.empty((2, threads), np.int64)
    most = -(-count // threads) * intervals
    for samples in (min(USUAL_SAMPLES, most), most):
        room = (threads, samples)
        owner, record = np.empty(room, np.int64), np.empty((*room, 6), np.float32)
        code, left = np.empty((*room, WIDTH), np.float32), np.empty((*room, 4), np.float32)
        given = (*flat_arguments(rays, along, grid, grid.layers[:2]), along.least_weight, cones.contiguous().numpy())
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
    return Samples(starts, ends, density, encoded, coordinates, torch.from_numpy(offsets))
