"""The two small networks of the field on CPU threads: tiles of samples pass through all layers inside the L1 cache.

Same operation as `reference.radiance`. Only the inputs are kept for the backward pass: recomputing the hidden layers
of a tile is cheaper than loading them from memory. Each thread sums its own weight gradients; the sums are added in the
order of the threads.
"""

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.activations import LOG_DENSITY_LIMIT
from nerfcli.kernels.interface import OUT, WIDTH
from nerfcli.kernels.numba_cpu.exponential import exponential, sigmoid, sigmoid_slope
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.vector import (
    ROWS_16,
    ROWS_32,
    add_product_16,
    add_product_32,
    product_16,
    product_32,
    rectified_product_32,
)

TILE = 64
LIMIT = np.float32(LOG_DENSITY_LIMIT)

# Offsets of each layer's weights in the flat arrays: encoded-hidden, hidden-density, inputs-hidden, hidden-hidden,
# hidden-colour; and their end.
D1, D2, C1, C2, C3, WEIGHTS = accumulate((WIDTH * outputs for outputs in (WIDTH, OUT, WIDTH, WIDTH, OUT)), initial=0)


@numba.njit(nogil=True, error_model="numpy")
def _layer_32(x: Any, weights: Any, at: Any, out: Any) -> None:
    """out (TILE, 32) = x (TILE, 32) @ weights[at:] (32, 32)."""
    for row in range(0, TILE, ROWS_32):
        product_32(x, row * WIDTH, WIDTH, 1, weights, at, WIDTH, WIDTH, out, row * WIDTH, WIDTH)


@numba.njit(nogil=True, error_model="numpy")
def _rectified_32(x: Any, weights: Any, at: Any, out: Any, first: Any = 0) -> None:
    """out (TILE, 32) = max(0, x[first:] (TILE, 32) @ weights[at:] (32, 32))."""
    for row in range(0, TILE, ROWS_32):
        rectified_product_32(x, (first + row) * WIDTH, WIDTH, 1, weights, at, WIDTH, WIDTH, out, row * WIDTH, WIDTH)


@numba.njit(nogil=True, error_model="numpy")
def _layer_16(x: Any, weights: Any, at: Any, out: Any) -> None:
    """out (TILE, 16) = x (TILE, 32) @ weights[at:] (32, 16)."""
    for row in range(0, TILE, ROWS_16):
        product_16(x, row * WIDTH, WIDTH, 1, weights, at, OUT, WIDTH, out, row * OUT, OUT)


@numba.njit(nogil=True, error_model="numpy")
def _back_from_16(g: Any, weights: Any, at: Any, depth: Any, out: Any) -> None:
    """out (TILE, 32) = g (TILE, 16)[:, :depth] @ weights[at:] (depth, 32)."""
    for row in range(0, TILE, ROWS_32):
        product_32(g, row * OUT, OUT, 1, weights, at, WIDTH, depth, out, row * WIDTH, WIDTH)


@numba.njit(nogil=True, error_model="numpy")
def _weights_32(x: Any, g: Any, sums: Any, at: Any) -> None:
    """sums[at:] (32, 32) += x (TILE, 32)^T @ g (TILE, 32)."""
    for row in range(0, WIDTH, ROWS_32):
        add_product_32(x, row, 1, WIDTH, g, 0, WIDTH, TILE, sums, at + row * WIDTH, WIDTH)


@numba.njit(nogil=True, error_model="numpy")
def _weights_16(x: Any, g: Any, sums: Any, at: Any) -> None:
    """sums[at:] (32, 16) += x (TILE, 32)^T @ g (TILE, 16)."""
    for row in range(0, WIDTH, ROWS_16):
        add_product_16(x, row, 1, WIDTH, g, 0, OUT, TILE, sums, at + row * OUT, OUT)


@numba.njit(inline="always")
def _mask(g: Any, h: Any) -> None:
    """Zero the gradients g where the rectified values h are 0."""
    for i in range(TILE * WIDTH):
        g[i] = np.float32(0) if h[i] <= np.float32(0) else g[i]  # a store under a branch would not be vectorised


@numba.njit(inline="always")
def _load_rows(source: Any, first: Any, count: Any, out: Any) -> None:
    """Copy `count` rows of `source` from `first` on to `out`, and fill the rest with zeros."""
    for i in range(count):
        for j in range(WIDTH):
            out[i * WIDTH + j] = source[first + i, j]
    out[count * WIDTH :] = np.float32(0)


@numba.njit(inline="always")
def _colour_inputs(geometry: Any, harmonics: Any, rays: Any, first: Any, count: Any, out: Any) -> None:
    """Write the 16 outputs of the density network beside the 16 harmonics of the sample's ray."""
    for i in range(count):
        ray = rays[first + i]
        for j in range(OUT):
            out[i * WIDTH + j] = geometry[i * OUT + j]
            out[i * WIDTH + OUT + j] = harmonics[ray, j]
    out[count * WIDTH :] = np.float32(0)


@numba.njit(inline="always")
def _densities(geometry: Any, density: Any) -> None:
    """Write the densities (TILE,) of the outputs (TILE, 16) of the density network."""
    for i in range(TILE):
        density[i] = geometry[i * OUT]
    for i in range(TILE):  # a loop of its own, so that it is vectorised
        density[i] = exponential(min(max(density[i], -LIMIT), LIMIT))


@numba.njit(inline="always")
def _channels(out: Any, channels: Any) -> None:
    """Write the three channels (TILE, 3) of the outputs (TILE, 16) of the colour network."""
    for i in range(TILE):
        for channel in range(3):
            channels[3 * i + channel] = out[i * OUT + channel]


@numba.njit(nogil=True, error_model="numpy")
def density_tile(encoded: Any, first: Any, weights: Any, h: Any, geometry: Any, density: Any) -> None:
    """Write the density network's outputs (TILE, 16) and the densities (TILE,) of a full tile of the flat `encoded`."""
    _rectified_32(encoded, weights, D1, h, first)
    _layer_16(h, weights, D2, geometry)
    _densities(geometry, density)


@numba.njit(nogil=True, error_model="numpy")
def density_range(
    encoded: Any, begin: Any, end: Any, weights: Any, x: Any, h: Any, geometry: Any, density: Any
) -> None:
    """Write the density of samples begin up to end; scratch space: x and h of TILE * WIDTH, geometry of TILE * OUT."""
    own = np.empty(TILE, np.float32)
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        _load_rows(encoded, first, count, x)
        density_tile(x, 0, weights, h, geometry, own)
        for i in range(count):
            density[first + i] = own[i]


@numba.njit(nogil=True, error_model="numpy")
def colour_range(inputs: Any, weights: Any, x: Any, h: Any, out: Any, channels: Any) -> None:
    """Write colours (3 TILE,) of a tile of `_colour_inputs`; scratch space: x, h of TILE * WIDTH, out of TILE * OUT."""
    _rectified_32(inputs, weights, C1, h)
    _rectified_32(h, weights, C2, x)
    _layer_16(x, weights, C3, out)
    _channels(out, channels)
    for i in range(3 * TILE):
        channels[i] = sigmoid(channels[i])


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _density_forward(encoded: Any, weights: Any, density: Any, threads: Any) -> None:
    samples = encoded.shape[0]
    tiles = (samples + TILE - 1) // TILE
    for thread in numba.prange(threads):
        x, h = np.empty(TILE * WIDTH, np.float32), np.empty(TILE * WIDTH, np.float32)
        geometry = np.empty(TILE * OUT, np.float32)
        first, last = thread * tiles // threads * TILE, min((thread + 1) * tiles // threads * TILE, samples)
        density_range(encoded, first, last, weights, x, h, geometry, density)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _radiance_forward(
    encoded: Any, harmonics: Any, rays: Any, weights: Any, density: Any, rgb: Any, threads: Any
) -> None:
    samples = encoded.shape[0]
    tiles = (samples + TILE - 1) // TILE
    for thread in numba.prange(threads):
        x, h = np.empty(TILE * WIDTH, np.float32), np.empty(TILE * WIDTH, np.float32)
        geometry, out = np.empty(TILE * OUT, np.float32), np.empty(TILE * OUT, np.float32)
        own, channels = np.empty(TILE, np.float32), np.empty(3 * TILE, np.float32)
        for tile in range(thread * tiles // threads, (thread + 1) * tiles // threads):
            first = tile * TILE
            count = min(TILE, samples - first)
            _load_rows(encoded, first, count, x)
            _rectified_32(x, weights, D1, h)
            _layer_16(h, weights, D2, geometry)
            _colour_inputs(geometry, harmonics, rays, first, count, x)
            colour_range(x, weights, x, h, out, channels)
            _densities(geometry, own)
            for i in range(count):
                density[first + i] = own[i]
            for i in range(3 * count):
                rgb[3 * first + i] = channels[i]


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _radiance_backward(
    encoded: Any,
    harmonics: Any,
    rays: Any,
    weights: Any,
    back: Any,
    density_gradient: Any,
    rgb_gradient: Any,
    encoded_gradient: Any,
    view_gradient: Any,
    sums: Any,
    threads: Any,
) -> None:
    """Write all gradients; `view_gradient`, of the harmonics of each sample, only if it has rows."""
    samples = encoded.shape[0]
    tiles = (samples + TILE - 1) // TILE
    for thread in numba.prange(threads):
        x, c0 = np.empty(TILE * WIDTH, np.float32), np.empty(TILE * WIDTH, np.float32)
        h1, h2 = np.empty(TILE * WIDTH, np.float32), np.empty(TILE * WIDTH, np.float32)
        h3 = np.empty(TILE * WIDTH, np.float32)
        g, g2 = np.empty(TILE * WIDTH, np.float32), np.empty(TILE * WIDTH, np.float32)
        geometry, out = np.empty(TILE * OUT, np.float32), np.empty(TILE * OUT, np.float32)
        g_out = np.empty(TILE * OUT, np.float32)
        own, channels = np.empty(TILE, np.float32), np.empty(3 * TILE, np.float32)
        total = sums[thread]
        for tile in range(thread * tiles // threads, (thread + 1) * tiles // threads):
            first = tile * TILE
            count = min(TILE, samples - first)
            _load_rows(encoded, first, count, x)
            _rectified_32(x, weights, D1, h1)
            _layer_16(h1, weights, D2, geometry)
            _colour_inputs(geometry, harmonics, rays, first, count, c0)
            _rectified_32(c0, weights, C1, h2)
            _rectified_32(h2, weights, C2, h3)

            _layer_16(h3, weights, C3, out)
            _channels(out, channels)
            for i in range(3 * TILE):
                channels[i] = sigmoid_slope(channels[i])
            g_out[:] = np.float32(0)
            for i in range(count):
                for channel in range(3):
                    g_out[i * OUT + channel] = rgb_gradient[first + i, channel] * channels[3 * i + channel]
            _weights_16(h3, g_out, total, C3)
            _back_from_16(g_out, back, C3, 3, g)
            _mask(g, h3)
            _weights_32(h2, g, total, C2)
            _layer_32(g, back, C2, g2)
            _mask(g2, h2)
            _weights_32(c0, g2, total, C1)
            _layer_32(g2, back, C1, g)
            for i in range(TILE):
                for j in range(OUT):
                    g_out[i * OUT + j] = g[i * WIDTH + j]
            if view_gradient.shape[0] > 0:
                for i in range(count):
                    for j in range(OUT):
                        view_gradient[first + i, j] = g[i * WIDTH + OUT + j]
            _densities(geometry, own)
            for i in range(count):
                g_out[i * OUT] += density_gradient[first + i] * own[i]
            _weights_16(h1, g_out, total, D2)
            _back_from_16(g_out, back, D2, OUT, g)
            _mask(g, h1)
            _weights_32(x, g, total, D1)
            _layer_32(g, back, D1, g2)
            for i in range(count):
                for j in range(WIDTH):
                    encoded_gradient[first + i, j] = g2[i * WIDTH + j]


def flat_weights(weights: Sequence[Tensor]) -> np.ndarray:
    """Return all layers as (inputs, outputs), outputs padded to a multiple of 16, in one array."""
    padded = [torch.nn.functional.pad(w.detach(), (0, 0, 0, -len(w) % OUT)) for w in weights]
    return torch.cat([w.t().reshape(-1) for w in padded]).numpy()


def _flat_back(weights: Sequence[Tensor]) -> np.ndarray:
    """Return all layers as (outputs, inputs), padded in the same way, as the backward pass reads them."""
    padded = [torch.nn.functional.pad(w.detach(), (0, 0, 0, -len(w) % OUT)) for w in weights]
    return torch.cat([w.reshape(-1) for w in padded]).numpy()


class _Radiance(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, encoded: Tensor, harmonics: Tensor, rays: Tensor, *weights: Tensor) -> tuple[Tensor, Tensor]:
        encoded, harmonics = encoded.detach().contiguous(), harmonics.detach().contiguous()
        density, rgb = torch.empty(len(encoded)), torch.empty(len(encoded), 3)
        _radiance_forward(
            encoded.numpy(), harmonics.numpy(), rays.numpy(), flat_weights(weights), density.numpy(),
            rgb.view(-1).numpy(), use_threads(),
        )  # fmt: skip
        ctx.save_for_backward(encoded, harmonics, rays, *weights)
        return density, rgb

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        encoded, harmonics, rays, *weights = ctx.saved_tensors
        threads = use_threads()
        encoded_gradient = torch.empty_like(encoded)
        view_gradient = encoded.new_empty(len(encoded) if ctx.needs_input_grad[1] else 0, OUT)
        sums = np.zeros((threads, WEIGHTS), np.float32)
        _radiance_backward(
            encoded.numpy(), harmonics.numpy(), rays.numpy(), flat_weights(weights), _flat_back(weights),
            gradients[0].contiguous().numpy(), gradients[1].contiguous().numpy(), encoded_gradient.numpy(),
            view_gradient.numpy(), sums, threads,
        )  # fmt: skip
        total = torch.from_numpy(sums.sum(0))
        slots = zip((D1, D2, C1, C2, C3), (D2, C1, C2, C3, WEIGHTS), weights, strict=True)
        by_layer = [total[a:b].view(WIDTH, -1).t()[: len(w)].contiguous() for a, b, w in slots]
        of_rays = None
        if ctx.needs_input_grad[1]:
            of_rays = torch.zeros_like(harmonics).index_add_(0, rays, view_gradient)
        return encoded_gradient, of_rays, None, *by_layer


def radiance(encoded: Tensor, harmonics: Tensor, rays: Tensor, weights: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """See `reference.radiance`; float32 on the CPU, differentiable in `encoded`, `harmonics` and the weights."""
    return _Radiance.apply(encoded, harmonics, rays, *weights)


def density(encoded: Tensor, weights: tuple[Tensor, ...]) -> Tensor:
    """See `reference.density`; float32 on the CPU, without gradients."""
    encoded = encoded.detach().contiguous()
    out = torch.empty(len(encoded))
    _density_forward(encoded.numpy(), flat_weights(weights[:2]), out.numpy(), use_threads())
    return out
