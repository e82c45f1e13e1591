"""Common parts of kernels along rays: a program owns some rays, and processes some samples of each at a time."""

import torch
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.triton_cuda.launch import Size, blocks, jit, launch

# Rays of a program, and samples of each that it processes together.
RAYS = Size.of(16, interpreted=64)
STEPS = 32
# A point with a component above FAR is scaled by SHRINK before its components are squared.
FAR = tl.constexpr(4294967296.0)
SHRINK = tl.constexpr(2.0**-66)


def blocks_of(rays: int) -> tuple[int]:
    """Return the grid of programs that own `RAYS` rays each."""
    return (blocks(rays, RAYS),)


@jit
def raised_norm(x, y, z):
    """Return the norm of a point, raised to at least 1."""
    largest = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))
    shrink = tl.where(largest > FAR, SHRINK, 1.0)
    u, v, w = x * shrink, y * shrink, z * shrink
    return tl.maximum(tl.sqrt(u * u + v * v + w * w) / shrink, 1.0)


@jit
def cube(x, y, z, CONTRACTION: tl.constexpr):
    """Return `grid_coordinates` of points; CONTRACTION is an index into `CONTRACTIONS`."""
    if CONTRACTION == 0:
        return x * 0.5 + 0.5, y * 0.5 + 0.5, z * 0.5 + 0.5
    else:
        norm = raised_norm(x, y, z)
        scale = (2.0 - 1.0 / norm) * 0.25
        return x / norm * scale + 0.5, y / norm * scale + 0.5, z / norm * scale + 0.5


@jit
def own_rays(offsets, rays, RAYS: tl.constexpr):
    """Return the rays (RAYS,) of this program, which of them exist, their first samples, the ends of their samples,
    excluded, and the most samples of a ray; the last three are 0 beyond the last ray."""
    ray = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    there = ray < rays
    first = tl.load(offsets + ray, mask=there, other=0)
    last = tl.load(offsets + ray + 1, mask=there, other=0)
    return ray, there, first, last, tl.max(last - first, 0).to(tl.int32)


@jit
def samples_at(first, last, step, STEPS: tl.constexpr):
    """Return the samples (RAYS, STEPS) of rays from number `step` of each on, and which of them exist."""
    i = first[:, None] + step + tl.arange(0, STEPS)[None, :]
    return i, i < last[:, None]


@jit
def load3(values, i, valid):
    """Return the three numbers of rows of `values`; 0 where they are not valid."""
    x = tl.load(values + i * 3, mask=valid, other=0.0)
    y = tl.load(values + i * 3 + 1, mask=valid, other=0.0)
    return x, y, tl.load(values + i * 3 + 2, mask=valid, other=0.0)


@jit
def store3(values, i, valid, x, y, z):
    """Write the three numbers of rows of `values`."""
    tl.store(values + i * 3, x, mask=valid)
    tl.store(values + i * 3 + 1, y, mask=valid)
    tl.store(values + i * 3 + 2, z, mask=valid)


@jit
def _ray_indices(offsets, out, rays, RAYS: tl.constexpr, STEPS: tl.constexpr):
    ray, _, first, last, longest = own_rays(offsets, rays, RAYS)
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        owner = tl.zeros([RAYS, STEPS], tl.int64) + ray[:, None]
        tl.store(out + i, owner, mask=valid)


def fill_ray_indices(offsets: Tensor, out: Tensor) -> None:
    """Write the ray of each sample to `out`, from offsets (R + 1,)."""
    rays = len(offsets) - 1
    launch(_ray_indices, blocks_of(rays), offsets, out, rays, RAYS=RAYS, STEPS=STEPS)


def ray_indices(offsets: Tensor, samples: int | None = None) -> Tensor:
    """See `reference.ray_indices`; `samples` is the number of samples, if the host knows it."""
    out = torch.empty(int(offsets[-1]) if samples is None else samples, dtype=torch.int64, device=offsets.device)
    fill_ray_indices(offsets, out)
    return out


@jit
def _sum_rows(values, offsets, out, rays, COLUMNS: tl.constexpr, RAYS: tl.constexpr, STEPS: tl.constexpr):
    ray, there, first, last, longest = own_rays(offsets, rays, RAYS)
    for column in tl.static_range(COLUMNS):
        total = tl.zeros([RAYS], tl.float32)
        for step in range(0, longest, STEPS):
            i, valid = samples_at(first, last, step, STEPS)
            total += tl.sum(tl.load(values + i * COLUMNS + column, mask=valid, other=0.0), 1)
        tl.store(out + ray * COLUMNS + column, total, mask=there)


def sum_along_rays(values: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.sum_along_rays`; for rows (N, C), without gradients."""
    rays = len(offsets) - 1
    out = torch.empty(rays, values.shape[1], device=values.device)
    launch(_sum_rows, blocks_of(rays), values, offsets, out, rays, COLUMNS=values.shape[1], RAYS=RAYS, STEPS=STEPS)
    return out
