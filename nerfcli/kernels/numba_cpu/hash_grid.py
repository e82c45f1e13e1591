"""The hash grid on CPU threads, compiled by Numba for the vector units of the machine it runs on.

Same operation as in `reference`, for float32. It is fast through unsigned 32-bit index arithmetic; blocks of samples,
whose hashed rows are prefetched before any is used; and one level after the other, so that its table stays in the
cache. It is repeatable because a thread owns samples in the forward pass and whole levels in the backward pass: no two
threads ever write the same number.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from torch import Tensor

from nerfcli.kernels.interface import FEATURES
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.vector import (
    FLOAT,
    FLOATS,
    INT,
    INTS,
    LANES,
    arguments_of,
    dot_rows,
    floats,
    gather_rows,
    in_all_lanes,
    ints,
    prefetch,
    scatter_rows,
    vector_at,
)
from nerfcli.kernels.reference.encoding import HASH_PRIMES


def _cells(builder: Any, coordinates: Any, resolution: Any) -> tuple[list[Any], list[Any]]:
    """Return cells and positions in them by axis; coordinates are clamped to [0, 1], NaN gives cell 0, position NaN."""
    top = in_all_lanes(builder, builder.sitofp(resolution, FLOAT), FLOATS)
    last = in_all_lanes(builder, builder.sub(resolution, ir.Constant(INT, 1)), INTS)
    zero, one = floats(0.0), floats(1.0)
    cells, inside = [], []
    for along in coordinates:
        along = builder.select(builder.fcmp_ordered("<", along, zero), zero, along)
        along = builder.select(builder.fcmp_ordered(">", along, one), one, along)
        scaled = builder.fmul(along, top)
        whole = builder.fptosi(builder.select(builder.fcmp_unordered("uno", scaled, scaled), zero, scaled), INTS)
        cell = builder.select(builder.icmp_signed("<", whole, last), whole, last)
        cells.append(cell)
        inside.append(builder.fsub(scaled, builder.sitofp(cell, FLOATS)))
    return cells, inside


def _hashed_rows(builder: Any, cells: Any, resolution: Any, rows: Any) -> list[Any]:
    mask = in_all_lanes(builder, builder.sub(rows, ir.Constant(INT, 1)), INTS)
    x = [cells[0], builder.add(cells[0], ints(1))]
    y, z = (
        [product := builder.mul(cell, ints(factor)), builder.add(product, ints(factor))]
        for cell, factor in zip(cells[1:], HASH_PRIMES[1:], strict=True)
    )
    yz = [builder.xor(y[corner & 1], z[corner >> 1]) for corner in range(4)]
    return [builder.and_(builder.xor(x[corner & 1], yz[corner >> 1]), mask) for corner in range(8)]


def _dense_rows(builder: Any, cells: Any, resolution: Any, rows: Any) -> list[Any]:
    side = builder.add(resolution, ir.Constant(INT, 1))
    line, layer = (in_all_lanes(builder, step, INTS) for step in (side, builder.mul(side, side)))
    first = builder.add(builder.mul(builder.add(builder.mul(cells[2], line), cells[1]), line), cells[0])
    z = [first, builder.add(first, layer)]
    yz = [z[corner >> 1] if corner & 1 == 0 else builder.add(z[corner >> 1], line) for corner in range(4)]
    return [yz[corner >> 1] if corner & 1 == 0 else builder.add(yz[corner >> 1], ints(1)) for corner in range(8)]


def _weights(builder: Any, inside: Any) -> list[Any]:
    x, y, z = ([builder.fsub(floats(1.0), place), place] for place in inside)
    xy = [builder.fmul(x[corner & 1], y[corner >> 1]) for corner in range(4)]
    return [builder.fmul(xy[corner & 3], z[corner >> 2]) for corner in range(8)]


def _corners(rows_of: Callable[..., list[Any]]) -> Any:
    """Return an intrinsic (points, at, stride, resolution, rows, place, apart, index, weight, inside).

    Reads the coordinates of 16 samples at points[at], points[at + stride], points[at + 2 stride]; writes the table row
    and the weight of corner c to index[place + c apart] and weight[place + c apart] (bit 0 of c is x, bit 1 is y, bit 2
    is z), and the positions inside the cells to inside[place + axis apart]. All arrays are flat, `index` of uint32.
    """

    @intrinsic
    def corners(
        typing_context: Any, points: Any, at: Any, stride: Any, resolution: Any, rows: Any, place: Any, apart: Any,
        index: Any, weight: Any, inside: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data, integer = arguments_of(context, builder, signature, args)
            at, stride, place, apart = map(integer, (1, 2, 5, 6))
            resolution, rows = (integer(i, types.int32) for i in (3, 4))
            coordinates = [
                builder.load(vector_at(builder, data(0), at, stride, axis, FLOATS), align=4) for axis in range(3)
            ]
            cells, within = _cells(builder, coordinates, resolution)
            for which, kind, values in (
                (7, INTS, rows_of(builder, cells, resolution, rows)),
                (8, FLOATS, _weights(builder, within)),
                (9, FLOATS, within),
            ):
                for count, value in enumerate(values):
                    builder.store(value, vector_at(builder, data(which), place, apart, count, kind), align=4)
            return context.get_dummy_value()

        return types.none(points, at, stride, resolution, rows, place, apart, index, weight, inside), generate

    return corners


# See `_corners`; for levels with a separate row for each vertex, and for levels whose vertices share rows by a hash.
dense_corners = _corners(_dense_rows)
hashed_corners = _corners(_hashed_rows)


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


@numba.njit(nogil=True, error_model="numpy")
def _prepare_block(
    points: Any, stride: Any, widths: Any, first: Any, count: Any, level: Any, table: Any, scratch: Any
) -> None:
    """Compute rows and weights of all corners of a block of samples, and prefetch the rows if they are hashed."""
    inside, index, weight = scratch
    resolution, rows = table.resolutions[level], table.rows
    side = np.int64(resolution) + 1
    if side * side * side <= rows:
        for i in range(0, count, LANES):
            dense_corners(points, first + i, stride, resolution, rows, i, BLOCK, index, weight, inside)
    else:
        for i in range(0, count, LANES):
            hashed_corners(points, first + i, stride, resolution, rows, i, BLOCK, index, weight, inside)
        offset = np.int64(level) * rows * FEATURES
        for corner in range(8):
            for i in range(count):
                prefetch(table.flat, offset + np.int64(index[corner * BLOCK + i]) * FEATURES)
    _fade(widths, first, count, resolution, weight)


@numba.njit(inline="always")
def new_scratch() -> Any:
    """Return room for the positions inside cells, rows and weights of a block."""
    return np.empty(3 * BLOCK, np.float32), np.empty(8 * BLOCK, np.uint32), np.empty(8 * BLOCK, np.float32)


@numba.njit(nogil=True, error_model="numpy")
def encode_range(
    points: Any, stride: Any, widths: Any, first: Any, last: Any, table: Any, scratch: Any, out: Any
) -> None:
    """Encode all levels of samples first up to last into the flat array `out`, with scratch space of `new_scratch`.

    The flat `points` are coordinates as from `by_axis`, with `stride` numbers per axis.
    """
    index, weight = scratch[1], scratch[2]
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
    """Return coordinates (N, 3) as (3, M), M >= N a multiple of LANES, as corners are computed for whole vectors."""
    count = len(points)
    laid_out = points.new_zeros(3, -(-count // LANES) * LANES)
    laid_out[:, :count] = points.t()
    return laid_out.numpy()


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
        index, weight = scratch[1], scratch[2]
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
        inside, index, dots = scratch
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
