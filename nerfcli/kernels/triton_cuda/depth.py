"""Where the light of rays is absorbed, on a GPU: mean, spread, heaviest interval and quantiles, in float32.

Same operation as `reference.ray_termination`. For mean and spread, positions are relative to the heaviest interval: a
distant, thin surface is narrower than its distance's last digit. Three passes go along each ray, as sums of squares
would cancel; one more for each quantile.
"""

import math

import torch
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.interface import RayTermination
from nerfcli.kernels.reference.depth import SERIES_BELOW, VARIANCE_SERIES, VARIANCE_SERIES_BELOW
from nerfcli.kernels.triton_cuda.compositing import absorbed
from nerfcli.kernels.triton_cuda.hash_grid import device_floats
from nerfcli.kernels.triton_cuda.launch import jit, launch
from nerfcli.kernels.triton_cuda.rays import RAYS, STEPS, blocks_of, own_rays, samples_at

THIN, VARIANCE_THIN = tl.constexpr(SERIES_BELOW), tl.constexpr(VARIANCE_SERIES_BELOW)
# Six terms reach float32's precision at the limit.
V0, V1, V2, V3, V4, V5 = (tl.constexpr(value) for value in VARIANCE_SERIES[:6])
NOWHERE = tl.constexpr(2**30)


@jit
def _mean_fraction(x, alpha):
    """Return `depth.mean_fraction` of optical depths x with opacity alpha."""
    y = tl.minimum(x, THIN)
    x2 = y * y
    series = 0.5 - y * (1 / 12 - x2 * (1 / 720 - x2 * (1 / 30240 - x2 * (1 / 1209600))))
    thick = tl.where(x < THIN, 1.0, x)
    return tl.where(x < THIN, series, 1.0 / thick - (1.0 - alpha) / tl.where(x < THIN, 1.0, alpha))


@jit
def _variance_fraction(x, alpha):
    """Return `depth.variance_fraction` of optical depths x with opacity alpha."""
    y = tl.minimum(x, VARIANCE_THIN)
    x2 = y * y
    series = V0 + x2 * (V1 + x2 * (V2 + x2 * (V3 + x2 * (V4 + x2 * V5))))
    thick = tl.where(x < VARIANCE_THIN, 1.0, x)
    opaque = tl.where(x < VARIANCE_THIN, 1.0, alpha)
    return tl.where(x < VARIANCE_THIN, series, 1.0 / (thick * thick) - (1.0 - alpha) / (opaque * opaque))


@jit
def _ray_termination(
    density, starts, ends, offsets, targets, weights, opacity, transmittance,
    mean, spread, at_peak, quantiles, rays, FRACTIONS: tl.constexpr,
    RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    ray, there, first, last, longest = own_rays(offsets, rays, RAYS)
    depth, total, mass = (tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32))
    most = tl.zeros([RAYS], tl.float32)
    where = tl.zeros([RAYS], tl.int64)
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        later = valid & (i > first[:, None])
        length = tl.load(ends + i, mask=valid, other=0.0) - tl.load(starts + i, mask=valid, other=0.0)
        own = tl.load(density + i, mask=valid, other=0.0) * length
        length = tl.load(ends + i - 1, mask=later, other=0.0) - tl.load(starts + i - 1, mask=later, other=0.0)
        ahead = tl.load(density + i - 1, mask=later, other=0.0) * length
        weight = tl.exp(-(depth[:, None] + tl.cumsum(ahead, 1))) * absorbed(own)
        tl.store(weights + i, weight, mask=valid)
        peak = tl.max(weight, 1)
        place = tl.min(tl.where(valid & (weight == peak[:, None]), tl.arange(0, STEPS)[None, :], NOWHERE), 1)
        where = tl.where(peak > most, first + step + place, where)
        most = tl.maximum(most, peak)
        depth += tl.sum(ahead, 1)
        total += tl.sum(own, 1)
        mass += tl.sum(weight, 1)
    tl.debug_barrier()
    ended = there & (most > 0.0)
    start = tl.load(starts + where, mask=ended, other=0.0)
    reach = tl.load(ends + where, mask=ended, other=0.0) - start
    heavy = tl.load(density + where, mask=ended, other=0.0) * reach
    inside = reach * _mean_fraction(heavy, absorbed(heavy))
    mass = tl.where(ended, mass, 1.0)
    moment = tl.zeros([RAYS], tl.float32)
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        at = tl.load(starts + i, mask=valid, other=0.0)
        span = tl.load(ends + i, mask=valid, other=0.0) - at
        x = tl.load(density + i, mask=valid, other=0.0) * span
        place = (at - start[:, None]) + (span * _mean_fraction(x, absorbed(x)) - inside[:, None])
        moment += tl.sum(tl.load(weights + i, mask=valid, other=0.0) * place, 1)
    middle = moment / mass
    squares = tl.zeros([RAYS], tl.float32)
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        at = tl.load(starts + i, mask=valid, other=0.0)
        span = tl.load(ends + i, mask=valid, other=0.0) - at
        x = tl.load(density + i, mask=valid, other=0.0) * span
        alpha = absorbed(x)
        off = (at - start[:, None]) + (span * _mean_fraction(x, alpha) - inside[:, None]) - middle[:, None]
        apart = span * span * _variance_fraction(x, alpha) + off * off
        squares += tl.sum(tl.load(weights + i, mask=valid, other=0.0) * apart, 1)
    undefined = float("nan")
    tl.store(opacity + ray, absorbed(total), mask=there)
    tl.store(transmittance + ray, tl.exp(-total), mask=there)
    tl.store(mean + ray, tl.where(ended, start + inside + middle, undefined), mask=there)
    tl.store(spread + ray, tl.where(ended, tl.sqrt(squares / mass), undefined), mask=there)
    tl.store(at_peak + ray, tl.where(ended, start + inside, undefined), mask=there)
    for fraction in range(FRACTIONS):
        target = tl.load(targets + fraction)
        depth = tl.zeros([RAYS], tl.float32)
        found = tl.zeros([RAYS], tl.int32) + NOWHERE
        crossing = tl.zeros([RAYS], tl.float32)
        for step in range(0, longest, STEPS):
            i, valid = samples_at(first, last, step, STEPS)
            later = valid & (i > first[:, None])
            at = tl.load(starts + i, mask=valid, other=0.0)
            span = tl.load(ends + i, mask=valid, other=0.0) - at
            sigma = tl.load(density + i, mask=valid, other=0.0)
            length = tl.load(ends + i - 1, mask=later, other=0.0) - tl.load(starts + i - 1, mask=later, other=0.0)
            ahead = tl.load(density + i - 1, mask=later, other=0.0) * length
            before = depth[:, None] + tl.cumsum(ahead, 1)
            number = step + tl.arange(0, STEPS)[None, :]
            crossed = valid & (before + sigma * span >= target)
            place = tl.min(tl.where(crossed, number, NOWHERE), 1)
            within = (target - before) / tl.where(sigma > 0.0, sigma, 1.0)
            distance = at + tl.minimum(tl.maximum(within, 0.0), span)
            chosen = tl.sum(tl.where(number == place[:, None], distance, 0.0), 1)
            crossing = tl.where(place < found, chosen, crossing)
            found = tl.minimum(place, found)
            depth += tl.sum(ahead, 1)
        tl.store(quantiles + ray * FRACTIONS + fraction, tl.where(found < NOWHERE, crossing, undefined), mask=there)


def ray_termination(
    density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, fractions: tuple[float, ...]
) -> RayTermination:
    """See `reference.ray_termination`; float32, without gradients."""
    density, starts, ends = (x.detach().contiguous() for x in (density, starts, ends))
    rays, device = len(offsets) - 1, density.device
    targets = device_floats(tuple(-math.log1p(-fraction) for fraction in fractions) or (0.0,), device)
    columns = [torch.empty(rays, device=device) for _ in range(5)]
    quantiles = torch.empty(rays, len(fractions), device=device)
    launch(
        _ray_termination, blocks_of(rays), density, starts, ends, offsets, targets, torch.empty_like(density), *columns,
        quantiles, rays, FRACTIONS=len(fractions), RAYS=RAYS, STEPS=STEPS,
    )  # fmt: skip
    return RayTermination(*columns, quantiles=quantiles)
