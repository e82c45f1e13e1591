"""Compositing on a GPU: a program owns some rays, and processes some samples of each at a time, in float32.

Same operations as in `reference`. Sums in front of a sample run over the samples shifted by one place, and sums behind
it likewise from the far end: nothing is ever subtracted from a sum, nor divided by a transmittance.
"""

from typing import Any

import torch
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.triton_cuda.launch import Size, blocks, jit, launch
from nerfcli.kernels.triton_cuda.rays import RAYS, STEPS, blocks_of, load3, own_rays, samples_at, store3

# Distances that a program contracts.
BLOCK = Size.of(1024, interpreted=4096)


@jit
def absorbed(x):
    """Return 1 - exp(-x), at full precision for small x: below 1/2 by its series, whose next term is 1e-8 of it."""
    y = tl.minimum(x, 0.5)
    series = 1.0 - y * (0.125 - y * 0.01388888888888889)
    series = 1.0 - y * 0.16666666666666666 * (1.0 - y * 0.14285714285714285 * series)
    series = 1.0 - y * 0.25 * (1.0 - y * 0.2 * series)
    series = y * (1.0 - y * 0.5 * (1.0 - y * 0.3333333333333333 * series))
    return tl.where(x < 0.5, series, 1.0 - tl.exp(-x))


@jit
def thickness(density, lengths, i, valid):
    """Return optical depths of samples; 0 where they are not valid."""
    return tl.load(density + i, mask=valid, other=0.0) * tl.load(lengths + i, mask=valid, other=0.0)


@jit
def _depth_before(
    density, lengths, offsets, out, rays, RAYS: tl.constexpr, STEPS: tl.constexpr
):  # fmt: skip
    _, _, first, last, longest = own_rays(offsets, rays, RAYS)
    depth = tl.zeros([RAYS], tl.float32)
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        ahead = thickness(density, lengths, i - 1, valid & (i > first[:, None]))
        tl.store(out + i, depth[:, None] + tl.cumsum(ahead, 1), mask=valid)
        depth += tl.sum(ahead, 1)


@jit
def _forward(
    density, rgb, lengths, offsets, background, colour, transmittance, weights,
    rays, COLOURS: tl.constexpr, RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    ray, there, first, last, longest = own_rays(offsets, rays, RAYS)
    depth, total = tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32)
    red, green, blue = (tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32))
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        own = thickness(density, lengths, i, valid)
        ahead = thickness(density, lengths, i - 1, valid & (i > first[:, None]))
        weight = tl.exp(-(depth[:, None] + tl.cumsum(ahead, 1))) * absorbed(own)
        tl.store(weights + i, weight, mask=valid)
        if COLOURS:
            r, g, b = load3(rgb, i, valid)
            red += tl.sum(weight * r, 1)
            green += tl.sum(weight * g, 1)
            blue += tl.sum(weight * b, 1)
        depth += tl.sum(ahead, 1)
        total += tl.sum(own, 1)
    left = tl.exp(-total)
    tl.store(transmittance + ray, left, mask=there)
    if COLOURS:
        r, g, b = load3(background, ray, there)
        store3(colour, ray, there, red + left * r, green + left * g, blue + left * b)


@jit
def _worth(rgb, by_weight, i, valid, red, green, blue):
    """Return the derivative of the loss by weights, of colours `rgb` and by themselves."""
    r, g, b = load3(rgb, i, valid)
    return tl.load(by_weight + i, mask=valid, other=0.0) + red * r + green * g + blue * b


@jit
def _backward(
    density, rgb, lengths, offsets, background, transmittance, weights,
    by_colour, by_transmittance, by_weight, by_density, by_rgb, rays,
    RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    ray, there, first, last, longest = own_rays(offsets, rays, RAYS)
    red, green, blue = load3(by_colour, ray, there)
    # Change of the loss by the light that passes: d loss / d T behind the last sample, times that T.
    behind = _worth(background, by_transmittance, ray, there, red, green, blue)
    behind *= tl.load(transmittance + ray, mask=there, other=0.0)
    depth = tl.zeros([RAYS], tl.float32)
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        own = thickness(density, lengths, i, valid)
        # The transmittance behind the sample, until its gradient replaces it.
        tl.store(by_density + i, tl.exp(-(depth[:, None] + tl.cumsum(own, 1))), mask=valid)
        depth += tl.sum(own, 1)
    tl.debug_barrier()
    blocks = tl.cdiv(longest, STEPS)
    for block in range(blocks):
        i, valid = samples_at(first, last, (blocks - 1 - block) * STEPS, STEPS)
        value = _worth(rgb, by_weight, i, valid, red[:, None], green[:, None], blue[:, None])
        weight = tl.load(weights + i, mask=valid, other=0.0)
        further = valid & (i + 1 < last[:, None])
        gained = _worth(rgb, by_weight, i + 1, further, red[:, None], green[:, None], blue[:, None])
        gained *= tl.load(weights + i + 1, mask=further, other=0.0)
        after = behind[:, None] + tl.cumsum(gained, 1, reverse=True)
        length = tl.load(lengths + i, mask=valid, other=0.0)
        passing = tl.load(by_density + i, mask=valid, other=0.0)
        tl.store(by_density + i, length * (passing * value - after), mask=valid)
        store3(by_rgb, i, valid, weight * red[:, None], weight * green[:, None], weight * blue[:, None])
        behind += tl.sum(gained, 1)


@jit
def _gaps(starts, ends, i, valid):
    """Return gaps between midpoints of samples and those one place before; differences first: exact far away."""
    near = tl.load(starts + i, mask=valid, other=0.0) - tl.load(starts + i - 1, mask=valid, other=0.0)
    return (near + (tl.load(ends + i, mask=valid, other=0.0) - tl.load(ends + i - 1, mask=valid, other=0.0))) * 0.5


@jit
def _distortion(
    weights, starts, ends, offsets, ahead_out, out, rays, RAYS: tl.constexpr,
    STEPS: tl.constexpr,
):  # fmt: skip
    """Sum 2 sum_i w_i D_i + ..., with D_i = sum_(j<i) w_j (m_i - m_j) = D_(i-1) + (m_i - m_(i-1)) sum_(j<i) w_j."""
    ray, there, first, last, longest = own_rays(offsets, rays, RAYS)
    mass, apart = tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32)
    total = tl.zeros([RAYS], tl.float32)
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        later = valid & (i > first[:, None])
        ahead = tl.load(weights + i - 1, mask=later, other=0.0)
        gap = _gaps(starts, ends, i, later)
        terms = gap * (mass[:, None] + tl.cumsum(ahead, 1))
        distances = apart[:, None] + tl.cumsum(terms, 1)
        tl.store(ahead_out + i, distances, mask=valid)
        weight = tl.load(weights + i, mask=valid, other=0.0)
        length = tl.load(ends + i, mask=valid, other=0.0) - tl.load(starts + i, mask=valid, other=0.0)
        total += tl.sum(weight * (2.0 * distances + weight * length / 3.0), 1)
        mass += tl.sum(ahead, 1)
        apart += tl.sum(terms, 1)
    tl.store(out + ray, total, mask=there)


@jit
def _distortion_backward(
    weights, starts, ends, offsets, ahead, gradient, out, rays,
    RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    """Write g (2 (D_i + D'_i) + ...), with D' like D but from the far end of the ray."""
    ray, there, first, last, longest = own_rays(offsets, rays, RAYS)
    blocks = tl.cdiv(longest, STEPS)
    g = tl.load(gradient + ray, mask=there, other=0.0)[:, None] * 2.0
    mass, apart = tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32)
    for block in range(blocks):
        i, valid = samples_at(first, last, (blocks - 1 - block) * STEPS, STEPS)
        further = valid & (i + 1 < last[:, None])
        behind = tl.load(weights + i + 1, mask=further, other=0.0)
        gap = _gaps(starts, ends, i + 1, further)
        terms = gap * (mass[:, None] + tl.cumsum(behind, 1, reverse=True))
        distances = apart[:, None] + tl.cumsum(terms, 1, reverse=True)
        distances += tl.load(ahead + i, mask=valid, other=0.0)
        length = tl.load(ends + i, mask=valid, other=0.0) - tl.load(starts + i, mask=valid, other=0.0)
        own = tl.load(weights + i, mask=valid, other=0.0) * length / 3.0
        tl.store(out + i, g * (distances + own), mask=valid)
        mass += tl.sum(behind, 1)
        apart += tl.sum(terms, 1)


@jit
def _contract(starts, ends, near, far, samples, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < samples
    start, end = tl.load(starts + i, mask=valid, other=1.0), tl.load(ends + i, mask=valid, other=1.0)
    tl.store(near + i, tl.where(start <= 1.0, start, 2.0 - 1.0 / tl.maximum(start, 1.0)) * 0.5, mask=valid)
    tl.store(far + i, tl.where(end <= 1.0, end, 2.0 - 1.0 / tl.maximum(end, 1.0)) * 0.5, mask=valid)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, density: Tensor, rgb: Tensor, lengths: Tensor, offsets: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        density, rgb, lengths = (x.detach().contiguous() for x in (density, rgb, lengths))
        rays, device = len(offsets) - 1, density.device
        background = background.detach().expand(rays, 3).contiguous()
        colour, transmittance = torch.empty(rays, 3, device=device), torch.empty(rays, device=device)
        weights = torch.empty_like(density)
        launch(
            _forward, blocks_of(rays), density, rgb, lengths, offsets, background, colour, transmittance, weights, rays,
            COLOURS=True, RAYS=RAYS, STEPS=STEPS,
        )  # fmt: skip
        ctx.save_for_backward(density, rgb, lengths, offsets, background, transmittance, weights)
        return colour, transmittance, weights

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        density, rgb = ctx.saved_tensors[:2]
        out = torch.empty_like(density), torch.empty_like(rgb)
        rays = len(ctx.saved_tensors[3]) - 1
        launch(
            _backward, blocks_of(rays), *ctx.saved_tensors, *(g.contiguous() for g in gradients), *out, rays,
            RAYS=RAYS, STEPS=STEPS,
        )  # fmt: skip
        return *out, None, None, None


class _Distortion(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
        weights, starts, ends = (x.detach().contiguous() for x in (weights, starts, ends))
        rays = len(offsets) - 1
        ahead, out = torch.empty_like(weights), torch.empty(rays, device=weights.device)
        launch(
            _distortion, blocks_of(rays), weights, starts, ends, offsets, ahead, out, rays, RAYS=RAYS, STEPS=STEPS
        )  # fmt: skip
        ctx.save_for_backward(weights, starts, ends, offsets, ahead)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        out = torch.empty_like(ctx.saved_tensors[0])
        rays = len(ctx.saved_tensors[3]) - 1
        launch(
            _distortion_backward, blocks_of(rays), *ctx.saved_tensors, gradients[0].contiguous(), out, rays,
            RAYS=RAYS, STEPS=STEPS,
        )  # fmt: skip
        return out, None, None, None


def composite(
    density: Tensor, rgb: Tensor, lengths: Tensor, *, offsets: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.composite`; float32, differentiable in density and rgb."""
    return _Composite.apply(density, rgb, lengths, offsets, background)


def distortion(weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.distortion`; float32, differentiable in the weights."""
    return _Distortion.apply(weights, starts, ends, offsets)


def contracted_distances(starts: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """Return `reference.contracted_distance` of both ends of intervals, in one launch instead of fourteen."""
    near, far, samples = torch.empty_like(starts), torch.empty_like(ends), len(starts)
    launch(
        _contract, (blocks(samples, BLOCK),), starts.contiguous(), ends.contiguous(), near, far, samples, BLOCK=BLOCK
    )  # fmt: skip
    return near, far


def optical_depth_before(density: Tensor, lengths: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.optical_depth_before`; float32, without gradients."""
    out, rays = torch.empty_like(density), len(offsets) - 1
    launch(
        _depth_before, blocks_of(rays), density.detach().contiguous(), lengths.contiguous(), offsets, out, rays,
        RAYS=RAYS, STEPS=STEPS,
    )  # fmt: skip
    return out


def interval_weights(density: Tensor, lengths: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """See `reference.interval_weights`; float32, without gradients."""
    density, rays = density.detach().contiguous(), len(offsets) - 1
    weights, transmittance = torch.empty_like(density), torch.empty(rays, device=density.device)
    launch(
        _forward, blocks_of(rays), density, density, lengths.contiguous(), offsets, density, density, transmittance,
        weights, rays, COLOURS=False, RAYS=RAYS, STEPS=STEPS,
    )  # fmt: skip
    return weights, transmittance
