"""Compositing of Gaussian splats on CPU threads, front to back, and its gradient: see `reference.composite_splats`.

The Gaussians are sorted by distance, and each tile of 16 x 16 pixels looks only at those that reach into it.

A tile's pixels are one flat array, a row of 16 columns a vector: LLVM vectorises the loops over columns because their
arrays start at constant offsets of one buffer, and because their bodies have no branch. Tiles are independent; sums of
the gradient are kept per tile and Gaussian and added in the order of the tiles, so every number of threads gives the
same bits.
"""

from typing import Any

import numba
import numpy as np

from nerfcli.kernels.interface import LARGEST_ALPHA, SMALLEST_ALPHA
from nerfcli.kernels.numba_cpu.exponential import power_of_two
from nerfcli.kernels.numba_cpu.splat_projection import FOOTPRINT, SUMS

# Side of a tile in pixels: a row of a tile is one vector, see `vector.LANES`.
TILE = 16
# Bits of a key that one pass of the radix sort looks at.
_DIGIT = 11


@numba.njit(cache=True, nogil=True)
def _by_distance(footprints: Any, boxes: Any) -> Any:
    """Return the Gaussians that are seen, nearest first; equal distances keep their order.

    Positive floats are ordered as their bits are, so a radix sort of the bits is exact.
    """
    seen = np.empty(len(boxes), np.int32)
    count = 0
    for n in range(len(boxes)):
        if boxes[n, 1] > boxes[n, 0]:
            seen[count] = n
            count += 1
    order, other = seen[:count].copy(), np.empty(count, np.int32)
    distances = np.empty(count, np.float32)
    for i in range(count):
        distances[i] = footprints[order[i], 9]
    keys, other_keys = distances.view(np.int32), np.empty(count, np.int32)
    for digit in range(3):
        shift = digit * _DIGIT
        places = np.zeros(2**_DIGIT + 1, np.int64)
        for i in range(count):
            places[((keys[i] >> shift) & (2**_DIGIT - 1)) + 1] += 1
        for i in range(2**_DIGIT):
            places[i + 1] += places[i]
        for i in range(count):
            place = (keys[i] >> shift) & (2**_DIGIT - 1)
            other_keys[places[place]], other[places[place]] = keys[i], order[i]
            places[place] += 1
        keys, other_keys, order, other = other_keys, keys, other, order
    return order


@numba.njit(cache=True, nogil=True)
def into_tiles(footprints: Any, boxes: Any, width: Any, height: Any) -> Any:
    """Sort the Gaussians that are seen, and list those of each tile.

    Returns:
        order (V,) int32 of the Gaussians that are seen, nearest first; their footprints (V, FOOTPRINT) and boxes
        (V, 4); starts (tiles + 1,) of each tile in the entries; entries (E,) int32, places in the order, nearest first;
        slots (E,) int32, the place of each entry among those of its Gaussian, and first_slots (V + 1,).
    """
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    order = _by_distance(footprints, boxes)
    count = len(order)
    ordered, reached = np.empty((count, FOOTPRINT), np.float32), np.empty((count, 4), np.int32)
    starts, first_slots = np.zeros(across * down + 1, np.int64), np.zeros(count + 1, np.int64)
    for i in range(count):
        ordered[i], reached[i] = footprints[order[i]], boxes[order[i]]
        left, right = reached[i, 0] // TILE, (reached[i, 1] - 1) // TILE + 1
        top, bottom = reached[i, 2] // TILE, (reached[i, 3] - 1) // TILE + 1
        first_slots[i + 1] = first_slots[i] + (right - left) * (bottom - top)
        for y in range(top, bottom):
            for x in range(left, right):
                starts[y * across + x + 1] += 1
    for tile in range(across * down):
        starts[tile + 1] += starts[tile]
    entries, slots = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    places = starts.copy()
    for i in range(count):
        slot = first_slots[i]
        for y in range(reached[i, 2] // TILE, (reached[i, 3] - 1) // TILE + 1):
            for x in range(reached[i, 0] // TILE, (reached[i, 1] - 1) // TILE + 1):
                place = places[y * across + x]
                entries[place], slots[place] = i, slot
                places[y * across + x] += 1
                slot += 1
    return order, ordered, reached, starts, entries, slots, first_slots


AREA = TILE * TILE
# Transmittance of a row of a tile below which what is behind is left out.
OPAQUE = 1e-4
# Number of Gaussians after which a tile looks for rows that are opaque.
_LOOK = 16
_HALF, _ZERO, _ONE = np.float32(0.5), np.float32(0.0), np.float32(1.0)
_LARGEST, _SMALLEST, _OPAQUE = np.float32(LARGEST_ALPHA), np.float32(SMALLEST_ALPHA), np.float32(OPAQUE)
_LOG2_SMALLEST = np.float32(np.log2(SMALLEST_ALPHA))
# Multiply and add may be fused; nothing else is relaxed.
_FUSED = {"contract"}


@numba.njit(cache=True, fastmath=_FUSED, error_model="numpy", inline="always")
def _row_is_reached(footprint: Any, dy: Any, first: Any) -> bool:
    """Return whether the ellipse of alpha >= 1/255 meets the row of a tile whose first pixel has dx = `first`."""
    # a dx^2 + b dx + c >= 0 inside the ellipse, and a < 0.
    a, b = footprint[2], footprint[3] * dy
    c = footprint[4] * dy * dy + footprint[5] - _LOG2_SMALLEST
    inside = b * b - np.float32(4.0) * a * c
    if not inside >= _ZERO:
        return False
    root, twice = np.sqrt(inside), np.float32(2.0) * a
    return -b - root <= twice * first and -b + root >= twice * (first + np.float32(TILE - 1))


@numba.njit(cache=True, inline="always")
def _look_for_light(transmittance: Any, left: Any, rows: Any) -> Any:
    """Write the largest transmittance of each row of a tile; return whether any is above `OPAQUE`."""
    alive = False
    for y in range(rows):
        most = _ZERO
        for x in range(TILE):
            most = max(most, transmittance[y * TILE + x])
        left[y] = most
        alive = alive or most > _OPAQUE
    return alive


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=_FUSED, error_model="numpy")
def forward(
    starts: Any, entries: Any, footprints: Any, boxes: Any, background: Any, image: Any, transmittance: Any, ends: Any,
    threads: Any,
) -> None:  # fmt: skip
    """Composite every tile.

    Args:
        starts, entries, footprints, boxes: from `into_tiles`.
        background: (3,) float32.
        image, transmittance: (H, W, 3) and (H, W) float32, written.
        ends: (tiles,) int64, written: the first entry of each tile that was not looked at because the tile is opaque.
    """
    height, width = transmittance.shape
    across, tiles = (width + TILE - 1) // TILE, len(ends)
    for thread in numba.prange(threads):
        # Transmittance, red, green and blue of the tile's pixels.
        state, left = np.empty(4 * AREA, np.float32), np.empty(TILE, np.float32)
        for tile in range(thread, tiles, threads):
            x0, y0 = (tile % across) * TILE, (tile // across) * TILE
            x1, y1 = min(x0 + TILE, width), min(y0 + TILE, height)
            for i in range(AREA):
                state[i] = _ONE
            for i in range(AREA, 4 * AREA):
                state[i] = _ZERO
            left[:] = _ONE
            entry = starts[tile]
            while entry < starts[tile + 1]:
                if (entry - starts[tile]) % _LOOK == _LOOK - 1 and not _look_for_light(state, left, y1 - y0):
                    break
                i = entries[entry]
                entry += 1
                f = footprints[i]
                u, v, red, green, blue = f[0], f[1], f[6], f[7], f[8]
                first = np.float32(x0) + _HALF - u
                for y in range(max(boxes[i, 2], y0), min(boxes[i, 3], y1)):
                    dy = np.float32(y) + _HALF - v
                    if left[y - y0] <= _OPAQUE or not _row_is_reached(f, dy, first):
                        continue
                    a, b, c = f[2], f[3] * dy, f[4] * dy * dy + f[5]
                    at = np.uint64((y - y0) * TILE)
                    for x in range(np.uint64(TILE)):
                        dx = first + np.float32(np.int32(x))
                        alpha = power_of_two((a * dx + b) * dx + c)
                        alpha = _LARGEST if alpha > _LARGEST else alpha
                        t = state[at + x]
                        weight = t * (alpha if alpha >= _SMALLEST else _ZERO)
                        state[at + x] = t - weight
                        state[at + x + np.uint64(AREA)] += weight * red
                        state[at + x + np.uint64(2 * AREA)] += weight * green
                        state[at + x + np.uint64(3 * AREA)] += weight * blue
            ends[tile] = entry
            for y in range(y0, y1):
                for x in range(x0, x1):
                    at_ = (y - y0) * TILE + x - x0
                    t = state[at_]
                    transmittance[y, x] = t
                    for c_ in range(3):
                        image[y, x, c_] = state[at_ + (1 + c_) * AREA] + t * background[c_]


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=_FUSED, error_model="numpy")
def backward(
    starts: Any, ends: Any, entries: Any, slots: Any, footprints: Any, boxes: Any, image: Any, transmittance: Any,
    by_image: Any, by_transmittance: Any, sums: Any, threads: Any,
) -> None:  # fmt: skip
    """Write the sums of the gradient of each entry.

    Front to back, with G = d loss / d colour . colour of the pixel, + T d loss / d T, and S the part of d loss / d
    colour . colour up to and including this Gaussian, so that nothing is divided by a transmittance:

        alpha d loss / d alpha = weight (d loss / d colour . c) - (G - S) alpha / (1 - alpha)

    Args:
        image, transmittance: as `forward` wrote them.
        by_image, by_transmittance: (H, W, 3) and (H, W) float32, d loss / d image and d loss / d transmittance.
        sums: (E, SUMS) float32, written at the slots of the entries.
    """
    height, width = transmittance.shape
    across, tiles = (width + TILE - 1) // TILE, len(ends)
    for thread in numba.prange(threads):
        # Transmittance, G - S, d loss / d red, green and blue of the tile's pixels; then columns of six sums.
        state, left = np.empty(5 * AREA + 6 * TILE, np.float32), np.empty(TILE, np.float32)
        for tile in range(thread, tiles, threads):
            x0, y0 = (tile % across) * TILE, (tile // across) * TILE
            x1, y1 = min(x0 + TILE, width), min(y0 + TILE, height)
            for i in range(AREA):
                state[i] = _ONE
            for i in range(AREA, 5 * AREA):
                state[i] = _ZERO
            left[:] = _ONE
            for y in range(y0, y1):
                for x in range(x0, x1):
                    at_ = (y - y0) * TILE + x - x0
                    rest = by_transmittance[y, x] * transmittance[y, x]
                    for c_ in range(3):
                        state[at_ + (2 + c_) * AREA] = by_image[y, x, c_]
                        rest += by_image[y, x, c_] * image[y, x, c_]
                    state[at_ + AREA] = rest
            for entry in range(starts[tile], ends[tile]):
                if (entry - starts[tile]) % _LOOK == _LOOK - 1:
                    _look_for_light(state, left, y1 - y0)
                i = entries[entry]
                f = footprints[i]
                u, v, red, green, blue = f[0], f[1], f[6], f[7], f[8]
                first = np.float32(x0) + _HALF - u
                for k in range(5 * AREA, 5 * AREA + 6 * TILE):
                    state[k] = _ZERO
                for y in range(max(boxes[i, 2], y0), min(boxes[i, 3], y1)):
                    dy = np.float32(y) + _HALF - v
                    if left[y - y0] <= _OPAQUE or not _row_is_reached(f, dy, first):
                        continue
                    a, b, c = f[2], f[3] * dy, f[4] * dy * dy + f[5]
                    at = np.uint64((y - y0) * TILE)
                    for x in range(np.uint64(TILE)):
                        dx = first + np.float32(np.int32(x))
                        full = power_of_two((a * dx + b) * dx + c)
                        alpha = _LARGEST if full > _LARGEST else full
                        alpha = alpha if alpha >= _SMALLEST else _ZERO
                        t = state[at + x]
                        weight = alpha * t
                        by_red = state[at + x + np.uint64(2 * AREA)]
                        by_green = state[at + x + np.uint64(3 * AREA)]
                        by_blue = state[at + x + np.uint64(4 * AREA)]
                        along = weight * (by_red * red + by_green * green + by_blue * blue)
                        rest_ = state[at + x + np.uint64(AREA)] - along
                        q = along - rest_ * alpha / (_ONE - alpha)
                        q = q if full <= _LARGEST else _ZERO
                        state[at + x] = t - weight
                        state[at + x + np.uint64(AREA)] = rest_
                        state[x + np.uint64(5 * AREA)] += q
                        state[x + np.uint64(5 * AREA + TILE)] += q * dy
                        state[x + np.uint64(5 * AREA + 2 * TILE)] += q * (dy * dy)
                        state[x + np.uint64(5 * AREA + 3 * TILE)] += weight * by_red
                        state[x + np.uint64(5 * AREA + 4 * TILE)] += weight * by_green
                        state[x + np.uint64(5 * AREA + 5 * TILE)] += weight * by_blue
                _sum_columns(state, first, sums[slots[entry]])
            for entry in range(ends[tile], starts[tile + 1]):
                for k in range(SUMS):
                    sums[slots[entry], k] = _ZERO


@numba.njit(cache=True, fastmath={"contract", "reassoc"}, inline="always")
def _sum_columns(state: Any, first: Any, out: Any) -> None:
    """Write the `SUMS` of a Gaussian in a tile from those of the tile's columns."""
    s0, s1, s2, s3, s4 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    s5, s6, s7, s8 = _ZERO, _ZERO, _ZERO, _ZERO
    for x in range(TILE):
        at, dx = 5 * AREA + x, first + np.float32(x)
        q, by_y = state[at], state[at + TILE]
        s0 += q
        s1 += q * dx
        s2 += by_y
        s3 += q * dx * dx
        s4 += by_y * dx
        s5 += state[at + 2 * TILE]
        s6 += state[at + 3 * TILE]
        s7 += state[at + 4 * TILE]
        s8 += state[at + 5 * TILE]
    out[0], out[1], out[2], out[3], out[4] = s0, s1, s2, s3, s4
    out[5], out[6], out[7], out[8] = s5, s6, s7, s8


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=_FUSED, error_model="numpy")
def depths(
    starts: Any, entries: Any, footprints: Any, boxes: Any, fractions: Any, height: Any, width: Any, out: Any,
    threads: Any,
) -> None:  # fmt: skip
    """Write where the light of each pixel ends, each Gaussian at its own distance.

    Args:
        fractions: (F,) of light.
        out: (H * W, 5 + F) float32, written: opacity, transmittance, mean, standard deviation, distance of the heaviest
            Gaussian, and the distances by which the fractions have ended; NaN where undefined.
    """
    across, tiles = (width + TILE - 1) // TILE, len(starts) - 1
    for thread in numba.prange(threads):
        for tile in range(thread, tiles, threads):
            x0, y0 = (tile % across) * TILE, (tile // across) * TILE
            for y in range(y0, min(y0 + TILE, height)):
                for x in range(x0, min(x0 + TILE, width)):
                    row = out[y * width + x]
                    for k in range(len(fractions)):
                        row[5 + k] = np.nan
                    t, total, square, peak, largest, origin = 1.0, 0.0, 0.0, np.nan, 0.0, 0.0
                    for entry in range(starts[tile], starts[tile + 1]):
                        i = entries[entry]
                        f = footprints[i]
                        if not (boxes[i, 2] <= y < boxes[i, 3] and boxes[i, 0] <= x < boxes[i, 1]):
                            continue
                        dx, dy = np.float32(x) + _HALF - f[0], np.float32(y) + _HALF - f[1]
                        alpha = power_of_two((f[2] * dx + f[3] * dy) * dx + f[4] * dy * dy + f[5])
                        if not alpha >= _SMALLEST:
                            continue
                        weight = t * min(alpha, _LARGEST)
                        if t == 1.0:
                            origin = f[9]  # sums are relative to the first distance, so that they do not cancel
                        away = f[9] - origin
                        total += weight * away
                        square += weight * away * away
                        if weight > largest:
                            peak, largest = f[9], weight
                        t -= weight
                        for k in range(len(fractions)):
                            if t <= 1.0 - fractions[k] and np.isnan(row[5 + k]):
                                row[5 + k] = f[9]
                        if t <= OPAQUE:
                            break
                    row[0], row[1], row[4] = 1.0 - t, t, peak
                    row[2], row[3] = np.nan, np.nan
                    if t < 1.0:
                        mean = total / (1.0 - t)
                        row[2] = origin + mean
                        row[3] = np.sqrt(max(0.0, square / (1.0 - t) - mean * mean))
