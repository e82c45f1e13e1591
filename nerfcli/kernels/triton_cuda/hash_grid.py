"""The hash grid on a GPU: a program owns a block of samples at one level, whose table stays in the L2 cache.

Same operation as `reference.hash_encode`, for rows of 4 features, which are loaded and added as one vector. Tables are
read in float16 or float32; sums are float32. Gradients of rows are added atomically, in no fixed order.
"""

import functools
from typing import Any

import torch
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.interface import FEATURES
from nerfcli.kernels.triton_cuda.launch import Size, blocks, jit, launch

# Samples of a program.
BLOCK = Size.of(128, interpreted=1024)


@jit
def _cell(points, i, valid, axis: tl.constexpr, resolution):
    """Return the cell along an axis and the position inside it; coordinates are clamped to [0, 1], NaN stays NaN."""
    at = tl.load(points + i * 3 + axis, mask=valid, other=0.0)
    scaled = tl.clamp(at, 0.0, 1.0, propagate_nan=tl.PropagateNan.ALL) * resolution.to(tl.float32)
    cell = tl.maximum(tl.minimum(scaled.to(tl.int32), resolution - 1), 0)
    return cell.to(tl.uint32), scaled - cell.to(tl.float32)


@jit
def _row(cx, cy, cz, corner: tl.constexpr, resolution, rows):
    """Return the table row of a corner; bit 0 of the corner is x, bit 1 is y, bit 2 is z."""
    x, y, z = cx + (corner & 1), cy + ((corner >> 1) & 1), cz + (corner >> 2)
    side = resolution.to(tl.uint32) + 1
    hashed = (x ^ (y * 2654435761) ^ (z * 805459861)) & (rows - 1).to(tl.uint32)
    dense = (z * side + y) * side + x
    whole = side.to(tl.int64)
    return tl.where(whole * whole * whole <= rows, dense, hashed).to(tl.int32)


@jit
def _weight(fx, fy, fz, corner: tl.constexpr):
    """Return the trilinear weight of a corner."""
    x = fx if corner & 1 else 1.0 - fx
    y = fy if corner & 2 else 1.0 - fy
    z = fz if corner & 4 else 1.0 - fz
    return x * y * z


@jit
def _fade(widths, i, valid, resolution, fades: tl.constexpr):
    """Return the weight of a level at samples: below 1 where its cells are smaller than a pixel."""
    if fades:
        width = tl.load(widths + i, mask=valid, other=0.0)
        return 1.0 / tl.maximum(resolution.to(tl.float32) * width, 1.0)
    else:
        return 1.0


@jit
def _encode(
    points, widths, table, resolutions, out, count, rows,
    COLUMNS: tl.constexpr, FADES: tl.constexpr, COUNT_ON_DEVICE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    level = tl.program_id(1)
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    samples = tl.load(count) if COUNT_ON_DEVICE else count
    if tl.program_id(0) * BLOCK >= samples:
        return
    valid = i < samples
    f = tl.arange(0, 4)
    resolution = tl.load(resolutions + level)
    total = tl.zeros([BLOCK, 4], tl.float32)
    if resolution > 0:
        cx, fx = _cell(points, i, valid, 0, resolution)
        cy, fy = _cell(points, i, valid, 1, resolution)
        cz, fz = _cell(points, i, valid, 2, resolution)
        fade = _fade(widths, i, valid, resolution, FADES)
        base = table + level.to(tl.int64) * rows * 4
        for corner in tl.static_range(8):
            row = _row(cx, cy, cz, corner, resolution, rows)
            weight = _weight(fx, fy, fz, corner) * fade
            total += weight[:, None] * tl.load(base + row[:, None] * 4 + f[None, :]).to(tl.float32)
    tl.store(out + i[:, None] * COLUMNS + (level * 4 + f)[None, :], total.to(out.dtype.element_ty), mask=valid[:, None])


@jit
def _encode_backward(
    points, widths, gradient, scale, resolutions, table_grad, count, rows,
    COLUMNS: tl.constexpr, FADES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    level = tl.program_id(1)
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    f = tl.arange(0, 4)
    resolution = tl.load(resolutions + level)
    if resolution > 0:
        g = tl.load(gradient + i[:, None] * COLUMNS + (level * 4 + f)[None, :], mask=valid[:, None], other=0.0)
        # Rows of samples without a gradient stay untouched.
        moved = valid & (tl.max(tl.where(g == 0, 0, 1), 1) > 0)
        g = g.to(tl.float32) / tl.load(scale)
        cx, fx = _cell(points, i, valid, 0, resolution)
        cy, fy = _cell(points, i, valid, 1, resolution)
        cz, fz = _cell(points, i, valid, 2, resolution)
        fade = _fade(widths, i, valid, resolution, FADES)
        base = table_grad + level.to(tl.int64) * rows * 4
        for corner in tl.static_range(8):
            row = _row(cx, cy, cz, corner, resolution, rows)
            weight = _weight(fx, fy, fz, corner) * fade
            tl.atomic_add(base + row[:, None] * 4 + f[None, :], weight[:, None] * g, mask=moved[:, None], sem="relaxed")


@jit
def _points_backward(
    points, widths, table, gradient, scale, resolutions, out, count, rows,
    levels, COLUMNS: tl.constexpr, FADES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write slopes of the interpolation: corners' scalar products of gradient and row, signed by side of the cell."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    f = tl.arange(0, 4)
    unscale = 1.0 / tl.load(scale)
    by_x = tl.zeros([BLOCK], tl.float32)
    by_y = tl.zeros([BLOCK], tl.float32)
    by_z = tl.zeros([BLOCK], tl.float32)
    for level in range(levels):
        resolution = tl.load(resolutions + level)
        if resolution > 0:
            g = tl.load(gradient + i[:, None] * COLUMNS + (level * 4 + f)[None, :], mask=valid[:, None], other=0.0)
            g = g.to(tl.float32) * unscale
            cx, fx = _cell(points, i, valid, 0, resolution)
            cy, fy = _cell(points, i, valid, 1, resolution)
            cz, fz = _cell(points, i, valid, 2, resolution)
            slope = _fade(widths, i, valid, resolution, FADES) * resolution.to(tl.float32)
            base = table + level * rows * 4
            for corner in tl.static_range(8):
                row = _row(cx, cy, cz, corner, resolution, rows)
                dot = tl.sum(g * tl.load(base + row[:, None] * 4 + f[None, :]).to(tl.float32), 1) * slope
                x = fx if corner & 1 else 1.0 - fx
                y = fy if corner & 2 else 1.0 - fy
                z = fz if corner & 4 else 1.0 - fz
                by_x += dot * y * z * (1.0 if corner & 1 else -1.0)
                by_y += dot * x * z * (1.0 if corner & 2 else -1.0)
                by_z += dot * x * y * (1.0 if corner & 4 else -1.0)
    for axis in tl.static_range(3):
        at = tl.load(points + i * 3 + axis, mask=valid, other=0.0)
        slope = by_x if axis == 0 else (by_y if axis == 1 else by_z)
        # Beyond the cube, coordinates are clamped.
        tl.store(out + i * 3 + axis, tl.where((at < 0.0) | (at > 1.0), 0.0, slope), mask=valid)


def encode(
    points: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    *,
    widths: Tensor | None,
    count: Tensor | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Compute `reference.hash_encode` without gradients, in the given dtype.

    Args:
        count: () int64 on the device: number of valid points, all if None; the codes of the rest are undefined.
    """
    levels, rows, _ = table.shape
    out = torch.empty(len(points), levels * FEATURES, dtype=dtype, device=points.device)
    launch(
        _encode, (blocks(len(points), BLOCK), levels), points, points if widths is None else widths, table,
        device_integers(resolutions, points.device), out, len(points) if count is None else count, rows,
        COLUMNS=levels * FEATURES, FADES=widths is not None, COUNT_ON_DEVICE=count is not None, BLOCK=BLOCK,
    )  # fmt: skip
    return out


def add_table_gradient(
    table_grad: Tensor,
    points: Tensor,
    gradient: Tensor,
    resolutions: tuple[int, ...],
    *,
    scale: Tensor,
    widths: Tensor | None,
) -> None:
    """Add the table's gradient to the sink (L, T, 4); the codes' gradient (N, L * 4) is multiplied by `scale` (1,)."""
    levels, rows, _ = table_grad.shape
    launch(
        _encode_backward, (blocks(len(points), BLOCK), levels), points, points if widths is None else widths,
        gradient, scale, device_integers(resolutions, points.device), table_grad, len(points), rows,
        COLUMNS=levels * FEATURES, FADES=widths is not None, BLOCK=BLOCK,
    )  # fmt: skip


def points_gradient(
    points: Tensor,
    table: Tensor,
    gradient: Tensor,
    resolutions: tuple[int, ...],
    *,
    scale: Tensor,
    widths: Tensor | None,
) -> Tensor:
    """Return the points' gradient (N, 3); the codes' gradient (N, L * 4) is multiplied by `scale` (1,)."""
    levels, rows, _ = table.shape
    out = torch.empty_like(points)
    launch(
        _points_backward, (blocks(len(points), BLOCK),), points, points if widths is None else widths, table,
        gradient, scale, device_integers(resolutions, points.device), out, len(points), rows, levels,
        COLUMNS=levels * FEATURES, FADES=widths is not None, BLOCK=BLOCK,
    )  # fmt: skip
    return out


@functools.lru_cache(maxsize=64)
def device_integers(values: tuple[int, ...], device: torch.device) -> Tensor:
    """Return integers on the device; each tuple is copied only once, as copies from the host wait."""
    return torch.tensor(values, dtype=torch.int32, device=device)


@functools.lru_cache(maxsize=64)
def device_floats(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Return floats on the device; see `device_integers`."""
    return torch.tensor(values, dtype=torch.float32, device=device)


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        table: Tensor,
        resolutions: tuple[int, ...],
        table_grad: Tensor | None,
        widths: Tensor | None,
    ) -> Tensor:
        points, table = points.detach().contiguous(), table.detach().contiguous()
        ctx.save_for_backward(points, table, *(() if widths is None else (widths,)))
        ctx.resolutions, ctx.table_grad = resolutions, table_grad
        return encode(points, table, resolutions, widths=widths)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        points, table, *rest = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        named = {"scale": device_floats((1.0,), points.device), "widths": rest[0] if rest else None}
        of_points, of_table = None, None
        if ctx.needs_input_grad[0]:
            of_points = points_gradient(points, table, gradient, ctx.resolutions, **named)
        if ctx.needs_input_grad[1]:
            of_table = torch.zeros_like(table) if ctx.table_grad is None else ctx.table_grad
            add_table_gradient(of_table, points, gradient, ctx.resolutions, **named)
        return of_points, of_table if ctx.table_grad is None else None, None, None, None


def hash_encode(
    points: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    table_grad: Tensor | None = None,
    widths: Tensor | None = None,
) -> Tensor:
    """See `reference.hash_encode`; float32, rows of 4 features, differentiable in points and table."""
    return _HashEncode.apply(points, table, resolutions, table_grad, widths)
