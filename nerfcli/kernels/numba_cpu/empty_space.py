"""Chunks of steps along rays that meet no occupied cell, found by how far blocks of cells are from occupied ones."""

from typing import Any, NamedTuple

import numba
import numpy as np

from nerfcli.kernels.interface import March
from nerfcli.kernels.numba_cpu.rays import CHUNK, cube

# Chunks that are examined together.
WINDOW = 16
# Blocks of cells per axis of `_nearby_blocks` at most, and the distance at which it stops counting.
_MOST_BLOCKS, _FARTHEST = 64, 3
# Rounding of positions and distances in float32 must not skip a cell.
_ROUNDING = np.float32(1e-6)


@numba.njit(nogil=True, error_model="numpy")
def _occupied_blocks(occupied: Any) -> Any:
    """Return which blocks have an occupied cell, 1 or 0, with a border of zeros around them."""
    side = occupied.shape[0]
    width = -(-side // _MOST_BLOCKS)
    count = -(-side // width)
    here, line = np.zeros((count + 2, count + 2, count + 2), np.uint8), np.zeros(count * width, np.uint8)
    for z in range(count):
        for y in range(count):
            line[:] = 0
            for k in range(z * width, min((z + 1) * width, side)):
                for j in range(y * width, min((y + 1) * width, side)):
                    for i in range(side):
                        line[i] = np.uint8(line[i] | occupied[k, j, i])
            for i in range(width):
                row = line[i::width]
                for x in range(count):
                    here[z + 1, y + 1, x + 1] = np.uint8(here[z + 1, y + 1, x + 1] | row[x])
    return here


@numba.njit(nogil=True, error_model="numpy")
def _count_farther(here: Any, distance: Any) -> Any:
    """Mark also all blocks that touch marked ones, and add 1 to the distance of those that still are not marked."""
    count = distance.shape[0]
    near, line = np.zeros_like(here), np.empty(count + 2, np.uint8)
    for z in range(count):
        for y in range(count):
            line[:] = 0
            for k in range(3):
                for j in range(3):
                    for x in range(count + 2):
                        line[x] = np.uint8(line[x] | here[z + k, y + j, x])
            for x in range(count):
                found = np.uint8(line[x] | line[x + 1] | line[x + 2])
                near[z + 1, y + 1, x + 1] = found
                distance[z, y, x] = np.uint8(distance[z, y, x] + np.uint8(1 - found))
    return near


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _nearby_blocks(occupied: Any) -> Any:
    """Return the distance from each block to the nearest that has an occupied cell, up to `_FARTHEST`.

    Less exact than `kernels.distances_to_occupied`, and fast enough for every step of a training.
    """
    near = _occupied_blocks(occupied)
    distance = (1 - near[1:-1, 1:-1, 1:-1]).astype(np.uint8)
    for _ in range(1, _FARTHEST):
        near = _count_farther(near, distance)
    return distance


def _blocks_of(along: March) -> np.ndarray:
    """Return the distances to occupied cells of a march, (B, B, B), made of its cells if it has none."""
    if along.distances is not None:
        return along.distances.numpy()
    return _nearby_blocks(along.occupied.contiguous().numpy().view(np.uint8))


class EmptySpace(NamedTuple):
    """Chunks of steps and blocks of cells, as `chunks_near` takes them.

    Args:
        chunks: the middle of each chunk and half of its length, for any jitter, (2, M), M a multiple of WINDOW.
        blocks: distances to occupied cells, (B^3,).
        side: B.
        width: of a block in the unit cube.
    """

    chunks: Any
    blocks: Any
    side: Any
    width: Any


def empty_space_of(along: March, edges: np.ndarray) -> EmptySpace:
    """Return the empty space of a march whose edges are those of a `Walk`."""
    blocks, cells = _blocks_of(along), along.occupied.shape[0]
    width = np.float32(-(-cells // len(blocks)) / cells)
    return EmptySpace(_chunks_of(edges), blocks.reshape(-1), np.float32(len(blocks)), width)


def _chunks_of(edges: np.ndarray) -> np.ndarray:
    """Return `EmptySpace.chunks` for the edges of a `Walk`, which are padded."""
    chunks = -(-len(edges) // CHUNK)
    first = np.minimum(np.arange(-(-chunks // WINDOW) * WINDOW) * CHUNK, len(edges) - 1)
    begin, end = edges[first], edges[np.minimum(first + CHUNK + 1, len(edges) - 1)]
    return np.stack([(begin + end) / 2, (end - begin) / 2])


@numba.njit(inline="always")
def _place(along: Any, width: Any, count: Any) -> Any:
    """Return the block of a coordinate along one axis, and the distance to its nearer end in blocks; NaN becomes 0."""
    scaled = min(max(np.float32(0), along), np.float32(1)) / width
    block = np.floor(min(scaled, count - np.float32(1)))
    inside = scaled - block
    return block, min(inside, np.float32(1) - inside)


@numba.njit(nogil=True, error_model="numpy")
def chunks_near(walk: Any, space: Any, ray: Any, first: Any, numbers: Any, needed: Any) -> Any:
    """Return in bit i whether the steps of a ray in chunk `first` + i may meet an occupied cell.

    The cube around a point that reaches to the nearest occupied block is empty. Coordinates of the unit cube change by
    at most 1/2 per unit of distance; where space is contracted, as in `contraction.cube_widths`, most where the ray is
    nearest to the origin. `numbers` and `needed` are scratch space.
    """
    half, quarter, one, two = np.float32(0.5), np.float32(0.25), np.float32(1), np.float32(2)
    side, width, contraction, found = space.side, space.width, walk.contraction, 0
    ox, oy, oz = walk.origins[ray, 0], walk.origins[ray, 1], walk.origins[ray, 2]
    dx, dy, dz = walk.directions[ray, 0], walk.directions[ray, 1], walk.directions[ray, 2]
    for i in range(WINDOW):  # without branches, so that it is vectorised
        t, reach = space.chunks[0, first + i], space.chunks[1, first + i]
        x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
        a, b, c = cube(x, y, z, contraction)
        (a, u), (b, v), (c, w) = _place(a, width, side), _place(b, width, side), _place(c, width, side)
        numbers[i] = np.int32((c * side + b) * side + a)
        norm = max(np.sqrt(x * x + y * y + z * z) - reach, one)
        rate = half if contraction == 0 else (two - one / norm) / norm * quarter
        needed[i] = (reach * rate + _ROUNDING) / width + one - min(u, v, w)
    for i in range(WINDOW):
        found |= np.int64(not np.float32(space.blocks[numbers[i]]) > needed[i]) << i
    return found
