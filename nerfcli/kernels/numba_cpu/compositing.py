"""Compositing on CPU threads, a ray at a time, with the gradient in suffix form.

Same operations as in `reference`, for float32; running sums are kept in float64. The gradient with respect to a density
needs the colour of everything behind the sample: it is summed from the far end, so that nothing is ever divided by a
transmittance or subtracted from a total.
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.numba_cpu.threads import use_threads


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _depth_before(density: Any, lengths: Any, offsets: Any, out: Any) -> None:
    for ray in numba.prange(offsets.shape[0] - 1):
        depth = 0.0
        for i in range(offsets[ray], offsets[ray + 1]):
            out[i] = depth
            depth += np.float64(density[i]) * np.float64(lengths[i])


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _forward(
    density: Any, rgb: Any, lengths: Any, offsets: Any, background: Any, colour: Any, transmittance: Any, weights: Any
) -> None:
    for ray in numba.prange(offsets.shape[0] - 1):
        depth = 0.0
        red, green, blue = 0.0, 0.0, 0.0
        for i in range(offsets[ray], offsets[ray + 1]):
            own = np.float64(density[i]) * np.float64(lengths[i])
            weight = np.exp(-depth) * -np.expm1(-own)
            weights[i] = weight
            if rgb is not None:  # decided when this is compiled
                red += weight * rgb[i, 0]
                green += weight * rgb[i, 1]
                blue += weight * rgb[i, 2]
            depth += own
        left = np.exp(-depth)
        transmittance[ray] = left
        if rgb is not None:
            colour[ray, 0] = red + left * background[ray, 0]
            colour[ray, 1] = green + left * background[ray, 1]
            colour[ray, 2] = blue + left * background[ray, 2]


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _backward(
    density: Any,
    rgb: Any,
    lengths: Any,
    offsets: Any,
    background: Any,
    transmittance: Any,
    weights: Any,
    colour_gradient: Any,
    transmittance_gradient: Any,
    weights_gradient: Any,
    density_gradient: Any,
    rgb_gradient: Any,
) -> None:
    for ray in numba.prange(offsets.shape[0] - 1):
        first, last = offsets[ray], offsets[ray + 1]
        gr, gg, gb = colour_gradient[ray, 0], colour_gradient[ray, 1], colour_gradient[ray, 2]
        depth = 0.0
        for i in range(first, last):
            depth += np.float64(density[i]) * np.float64(lengths[i])
            density_gradient[i] = np.exp(-depth)  # the transmittance behind the sample, until its gradient replaces it
        # Change of the loss by the light that passes this sample: d loss / d T behind it, times that T.
        behind = np.float64(transmittance[ray]) * (
            gr * background[ray, 0] + gg * background[ray, 1] + gb * background[ray, 2] + transmittance_gradient[ray]
        )
        for i in range(last - 1, first - 1, -1):
            weight = weights[i]
            value = gr * rgb[i, 0] + gg * rgb[i, 1] + gb * rgb[i, 2] + weights_gradient[i]
            density_gradient[i] = lengths[i] * (density_gradient[i] * value - behind)
            behind += weight * value
            rgb_gradient[i, 0] = weight * gr
            rgb_gradient[i, 1] = weight * gg
            rgb_gradient[i, 2] = weight * gb


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _distortion(weights: Any, starts: Any, ends: Any, offsets: Any, out: Any) -> None:
    for ray in numba.prange(offsets.shape[0] - 1):
        total, mass, moment = 0.0, 0.0, 0.0
        for i in range(offsets[ray], offsets[ray + 1]):
            weight, middle = np.float64(weights[i]), (np.float64(starts[i]) + np.float64(ends[i])) * 0.5
            length = np.float64(ends[i]) - np.float64(starts[i])
            total += 2.0 * weight * (middle * mass - moment) + weight * weight * length / 3.0
            mass += weight
            moment += weight * middle
        out[ray] = total


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _distortion_backward(weights: Any, starts: Any, ends: Any, offsets: Any, gradient: Any, out: Any) -> None:
    for ray in numba.prange(offsets.shape[0] - 1):
        first, last = offsets[ray], offsets[ray + 1]
        behind, moment_behind = 0.0, 0.0
        for i in range(first, last):
            behind += weights[i]
            moment_behind += weights[i] * (np.float64(starts[i]) + np.float64(ends[i])) * 0.5
        before, moment_before = 0.0, 0.0
        for i in range(first, last):
            weight, middle = np.float64(weights[i]), (np.float64(starts[i]) + np.float64(ends[i])) * 0.5
            behind -= weight
            moment_behind -= weight * middle
            apart = middle * before - moment_before + moment_behind - middle * behind
            own = weight * (np.float64(ends[i]) - np.float64(starts[i])) / 3.0
            out[i] = gradient[ray] * 2.0 * (apart + own)
            before += weight
            moment_before += weight * middle


class _Distortion(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
        use_threads()
        weights, starts, ends = (x.detach().contiguous() for x in (weights, starts, ends))
        out = torch.empty(len(offsets) - 1)
        _distortion(*(x.numpy() for x in (weights, starts, ends, offsets, out)))
        ctx.save_for_backward(weights, starts, ends, offsets)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        use_threads()
        out = torch.empty_like(ctx.saved_tensors[0])
        _distortion_backward(*(x.contiguous().numpy() for x in (*ctx.saved_tensors, *gradients, out)))
        return out, None, None, None


def distortion(weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.distortion`; float32 on the CPU, differentiable in the weights."""
    return _Distortion.apply(weights, starts, ends, offsets)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, density: Tensor, rgb: Tensor, lengths: Tensor, offsets: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        use_threads()
        density, rgb, lengths = (x.detach().contiguous() for x in (density, rgb, lengths))
        rays = len(offsets) - 1
        background = background.detach().expand(rays, 3).contiguous()
        colour, transmittance, weights = torch.empty(rays, 3), torch.empty(rays), torch.empty_like(density)
        _forward(*(x.numpy() for x in (density, rgb, lengths, offsets, background, colour, transmittance, weights)))
        ctx.save_for_backward(density, rgb, lengths, offsets, background, transmittance, weights)
        return colour, transmittance, weights

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        use_threads()
        density, rgb = ctx.saved_tensors[:2]
        out = torch.empty_like(density), torch.empty_like(rgb)
        _backward(*(x.contiguous().numpy() for x in (*ctx.saved_tensors, *gradients, *out)))
        return *out, None, None, None


def composite(
    density: Tensor, rgb: Tensor, lengths: Tensor, *, offsets: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.composite`; float32 on the CPU, differentiable in density and rgb."""
    return _Composite.apply(density, rgb, lengths, offsets, background)


def optical_depth_before(density: Tensor, lengths: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.optical_depth_before`; float32 on the CPU, without gradients."""
    use_threads()
    out = torch.empty_like(density)
    _depth_before(density.contiguous().numpy(), lengths.contiguous().numpy(), offsets.numpy(), out.numpy())
    return out


def interval_weights(density: Tensor, lengths: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """See `reference.interval_weights`; float32 on the CPU, without gradients."""
    use_threads()
    weights, transmittance = torch.empty_like(density), torch.empty(len(offsets) - 1)
    given, spans = density.detach().contiguous().numpy(), lengths.contiguous().numpy()
    _forward(given, None, spans, offsets.numpy(), None, None, transmittance.numpy(), weights.numpy())
    return weights, transmittance
