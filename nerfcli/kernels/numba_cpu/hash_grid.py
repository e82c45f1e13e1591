"""The hash grid on CPU threads, compiled by Numba for the vector units of the machine it runs on.

Same operation as in `reference`, for float32. It is fast through unsigned 32-bit index arithmetic; blocks of samples,
whose hashed rows are prefetched before any is used; and one level after the other, so that its table stays in the
cache. It is repeatable because a thread owns samples in the forward pass and whole levels in the backward pass: no two
threads ever write the same number.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.interface import FEATURES
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.vector import dot_rows, gather_rows, prefetch, scatter_rows
from nerfcli.kernels.reference.encoding import HASH_PRIMES


class Table(NamedTuple):
    """The table of a hash grid, or its gradient, as compiled loops take it.

    Args:
        flat: (L * T * F,) float32.
        rows: T.
        resolutions: (L,) int32, see `HashGrid`.
    """

    flat: Any
    rows: Any
    resolutions: Any


def table_of(table: Tensor, resolutions: tuple[int, ...]) -> Table:
    """Return a table (L, T, F), which must be contiguous, as compiled loops take it."""
    return Table(table.view(-1).numpy(), table.shape[1], np.array(resolutions, dtype=np.int32))


# Factors of the spatial hash.
_OF_Y, _OF_Z = np.uint32(HASH_PRIMES[1]), np.uint32(HASH_PRIMES[2])
# Samples in a block: in smaller blocks, a sample's row numbers would be read before the processor has stored them.
BLOCK = 128


@numba.njit(inline="always")
def _fade(widths: Any, first: Any, count: Any, resolution: Any, weight: Any) -> None:
    """Lower the weights of samples where the level's cells are smaller than a pixel; without widths, of none."""
    if widths.shape[0] > 0:
        one, side = np.float32(1), np.float32(resolution)
        for corner in range(8):
            for i in range(count):
                weight[corner * BLOCK + i] /= max(side * widths[first + i], one)


@numba.njit(inline="always")
def _cells(points: Any, count: Any, resolution: Any, cells: Any, inside: Any) -> None:
    """Write cells and positions in them along an axis; coordinates are clamped to [0, 1], NaN gives cell 0, NaN."""
    zero, one, top, last = np.float32(0), np.float32(1), np.float32(resolution), np.int32(resolution - 1)
    for i in range(count):
        at = zero if points[i] < zero else points[i]
        scaled = (one if at > one else at) * top
        cell = min(np.int32(scaled if scaled == scaled else zero), last)
        cells[i], inside[i] = np.uint32(cell), scaled - np.float32(cell)


@numba.njit(inline="always")
def _dense_rows(cells: Any, count: Any, resolution: Any, index: Any) -> None:
    """Write the table rows of corners on a level with a separate row for each vertex."""
    zero, line = np.uint32(0), np.uint32(resolution + 1)
    layer = np.uint32(line * line)
    for i in range(count):
        row = np.uint32(np.uint32(cells[2 * BLOCK + i] * layer) + np.uint32(cells[BLOCK + i] * line)) + cells[i]
        for corner in range(8):
            beyond = np.uint32((line if corner & 2 else zero) + (layer if corner & 4 else zero))
            index[corner * BLOCK + i] = np.uint32(row) + np.uint32(beyond + np.uint32(corner & 1))


@numba.njit(inline="always")
def _hashed_rows(cells: Any, count: Any, mask: Any, index: Any) -> None:
    """Write the table rows of corners on a level whose vertices share rows by a hash."""
    for i in range(count):
        x, y, z = cells[i], np.uint32(cells[BLOCK + i] * _OF_Y), np.uint32(cells[2 * BLOCK + i] * _OF_Z)
        for corner in range(8):
            mixed = np.uint32(x + np.uint32(corner & 1))
            mixed ^= np.uint32(y + _OF_Y) if corner & 2 else y
            mixed ^= np.uint32(z + _OF_Z) if corner & 4 else z
            index[corner * BLOCK + i] = mixed & mask


@numba.njit(inline="always")
def _weights(inside: Any, count: Any, weight: Any) -> None:
    """Write the trilinear weights of corners."""
    one = np.float32(1)
    for i in range(count):
        x, y, z = inside[i], inside[BLOCK + i], inside[2 * BLOCK + i]
        for corner in range(8):
            xy = (x if corner & 1 else one - x) * (y if corner & 2 else one - y)
            weight[corner * BLOCK + i] = xy * (z if corner & 4 else one - z)


@numba.njit(inline="always")
def new_scratch() -> Any:
    """Return room for the cells of a block's samples, the positions inside them, and rows and weights of the corners.

    Corner c of sample i has the row and the weight number c BLOCK + i; bit 0 of c is x, bit 1 is y, bit 2 is z.
    """
    cells, inside = np.empty(3 * BLOCK, np.uint32), np.empty(3 * BLOCK, np.float32)
    return cells, inside, np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)


@numba.njit(nogil=True, error_model="numpy")
def _prepare_block(
    points: Any, stride: Any, widths: Any, first: Any, count: Any, level: Any, table: Any, scratch: Any
) -> None:
    """Compute rows and weights of all corners of a block of samples, and prefetch the rows if they are hashed.

    The loops over samples are vectorised: the numbers that they write are at constant offsets of one array, and Numba's
    integers of 64 bits are cut to 32 after each operation.
    """
    cells, inside, index, weight = scratch
    resolution, rows = table.resolutions[level], table.rows
    for axis in range(3):
        begin, room = axis * stride + first, slice(axis * BLOCK, (axis + 1) * BLOCK)
        _cells(points[begin : begin + count], count, resolution, cells[room], inside[room])
    side = np.int64(resolution) + 1
    if side * side * side <= rows:
        _dense_rows(cells, count, resolution, index)
    else:
        _hashed_rows(cells, count, np.uint32(rows - 1), index)
        offset = np.int64(level) * rows * FEATURES
        for corner in range(8):
            for i in range(count):
                prefetch(table.flat, offset + np.int64(index[corner * BLOCK + i]) * FEATURES)
    _weights(inside, count, weight)
    _fade(widths, first, count, resolution, weight)


@numba.njit(nogil=True, error_model="numpy")
def encode_range(
    points: Any, stride: Any, widths: Any, first: Any, last: Any, table: Any, scratch: Any, out: Any
) -> None:
    """Encode all levels of samples first up to last into the flat array `out`, with scratch space of `new_scratch`.

    The flat `points` are coordinates as from `by_axis`, with `stride` numbers per axis.
    """
    index, weight = scratch[2], scratch[3]
    width = table.resolutions.shape[0] * FEATURES
    for level in range(table.resolutions.shape[0]):
        if table.resolutions[level] == 0:
            for i in range(first, last):
                for feature in range(FEATURES):
                    out[i * width + level * FEATURES + feature] = np.float32(0)
            continue
        offset = np.int64(level) * table.rows * FEATURES
        for start in range(first, last, BLOCK):
            count = min(BLOCK, last - start)
            _prepare_block(points, stride, widths, start, count, level, table, scratch)
            for i in range(count):
                gather_rows(table.flat, offset, index, weight, i, BLOCK, out, (start + i) * width + level * FEATURES)


def by_axis(points: Tensor) -> np.ndarray:
    """Return coordinates (N, 3) as (3, N)."""
    return points.t().contiguous().numpy()


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _encode_forward(points: Any, widths: Any, table: Any, out: Any, threads: Any) -> None:
    width, stride = table.resolutions.shape[0] * FEATURES, points.shape[1]
    samples = out.shape[0] // max(width, 1)
    blocks = (samples + BLOCK - 1) // BLOCK
    for thread in numba.prange(threads):
        first = thread * blocks // threads * BLOCK
        last = min((thread + 1) * blocks // threads * BLOCK, samples)
        encode_range(points.reshape(-1), stride, widths, first, last, table, new_scratch(), out)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _encode_backward(points: Any, widths: Any, gradient: Any, table: Any, threads: Any) -> None:
    """Add the gradient of the encoding to a table, which holds that of the rows."""
    width, stride = table.resolutions.shape[0] * FEATURES, points.shape[1]
    samples = gradient.shape[0] // max(width, 1)
    for thread in numba.prange(threads):
        scratch = new_scratch()
        index, weight = scratch[2], scratch[3]
        for level in range(thread, table.resolutions.shape[0], threads):
            if table.resolutions[level] == 0:
                continue
            offset = np.int64(level) * table.rows * FEATURES
            column = level * FEATURES
            for first in range(0, samples, BLOCK):
                count = min(BLOCK, samples - first)
                _prepare_block(points.reshape(-1), stride, widths, first, count, level, table, scratch)
                for i in range(count):
                    at = (first + i) * width + column
                    a, b, c, d = gradient[at], gradient[at + 1], gradient[at + 2], gradient[at + 3]
                    if a != 0 or b != 0 or c != 0 or d != 0:  # else nothing depends on this sample
                        scatter_rows(table.flat, offset, index, weight, i, BLOCK, gradient, at)


@numba.njit(nogil=True, error_model="numpy")
def _slopes(
    inside: Any, count: Any, resolution: Any, dots: Any, points: Any, widths: Any, first: Any, out: Any
) -> None:
    """Add the gradient of the coordinates of a block of samples to `out`: differences across the cell between corners'
    scalar products of gradient and row, each weighted by the position along the two other axes."""
    one, side = np.float32(1), np.float32(resolution)
    for i in range(count):
        scale = side / max(side * widths[first + i], one) if widths.shape[0] > 0 else side
        for axis in range(3):
            across, other = (axis + 1) % 3, (axis + 2) % 3
            bit, bit_across, bit_other = 1 << axis, 1 << across, 1 << other
            a, b = inside[across * BLOCK + i], inside[other * BLOCK + i]
            low = (one - a) * (dots[bit * BLOCK + i] - dots[i])
            low += a * (dots[(bit | bit_across) * BLOCK + i] - dots[bit_across * BLOCK + i])
            high = (one - a) * (dots[(bit | bit_other) * BLOCK + i] - dots[bit_other * BLOCK + i])
            high += a * (dots[7 * BLOCK + i] - dots[(bit_across | bit_other) * BLOCK + i])
            at = points[axis, first + i]
            if at >= np.float32(0) and at <= one:  # beyond, coordinates are clamped
                out[first + i, axis] += scale * ((one - b) * low + b * high)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _points_backward(points: Any, widths: Any, table: Any, gradient: Any, out: Any, threads: Any) -> None:
    width, stride = table.resolutions.shape[0] * FEATURES, points.shape[1]
    samples = out.shape[0]
    blocks = (samples + BLOCK - 1) // BLOCK
    for thread in numba.prange(threads):
        begin = thread * blocks // threads * BLOCK
        end = min((thread + 1) * blocks // threads * BLOCK, samples)
        scratch = new_scratch()
        _, inside, index, dots = scratch
        for level in range(table.resolutions.shape[0]):
            resolution = table.resolutions[level]
            if resolution == 0:
                continue
            offset = np.int64(level) * table.rows * FEATURES
            for first in range(begin, end, BLOCK):
                count = min(BLOCK, end - first)
                _prepare_block(points.reshape(-1), stride, widths, first, count, level, table, scratch)
                for i in range(count):
                    at = (first + i) * width + level * FEATURES
                    dot_rows(table.flat, offset, index, dots, i, BLOCK, gradient, at)
                _slopes(inside, count, resolution, dots, points, widths, first, out)


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        table: Tensor,
        resolutions: tuple[int, ...],
        table_grad: Tensor | None,
        computed: Tensor | None,
        widths: Tensor | None,
    ) -> Tensor:
        points, table = points.detach().contiguous(), table.detach().contiguous()
        widths = points.new_empty(0) if widths is None else widths.detach().contiguous()
        if computed is None:
            out = torch.empty(len(points), len(table) * FEATURES)
            laid_out, flat = by_axis(points), out.view(-1).numpy()
            _encode_forward(laid_out, widths.numpy(), table_of(table, resolutions), flat, use_threads())
        else:
            out = computed.view_as(computed)
        ctx.save_for_backward(points, widths, table if ctx.needs_input_grad[0] else table[:0])
        ctx.table_shape, ctx.resolutions, ctx.table_grad = table.shape, resolutions, table_grad
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None, None]:
        points, widths, table = ctx.saved_tensors
        gradient, laid_out = gradients[0].contiguous().view(-1).numpy(), by_axis(points)
        of_points, of_table = None, None
        if ctx.needs_input_grad[0]:
            of_points, rows = torch.zeros_like(points), table_of(table, ctx.resolutions)
            _points_backward(laid_out, widths.numpy(), rows, gradient, of_points.numpy(), use_threads())
        if ctx.needs_input_grad[1]:
            of_table = torch.zeros(ctx.table_shape) if ctx.table_grad is None else ctx.table_grad
            _encode_backward(laid_out, widths.numpy(), gradient, table_of(of_table, ctx.resolutions), use_threads())
        return of_points, of_table if ctx.table_grad is None else None, None, None, None, None


def hash_encode(
    points: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    table_grad: Tensor | None = None,
    computed: Tensor | None = None,
    widths: Tensor | None = None,
) -> Tensor:
    """See `reference.hash_encode`; float32 on the CPU, rows of 4 features, differentiable in points and table.

    Args:
        table_grad: see `Backend.hash_encode`.
        computed: (N, L * F), the result, if it has already been computed without gradients.
    """
    return _HashEncode.apply(points, table, resolutions, table_grad, computed, widths)
