"""The hash grid on CPU threads, compiled by Numba for the vector units of the machine it runs on.

Same operation as in `reference`, for float32. What makes it fast: unsigned 32-bit index arithmetic; samples in blocks,
with the rows of a block asked for from memory before any of them is used; one level after the other, so that its table
stays in the cache. What makes it repeatable: a thread owns samples in the forward pass and whole levels in the
backward pass, and no two threads ever write one number.
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.vector import ROW, dot_rows, gather_rows, prefetch, scatter_rows

# Row width that the kernels are written for, corners of a cell, and samples in a block.
FEATURES = ROW
BLOCK = 32


@numba.njit(inline="always")
def _cells(points: Any, first: Any, count: Any, resolution: Any, cell: Any, inside: Any) -> None:
    """Cells (3, BLOCK) and places inside them of a block of samples, coordinates clamped to [0, 1]."""
    top, last = np.float32(resolution), np.int32(resolution - 1)
    for axis in range(3):
        for i in range(count):
            scaled = min(max(points[first + i, axis], np.float32(0)), np.float32(1)) * top
            floor = min(np.int32(scaled), last)
            cell[axis, i] = np.uint32(floor)
            inside[axis, i] = scaled - np.float32(floor)


@numba.njit(inline="always")
def _corner_rows(cell: Any, count: Any, resolution: Any, rows: Any, index: Any) -> None:
    """Table rows of the 8 corners, corner after corner; bit 0 of the corner is x, bit 1 is y, bit 2 is z."""
    side = np.uint32(resolution + 1)
    dense = np.int64(side) * np.int64(side) * np.int64(side) <= np.int64(rows)
    mask = np.uint32(rows - 1)
    for corner in range(8):
        dx, dy, dz = np.uint32(corner & 1), np.uint32((corner >> 1) & 1), np.uint32((corner >> 2) & 1)
        if dense:
            for i in range(count):
                index[corner * BLOCK + i] = np.uint32(
                    ((cell[2, i] + dz) * side + cell[1, i] + dy) * side + cell[0, i] + dx
                )
        else:
            for i in range(count):
                y, z = np.uint32(cell[1, i] + dy), np.uint32(cell[2, i] + dz)
                mixed = np.uint32(cell[0, i] + dx) ^ np.uint32(y * np.uint32(2654435761))
                index[corner * BLOCK + i] = (mixed ^ np.uint32(z * np.uint32(805459861))) & mask


@numba.njit(inline="always")
def _corner_weights(inside: Any, count: Any, weight: Any) -> None:
    """Trilinear weights of the 8 corners, corner after corner."""
    one = np.float32(1)
    for corner in range(8):
        for i in range(count):
            x = inside[0, i] if corner & 1 else one - inside[0, i]
            y = inside[1, i] if corner & 2 else one - inside[1, i]
            z = inside[2, i] if corner & 4 else one - inside[2, i]
            weight[corner * BLOCK + i] = x * y * z


@numba.njit(inline="always")
def _fade(widths: Any, first: Any, count: Any, resolution: Any, weight: Any) -> None:
    """Lower the weights of a level whose cells are smaller than a pixel; without widths, of none."""
    if widths.shape[0] > 0:
        one, side = np.float32(1), np.float32(resolution)
        for corner in range(8):
            for i in range(count):
                weight[corner * BLOCK + i] /= max(side * widths[first + i], one)


@numba.njit(inline="always")
def _prepare_block(
    points: Any, widths: Any, first: Any, count: Any, level: Any, resolution: Any, rows: Any, flat: Any, scratch: Any
) -> None:
    """Rows and weights of all corners of a block of samples, with the rows on their way into the cache."""
    cell, inside, index, weight = scratch
    _cells(points, first, count, resolution, cell, inside)
    _corner_rows(cell, count, resolution, rows, index)
    offset = np.int64(level) * rows * FEATURES
    for corner in range(8):
        for i in range(count):
            prefetch(flat, offset + np.int64(index[corner * BLOCK + i]) * FEATURES)
    _corner_weights(inside, count, weight)
    _fade(widths, first, count, resolution, weight)


@numba.njit(inline="always")
def new_scratch() -> Any:
    """Room for cells, places inside them, rows and weights of a block."""
    return (
        np.empty((3, BLOCK), np.uint32),
        np.empty((3, BLOCK), np.float32),
        np.empty(8 * BLOCK, np.uint32),
        np.empty(8 * BLOCK, np.float32),
    )


@numba.njit(inline="always")
def encode_range(
    points: Any, widths: Any, first: Any, last: Any, flat: Any, rows: Any, resolutions: Any, scratch: Any, out: Any
) -> None:
    """All levels of samples first to last into the flat array `out`, with `new_scratch`."""
    index, weight = scratch[2], scratch[3]
    width = resolutions.shape[0] * FEATURES
    for level in range(resolutions.shape[0]):
        resolution = resolutions[level]
        if resolution == 0:
            for i in range(first, last):
                for feature in range(FEATURES):
                    out[i * width + level * FEATURES + feature] = np.float32(0)
            continue
        offset = np.int64(level) * rows * FEATURES
        for start in range(first, last, BLOCK):
            count = min(BLOCK, last - start)
            _prepare_block(points, widths, start, count, level, resolution, rows, flat, scratch)
            for i in range(count):
                gather_rows(flat, offset, index, weight, i, BLOCK, out, (start + i) * width + level * FEATURES)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _encode_forward(points: Any, widths: Any, flat: Any, rows: Any, resolutions: Any, out: Any, threads: Any) -> None:
    blocks = (points.shape[0] + BLOCK - 1) // BLOCK
    for thread in numba.prange(threads):
        first = thread * blocks // threads * BLOCK
        last = min((thread + 1) * blocks // threads * BLOCK, points.shape[0])
        encode_range(points, widths, first, last, flat, rows, resolutions, new_scratch(), out)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _encode_backward(
    points: Any, widths: Any, gradient: Any, rows: Any, resolutions: Any, flat: Any, threads: Any
) -> None:
    samples = points.shape[0]
    width = resolutions.shape[0] * FEATURES
    for thread in numba.prange(threads):
        scratch = new_scratch()
        index, weight = scratch[2], scratch[3]
        for level in range(thread, resolutions.shape[0], threads):
            resolution = resolutions[level]
            if resolution == 0:
                continue
            offset = np.int64(level) * rows * FEATURES
            column = level * FEATURES
            for first in range(0, samples, BLOCK):
                count = min(BLOCK, samples - first)
                _prepare_block(points, widths, first, count, level, resolution, rows, flat, scratch)
                for i in range(count):
                    at = (first + i) * width + column
                    a, b, c, d = gradient[at], gradient[at + 1], gradient[at + 2], gradient[at + 3]
                    if a != 0 or b != 0 or c != 0 or d != 0:  # else nothing depends on this sample
                        scatter_rows(flat, offset, index, weight, i, BLOCK, gradient, at)


@numba.njit(inline="always")
def _slopes(
    inside: Any, count: Any, resolution: Any, dots: Any, points: Any, widths: Any, first: Any, out: Any
) -> None:
    """Add to `out` what the coordinates of a block of samples change: differences across the cell, between corners'
    scalar products of gradient and row, each weighted by the place along the two other axes."""
    one, side = np.float32(1), np.float32(resolution)
    for i in range(count):
        scale = side / max(side * widths[first + i], one) if widths.shape[0] > 0 else side
        for axis in range(3):
            across, other = (axis + 1) % 3, (axis + 2) % 3
            bit, bit_across, bit_other = 1 << axis, 1 << across, 1 << other
            a, b = inside[across, i], inside[other, i]
            low = (one - a) * (dots[bit * BLOCK + i] - dots[i])
            low += a * (dots[(bit | bit_across) * BLOCK + i] - dots[bit_across * BLOCK + i])
            high = (one - a) * (dots[(bit | bit_other) * BLOCK + i] - dots[bit_other * BLOCK + i])
            high += a * (dots[7 * BLOCK + i] - dots[(bit_across | bit_other) * BLOCK + i])
            at = points[first + i, axis]
            if at >= np.float32(0) and at <= one:  # beyond, coordinates are clamped
                out[first + i, axis] += scale * ((one - b) * low + b * high)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _points_backward(
    points: Any, widths: Any, flat: Any, rows: Any, resolutions: Any, gradient: Any, out: Any, threads: Any
) -> None:
    width = resolutions.shape[0] * FEATURES
    blocks = (points.shape[0] + BLOCK - 1) // BLOCK
    for thread in numba.prange(threads):
        begin = thread * blocks // threads * BLOCK
        end = min((thread + 1) * blocks // threads * BLOCK, points.shape[0])
        scratch = new_scratch()
        inside, index, dots = scratch[1], scratch[2], scratch[3]
        for level in range(resolutions.shape[0]):
            resolution = resolutions[level]
            if resolution == 0:
                continue
            offset = np.int64(level) * rows * FEATURES
            for first in range(begin, end, BLOCK):
                count = min(BLOCK, end - first)
                _prepare_block(points, widths, first, count, level, resolution, rows, flat, scratch)
                for i in range(count):
                    at = (first + i) * width + level * FEATURES
                    dot_rows(flat, offset, index, dots, i, BLOCK, gradient, at)
                _slopes(inside, count, resolution, dots, points, widths, first, out)


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        table: Tensor,
        resolutions: tuple[int, ...],
        sink: Tensor | None,
        known: Tensor | None,
        widths: Tensor | None,
    ) -> Tensor:
        points, table = points.detach().contiguous(), table.detach().contiguous()
        widths = points.new_empty(0) if widths is None else widths.detach().contiguous()
        levels, rows, features = table.shape
        sides = np.array(resolutions, dtype=np.int32)
        if known is None:
            out = torch.empty(len(points), levels * features)
            _encode_forward(
                points.numpy(), widths.numpy(), table.view(-1).numpy(), rows, sides, out.view(-1).numpy(),
                use_threads(),
            )  # fmt: skip
        else:
            out = known.view_as(known)
        ctx.save_for_backward(points, widths, table if ctx.needs_input_grad[0] else table[:0])
        ctx.table_shape, ctx.sides, ctx.sink = table.shape, sides, sink
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None, None]:
        points, widths, table = ctx.saved_tensors
        gradient = gradients[0].contiguous().view(-1).numpy()
        rows, of_points, of_table = ctx.table_shape[1], None, None
        if ctx.needs_input_grad[0]:
            of_points = torch.zeros_like(points)
            flat = table.view(-1).numpy()
            _points_backward(
                points.numpy(), widths.numpy(), flat, rows, ctx.sides, gradient, of_points.numpy(), use_threads()
            )
        if ctx.needs_input_grad[1]:
            of_table = torch.zeros(ctx.table_shape) if ctx.sink is None else ctx.sink
            flat = of_table.view(-1).numpy()
            _encode_backward(points.numpy(), widths.numpy(), gradient, rows, ctx.sides, flat, use_threads())
        return of_points, of_table if ctx.sink is None else None, None, None, None, None


def can_hash_encode(points: Tensor, table: Tensor, resolutions: tuple[int, ...]) -> bool:
    """Return whether this module's `hash_encode` supports these tensors; malformed ones go to the reference's
    checks.
    """
    rows, features = table.shape[1:]
    return (
        points.device.type == table.device.type == "cpu"
        and points.dtype == table.dtype == torch.float32
        and features == FEATURES
        and len(resolutions) == len(table)
        and rows & (rows - 1) == 0
    )


def hash_encode(
    points: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    sink: Tensor | None = None,
    known: Tensor | None = None,
    widths: Tensor | None = None,
) -> Tensor:
    """See `reference.hash_encode`; float32 on the CPU, rows of 4 features, differentiable in points and table.

    Args:
        sink: see `Backend.hash_encode`.
        known: (N, L * F), the answer, where it has been computed before without gradients.
    """
    return _HashEncode.apply(points, table, resolutions, sink, known, widths)  # type: ignore[return-value]
