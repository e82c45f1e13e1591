"""The order of Gaussian splats in a picture, and which of them each tile of 16 x 16 pixels has to look at."""

from typing import Any

import numba
import numpy as np

from nerfcli.kernels.numba_cpu.splat_projection import FOOTPRINT

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

    Args:
        footprints, boxes: see `splat_projection.project`.

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
