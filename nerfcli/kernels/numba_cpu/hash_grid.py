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

from nerfcli.kernels.numba_cpu.threads import thread_count
from nerfcli.kernels.numba_cpu.vector import prefetch

# Row width that the kernels are unrolled for.
FEATURES = 4
BLOCK = 32


@numba.njit(inline="always")
def _locate(x: Any, y: Any, z: Any, resolution: Any) -> Any:
    """Cell and place inside it, of coordinates clamped to [0, 1]."""
    top = np.float32(resolution)
    last = np.int32(resolution - 1)
    sx = min(max(x, np.float32(0)), np.float32(1)) * top
    sy = min(max(y, np.float32(0)), np.float32(1)) * top
    sz = min(max(z, np.float32(0)), np.float32(1)) * top
    cx, cy, cz = min(np.int32(sx), last), min(np.int32(sy), last), min(np.int32(sz), last)
    return (
        np.uint32(cx),
        np.uint32(cy),
        np.uint32(cz),
        sx - np.float32(cx),
        sy - np.float32(cy),
        sz - np.float32(cz),
    )


@numba.njit(inline="always")
def _corner_rows(cx: Any, cy: Any, cz: Any, resolution: Any, rows: Any, out: Any, at: Any) -> None:
    """Table rows of the 8 corners of a cell; bit 0 of the corner is x, bit 1 is y, bit 2 is z."""
    one = np.uint32(1)
    side = np.uint32(resolution + 1)
    dense = np.int64(side) * np.int64(side) * np.int64(side) <= np.int64(rows)
    if dense:
        base = (cz * side + cy) * side + cx
        for corner in range(8):
            dx, dy, dz = np.uint32(corner & 1), np.uint32((corner >> 1) & 1), np.uint32((corner >> 2) & 1)
            out[at, corner] = base + (dz * side + dy) * side + dx
        return
    mask = np.uint32(rows - 1)
    y0, z0 = np.uint32(cy * np.uint32(2654435761)), np.uint32(cz * np.uint32(805459861))
    y1, z1 = np.uint32(y0 + np.uint32(2654435761)), np.uint32(z0 + np.uint32(805459861))
    x0, x1 = cx, np.uint32(cx + one)
    out[at, 0] = (x0 ^ y0 ^ z0) & mask
    out[at, 1] = (x1 ^ y0 ^ z0) & mask
    out[at, 2] = (x0 ^ y1 ^ z0) & mask
    out[at, 3] = (x1 ^ y1 ^ z0) & mask
    out[at, 4] = (x0 ^ y0 ^ z1) & mask
    out[at, 5] = (x1 ^ y0 ^ z1) & mask
    out[at, 6] = (x0 ^ y1 ^ z1) & mask
    out[at, 7] = (x1 ^ y1 ^ z1) & mask


@numba.njit(inline="always")
def _corner_weights(fx: Any, fy: Any, fz: Any, out: Any, at: Any) -> None:
    """Trilinear weights of the 8 corners."""
    one = np.float32(1)
    gx, gy, gz = one - fx, one - fy, one - fz
    out[at, 0] = gx * gy * gz
    out[at, 1] = fx * gy * gz
    out[at, 2] = gx * fy * gz
    out[at, 3] = fx * fy * gz
    out[at, 4] = gx * gy * fz
    out[at, 5] = fx * gy * fz
    out[at, 6] = gx * fy * fz
    out[at, 7] = fx * fy * fz


@numba.njit(inline="always")
def _prepare_block(
    points: Any, first: Any, count: Any, level: Any, resolution: Any, rows: Any, flat: Any, index: Any, weight: Any
) -> None:
    """Rows and weights of all corners of a block of samples, with the rows on their way into the cache."""
    offset = np.int64(level) * rows * FEATURES
    for i in range(count):
        cx, cy, cz, fx, fy, fz = _locate(points[first + i, 0], points[first + i, 1], points[first + i, 2], resolution)
        _corner_rows(cx, cy, cz, resolution, rows, index, i)
        _corner_weights(fx, fy, fz, weight, i)
        for corner in range(8):
            prefetch(flat, offset + np.int64(index[i, corner]) * FEATURES)


@numba.njit(parallel=True, cache=True, nogil=True)
def _encode_forward(points: Any, flat: Any, rows: Any, resolutions: Any, out: Any, threads: Any) -> None:
    samples = points.shape[0]
    blocks = (samples + BLOCK - 1) // BLOCK
    for thread in numba.prange(threads):
        index = np.empty((BLOCK, 8), np.uint32)
        weight = np.empty((BLOCK, 8), np.float32)
        for level in range(resolutions.shape[0]):
            resolution = resolutions[level]
            offset = np.int64(level) * rows * FEATURES
            column = level * FEATURES
            for block in range(thread * blocks // threads, (thread + 1) * blocks // threads):
                first = block * BLOCK
                count = min(BLOCK, samples - first)
                _prepare_block(points, first, count, level, resolution, rows, flat, index, weight)
                for i in range(count):
                    a, b, c, d = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
                    for corner in range(8):
                        at = offset + np.int64(index[i, corner]) * FEATURES
                        w = weight[i, corner]
                        a += w * flat[at]
                        b += w * flat[at + 1]
                        c += w * flat[at + 2]
                        d += w * flat[at + 3]
                    out[first + i, column] = a
                    out[first + i, column + 1] = b
                    out[first + i, column + 2] = c
                    out[first + i, column + 3] = d


@numba.njit(parallel=True, cache=True, nogil=True)
def _encode_backward(points: Any, gradient: Any, rows: Any, resolutions: Any, flat: Any, threads: Any) -> None:
    samples = points.shape[0]
    for thread in numba.prange(threads):
        index = np.empty((BLOCK, 8), np.uint32)
        weight = np.empty((BLOCK, 8), np.float32)
        for level in range(thread, resolutions.shape[0], threads):
            resolution = resolutions[level]
            offset = np.int64(level) * rows * FEATURES
            column = level * FEATURES
            for first in range(0, samples, BLOCK):
                count = min(BLOCK, samples - first)
                _prepare_block(points, first, count, level, resolution, rows, flat, index, weight)
                for i in range(count):
                    a, b = gradient[first + i, column], gradient[first + i, column + 1]
                    c, d = gradient[first + i, column + 2], gradient[first + i, column + 3]
                    if a == 0 and b == 0 and c == 0 and d == 0:  # a sample that nothing depends on
                        continue
                    for corner in range(8):
                        at = offset + np.int64(index[i, corner]) * FEATURES
                        w = weight[i, corner]
                        flat[at] += w * a
                        flat[at + 1] += w * b
                        flat[at + 2] += w * c
                        flat[at + 3] += w * d


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        table: Tensor,
        resolutions: tuple[int, ...],
        sink: Tensor | None,
        known: Tensor | None,
    ) -> Tensor:
        points, table = points.detach().contiguous(), table.detach().contiguous()
        levels, rows, features = table.shape
        sides = np.array(resolutions, dtype=np.int32)
        if known is None:
            out = torch.empty(len(points), levels * features)
            _encode_forward(points.numpy(), table.view(-1).numpy(), rows, sides, out.numpy(), thread_count())
        else:
            out = known.view_as(known)
        ctx.save_for_backward(points)
        ctx.table_shape, ctx.sides, ctx.sink = table.shape, sides, sink
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor | None, None, None, None]:
        (points,) = ctx.saved_tensors
        total = torch.zeros(ctx.table_shape) if ctx.sink is None else ctx.sink
        _encode_backward(
            points.numpy(),
            gradients[0].contiguous().numpy(),
            ctx.table_shape[1],
            ctx.sides,
            total.view(-1).numpy(),
            thread_count(),
        )
        return None, total if ctx.sink is None else None, None, None, None


def can_hash_encode(points: Tensor, table: Tensor, resolutions: tuple[int, ...]) -> bool:
    """Whether `hash_encode` of this module takes these tensors; what is malformed goes to the reference's checks."""
    rows, features = table.shape[1:]
    return (
        points.device.type == table.device.type == "cpu"
        and points.dtype == table.dtype == torch.float32
        and not points.requires_grad
        and features == FEATURES
        and len(resolutions) == len(table)
        and rows & (rows - 1) == 0
    )


def hash_encode(
    points: Tensor, table: Tensor, resolutions: tuple[int, ...], sink: Tensor | None, known: Tensor | None
) -> Tensor:
    """See `kernels.hash_encode`; float32 on the CPU, rows of 4 features, differentiable in the table."""
    return _HashEncode.apply(points, table, resolutions, sink, known)  # type: ignore[return-value]
