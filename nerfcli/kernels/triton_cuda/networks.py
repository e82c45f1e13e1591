"""Both small networks on tensor cores: float16 operands, float32 sums, all layers of a block of samples in one kernel.

Same operations as `reference.density` and `reference.radiance`, with the spherical harmonics of the directions inside.
A program processes many blocks, so that weights are loaded once. Only the inputs are kept for the backward pass, which
recomputes hidden layers, and scales gradients so that the largest one of a step is well inside the range of float16.
"""

import functools

import torch
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.activations import LOG_DENSITY_LIMIT
from nerfcli.kernels.interface import WIDTH
from nerfcli.kernels.triton_cuda.launch import Size, blocks, jit, launch
from nerfcli.kernels.triton_cuda.rays import load3


@jit
def harmonics(x, y, z, column, DEGREE: tl.constexpr):
    """Return harmonics (BLOCK, 16), 0 above DEGREE, of directions (BLOCK, 1); `column` (1, 16) counts from 0."""
    out = tl.broadcast_to(tl.where(column == 0, 0.28209479177387814, 0.0), (x.shape[0], 16))
    if DEGREE > 0:
        out = tl.where(column == 1, 0.4886025119029199 * y, out)
        out = tl.where(column == 2, 0.4886025119029199 * z, out)
        out = tl.where(column == 3, 0.4886025119029199 * x, out)
    if DEGREE > 1:
        out = tl.where(column == 4, 1.0925484305920792 * x * y, out)
        out = tl.where(column == 5, 1.0925484305920792 * y * z, out)
        out = tl.where(column == 6, 0.31539156525252005 * (3.0 * z * z - 1.0), out)
        out = tl.where(column == 7, 1.0925484305920792 * x * z, out)
        out = tl.where(column == 8, 0.5462742152960396 * (x * x - y * y), out)
    if DEGREE > 2:
        out = tl.where(column == 9, 0.5900435899266435 * y * (3.0 * x * x - y * y), out)
        out = tl.where(column == 10, 2.890611442640554 * x * y * z, out)
        out = tl.where(column == 11, 0.4570457994644658 * y * (5.0 * z * z - 1.0), out)
        out = tl.where(column == 12, 0.3731763325901154 * z * (5.0 * z * z - 3.0), out)
        out = tl.where(column == 13, 0.4570457994644658 * x * (5.0 * z * z - 1.0), out)
        out = tl.where(column == 14, 1.445305721320277 * z * (x * x - y * y), out)
        out = tl.where(column == 15, 0.5900435899266435 * x * (x * x - 3.0 * y * y), out)
    return out


@jit
def harmonics_slopes(x, y, z, column, DEGREE: tl.constexpr):
    """Return the derivatives (BLOCK, 16) of `harmonics` by x, by y and by z."""
    none = tl.where(column == 0, 0.0, 0.0) + x * 0.0
    dx, dy, dz = none, none, none
    if DEGREE > 0:
        dy = tl.where(column == 1, 0.4886025119029199, dy)
        dz = tl.where(column == 2, 0.4886025119029199, dz)
        dx = tl.where(column == 3, 0.4886025119029199, dx)
    if DEGREE > 1:
        dx = tl.where(column == 4, 1.0925484305920792 * y, dx)
        dy = tl.where(column == 4, 1.0925484305920792 * x, dy)
        dy = tl.where(column == 5, 1.0925484305920792 * z, dy)
        dz = tl.where(column == 5, 1.0925484305920792 * y, dz)
        dz = tl.where(column == 6, 1.8923493915151202 * z, dz)
        dx = tl.where(column == 7, 1.0925484305920792 * z, dx)
        dz = tl.where(column == 7, 1.0925484305920792 * x, dz)
        dx = tl.where(column == 8, 1.0925484305920792 * x, dx)
        dy = tl.where(column == 8, -1.0925484305920792 * y, dy)
    if DEGREE > 2:
        dx = tl.where(column == 9, 3.540261539559861 * x * y, dx)
        dy = tl.where(column == 9, 1.7701307697799304 * (x * x - y * y), dy)
        dx = tl.where(column == 10, 2.890611442640554 * y * z, dx)
        dy = tl.where(column == 10, 2.890611442640554 * x * z, dy)
        dz = tl.where(column == 10, 2.890611442640554 * x * y, dz)
        dy = tl.where(column == 11, 0.4570457994644658 * (5.0 * z * z - 1.0), dy)
        dz = tl.where(column == 11, 4.570457994644658 * y * z, dz)
        dz = tl.where(column == 12, 0.3731763325901154 * (15.0 * z * z - 3.0), dz)
        dx = tl.where(column == 13, 0.4570457994644658 * (5.0 * z * z - 1.0), dx)
        dz = tl.where(column == 13, 4.570457994644658 * x * z, dz)
        dx = tl.where(column == 14, 2.890611442640554 * x * z, dx)
        dy = tl.where(column == 14, -2.890611442640554 * y * z, dy)
        dz = tl.where(column == 14, 1.445305721320277 * (x * x - y * y), dz)
        dx = tl.where(column == 15, 1.7701307697799304 * (x * x - y * y), dx)
        dy = tl.where(column == 15, -3.540261539559861 * x * y, dy)
    return dx, dy, dz


BLOCK = Size.of(64, interpreted=256)
LIMIT = tl.constexpr(LOG_DENSITY_LIMIT)
# Scaled value of the largest gradient of an output: 2^12 below float16's largest number, 2^28 above its smallest.
LARGEST = tl.constexpr(16.0)
# The least gradient that sets the scale, so that it stays within float32; float16's largest number, the clamp.
LEAST, END = tl.constexpr(1e-30), tl.constexpr(65504.0)


@jit
def _transposed(weights, OUT: tl.constexpr, IN: tl.constexpr, at: tl.constexpr, stride: tl.constexpr):
    """Return IN columns from `at` on of a row-major (OUT, stride) matrix, transposed to (IN, OUT), in float16."""
    o, i = tl.arange(0, OUT), tl.arange(0, IN)
    return tl.load(weights + at + o[None, :] * stride + i[:, None]).to(tl.float16)


@jit
def _colours_transposed(weights, H: tl.constexpr):
    """Return the matrix (3, H) transposed and padded with columns of zeros to (H, 16), in float16."""
    o, i = tl.arange(0, 16), tl.arange(0, H)
    return tl.load(weights + o[None, :] * H + i[:, None], mask=(o < 3)[None, :], other=0.0).to(tl.float16)


@jit
def _bounded_exp(g, column):
    """Return the density from the first of 16 outputs, its logarithm, clamped to LIMIT."""
    first = tl.sum(tl.where(column == 0, g, 0.0), 1)
    return tl.exp(tl.clamp(first, -LIMIT, LIMIT, propagate_nan=tl.PropagateNan.ALL))


@jit
def _seen_along(directions, rays, i, valid, column, DEGREE: tl.constexpr):
    """Return the harmonics (BLOCK, 16), in float16, and the components (BLOCK, 1) of the directions of samples."""
    ray = tl.load(rays + i, mask=valid, other=0)
    x, y, z = load3(directions, ray, valid)
    x, y, z = x[:, None], y[:, None], z[:, None]
    return harmonics(x, y, z, column, DEGREE).to(tl.float16), x, y, z


@jit
def _density(
    encoded, w1, w2, density, count, H: tl.constexpr, COUNT_ON_DEVICE: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    first, second = _transposed(w1, H, 32, 0, 32), _transposed(w2, 16, H, 0, H)
    column, code = tl.arange(0, 16)[None, :], tl.arange(0, 32)
    samples = (tl.load(count) if COUNT_ON_DEVICE else count).to(tl.int32)
    for tile in range(tl.program_id(0), tl.cdiv(samples, BLOCK), tl.num_programs(0)):
        i = (tile * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
        valid = i < samples
        x = tl.load(encoded + i[:, None] * 32 + code[None, :], mask=valid[:, None], other=0.0)
        h = tl.maximum(tl.dot(x, first), 0.0, propagate_nan=tl.PropagateNan.ALL).to(tl.float16)
        tl.store(density + i, _bounded_exp(tl.dot(h, second), column), mask=valid)


@jit
def _forward(
    encoded, directions, rays, w1, w2, c1, c2, c3, density, rgb,
    samples, H: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    first, second = _transposed(w1, H, 32, 0, 32), _transposed(w2, 16, H, 0, H)
    third, seen = _transposed(c1, H, 16, 0, 32), _transposed(c1, H, 16, 16, 32)
    fourth, fifth = _transposed(c2, H, H, 0, H), _colours_transposed(c3, H)
    column, code = tl.arange(0, 16)[None, :], tl.arange(0, 32)
    for tile in range(tl.program_id(0), tl.cdiv(samples, BLOCK), tl.num_programs(0)):
        i = (tile * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
        valid = i < samples
        x = tl.load(encoded + i[:, None] * 32 + code[None, :], mask=valid[:, None], other=0.0)
        h = tl.maximum(tl.dot(x, first), 0.0, propagate_nan=tl.PropagateNan.ALL).to(tl.float16)
        g = tl.dot(h, second)
        tl.store(density + i, _bounded_exp(g, column), mask=valid)
        sh, _x, _y, _z = _seen_along(directions, rays, i, valid, column, DEGREE)
        h = tl.dot(sh, seen, tl.dot(g.to(tl.float16), third))
        h = tl.maximum(h, 0.0, propagate_nan=tl.PropagateNan.ALL).to(tl.float16)
        h = tl.maximum(tl.dot(h, fourth), 0.0, propagate_nan=tl.PropagateNan.ALL).to(tl.float16)
        out = 1.0 / (1.0 + tl.exp(-tl.dot(h, fifth)))
        tl.store(rgb + i[:, None] * 3 + column, out, mask=valid[:, None] & (column < 3))


@jit
def _half(gradient):
    """Convert to float16, clamped: infinity would spoil the sums of all samples. NaN stays, so that it is detected."""
    return tl.clamp(gradient, -END, END, propagate_nan=tl.PropagateNan.ALL).to(tl.float16)


@jit
def _largest(by_density, density, by_rgb, out, samples, BLOCK: tl.constexpr):
    """Raise `out` to the largest absolute gradient of a log density or a colour."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < samples
    thick = tl.load(by_density + i, mask=valid, other=0.0) * tl.load(density + i, mask=valid, other=0.0)
    most = tl.abs(thick)
    for channel in tl.static_range(3):
        most = tl.maximum(most, tl.abs(tl.load(by_rgb + i * 3 + channel, mask=valid, other=0.0)))
    tl.atomic_max(out, tl.max(most, 0), sem="relaxed")


@jit
def _backward(
    encoded, directions, rays, w1, w2, c1, c2, c3, by_density, by_rgb,
    largest, by_encoded, by_direction, by_w1, by_w2, by_c1, by_c2, by_c3,
    scale_out, samples, H: tl.constexpr, DEGREE: tl.constexpr, RAYS_LEARN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    scale = LARGEST / tl.maximum(tl.load(largest), LEAST)
    if tl.program_id(0) == 0:
        tl.store(scale_out, scale)
    first, second = _transposed(w1, H, 32, 0, 32), _transposed(w2, 16, H, 0, H)
    third, seen = _transposed(c1, H, 16, 0, 32), _transposed(c1, H, 16, 16, 32)
    fourth, fifth = _transposed(c2, H, H, 0, H), _colours_transposed(c3, H)
    column, code = tl.arange(0, 16)[None, :], tl.arange(0, 32)
    d_first = tl.zeros([32, H], tl.float32)
    d_second = tl.zeros([H, 16], tl.float32)
    d_third = tl.zeros([16, H], tl.float32)
    d_seen = tl.zeros([16, H], tl.float32)
    d_fourth = tl.zeros([H, H], tl.float32)
    d_fifth = tl.zeros([H, 16], tl.float32)
    for tile in range(tl.program_id(0), tl.cdiv(samples, BLOCK), tl.num_programs(0)):
        i = (tile * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
        valid = i < samples
        x = tl.load(encoded + i[:, None] * 32 + code[None, :], mask=valid[:, None], other=0.0)
        h1 = tl.maximum(tl.dot(x, first), 0.0, propagate_nan=tl.PropagateNan.ALL).to(tl.float16)
        g = tl.dot(h1, second)
        density = _bounded_exp(g, column)
        g16 = g.to(tl.float16)
        sh, dx, dy, dz = _seen_along(directions, rays, i, valid, column, DEGREE)
        h2 = tl.dot(sh, seen, tl.dot(g16, third))
        h2 = tl.maximum(h2, 0.0, propagate_nan=tl.PropagateNan.ALL).to(tl.float16)
        h3 = tl.maximum(tl.dot(h2, fourth), 0.0, propagate_nan=tl.PropagateNan.ALL).to(tl.float16)
        # The slope of a sigmoid without 1 - value, which is 0 where the value rounds to 1.
        a = tl.exp(-tl.abs(tl.dot(h3, fifth)))
        slope = a / ((1.0 + a) * (1.0 + a))
        d = tl.load(by_rgb + i[:, None] * 3 + column, mask=valid[:, None] & (column < 3), other=0.0) * slope
        d_out = (d * scale).to(tl.float16)
        d_fifth = tl.dot(tl.trans(h3), d_out, d_fifth)
        d = _half(tl.where(h3 > 0, tl.dot(d_out, tl.trans(fifth)), 0.0))
        d_fourth = tl.dot(tl.trans(h2), d, d_fourth)
        d = _half(tl.where(h2 > 0, tl.dot(d, tl.trans(fourth)), 0.0))
        d_third = tl.dot(tl.trans(g16), d, d_third)
        d_seen = tl.dot(tl.trans(sh), d, d_seen)
        if RAYS_LEARN:
            of_harmonics = tl.dot(d, tl.trans(seen)) / scale
            along_x, along_y, along_z = harmonics_slopes(dx, dy, dz, column, DEGREE)
            tl.store(by_direction + i * 3, tl.sum(of_harmonics * along_x, 1), mask=valid)
            tl.store(by_direction + i * 3 + 1, tl.sum(of_harmonics * along_y, 1), mask=valid)
            tl.store(by_direction + i * 3 + 2, tl.sum(of_harmonics * along_z, 1), mask=valid)
        d_log = tl.load(by_density + i, mask=valid, other=0.0) * density * scale
        d_g = _half(tl.dot(d, tl.trans(third)) + tl.where(column == 0, d_log[:, None], 0.0))
        d_second = tl.dot(tl.trans(h1), d_g, d_second)
        d = _half(tl.where(h1 > 0, tl.dot(d_g, tl.trans(second)), 0.0))
        d_first = tl.dot(tl.trans(x), d, d_first)
        d_x = _half(tl.dot(d, tl.trans(first)))
        tl.store(by_encoded + i[:, None] * 32 + code[None, :], d_x, mask=valid[:, None])
    wide, out, unscale = tl.arange(0, H), tl.arange(0, 16), 1.0 / scale
    tl.atomic_add(by_w1 + wide[None, :] * 32 + code[:, None], d_first * unscale, sem="relaxed")
    tl.atomic_add(by_w2 + out[None, :] * H + wide[:, None], d_second * unscale, sem="relaxed")
    tl.atomic_add(by_c1 + wide[None, :] * 32 + out[:, None], d_third * unscale, sem="relaxed")
    tl.atomic_add(by_c1 + 16 + wide[None, :] * 32 + out[:, None], d_seen * unscale, sem="relaxed")
    tl.atomic_add(by_c2 + wide[None, :] * H + wide[:, None], d_fourth * unscale, sem="relaxed")
    tl.atomic_add(by_c3 + out[None, :] * H + wide[:, None], d_fifth * unscale, mask=(out < 3)[None, :], sem="relaxed")


def density(encoded: Tensor, layers: tuple[Tensor, ...], *, count: Tensor | None = None) -> Tensor:
    """Compute `reference.density` of codes (N, 32) in float16, without gradients.

    Args:
        count: () int64 on the device: number of valid codes, all if None; the densities of the rest are undefined.
    """
    out = torch.empty(len(encoded), device=encoded.device)
    launch(
        _density, programs(len(encoded), encoded.device), encoded, *plain(layers[:2]), out,
        len(encoded) if count is None else count, H=len(layers[0]), COUNT_ON_DEVICE=count is not None, BLOCK=BLOCK,
    )  # fmt: skip
    return out


def radiance(
    encoded: Tensor, directions: Tensor, rays: Tensor, layers: tuple[Tensor, ...], *, degree: int
) -> tuple[Tensor, Tensor]:
    """Compute `reference.radiance` of codes (N, 32) in float16 along directions (R, 3) of rays (N,); no gradients."""
    density, rgb = torch.empty(len(encoded), device=encoded.device), torch.empty(len(encoded), 3, device=encoded.device)
    launch(
        _forward, programs(len(encoded), encoded.device), encoded, directions, rays, *plain(layers), density, rgb,
        len(encoded), H=len(layers[0]), DEGREE=degree, BLOCK=BLOCK,
    )  # fmt: skip
    return density, rgb


def radiance_gradients(
    encoded: Tensor,
    directions: Tensor,
    rays: Tensor,
    layers: tuple[Tensor, ...],
    *,
    degree: int,
    density: Tensor,
    by_density: Tensor,
    by_rgb: Tensor,
    rays_learn: bool,
) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, ...]]:
    """Compute the gradients of `radiance`.

    Returns:
        gradient by codes (N, 32) in float16, multiplied by a scale; this scale (1,); gradient by directions of samples
        (N, 3), or (0, 3) unless `rays_learn`; gradients by layers.
    """
    samples, device = len(encoded), encoded.device
    sizes = [layer.numel() for layer in layers]
    # One buffer for the gradients of the layers and the largest one, as zeroing a buffer is a launch.
    flat = torch.zeros(sum(sizes) + 1, device=device)
    *parts, largest = flat.split([*sizes, 1])
    of_layers = tuple(part.view(layer.shape) for part, layer in zip(parts, layers, strict=True))
    by_encoded = torch.empty(samples, WIDTH, dtype=torch.float16, device=device)
    by_direction = torch.empty(samples if rays_learn else 0, 3, device=device)
    scale = torch.empty(1, device=device)
    launch(
        _largest, (blocks(samples, 1024),), by_density, density, by_rgb, largest, samples, BLOCK=1024
    )  # fmt: skip
    launch(
        _backward, programs(samples, device), encoded, directions, rays, *plain(layers), by_density, by_rgb, largest,
        by_encoded, by_direction, *of_layers, scale, samples, H=len(layers[0]), DEGREE=degree, RAYS_LEARN=rays_learn,
        BLOCK=BLOCK, warps=4 if len(layers[0]) == 32 else 8,  # halves the registers for the sums of each thread
    )  # fmt: skip
    return by_encoded, scale, by_direction, of_layers


def plain(layers: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return the layers without gradients, as kernels read them."""
    return tuple(layer.detach().contiguous() for layer in layers)


def programs(samples: int, device: torch.device) -> tuple[int]:
    """Return the grid: as many programs as the device runs at a time, but no more than there are blocks."""
    return (min(blocks(samples, BLOCK), 4 * processors(device)),)


@functools.cache
def processors(device: torch.device) -> int:
    """Return the number of streaming multiprocessors; 1 in the interpreter."""
    return torch.cuda.get_device_properties(device).multi_processor_count if device.type == "cuda" else 1
