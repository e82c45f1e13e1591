"""Gradients of the coordinates of samples with respect to their rays, from which cameras learn."""

import torch
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.contraction import CONTRACTIONS
from nerfcli.kernels.triton_cuda.launch import jit, launch
from nerfcli.kernels.triton_cuda.rays import RAYS, STEPS, blocks_of, load3, own_rays, raised_norm, samples_at, store3


@jit
def _back_from_cube(x, y, z, a, b, c, CONTRACTION: tl.constexpr):
    """Return the transposed Jacobian of `rays.cube` at (x, y, z), times (a, b, c).

    cube(p) = s(m) p / 4 + 1/2 with s(m) = (2 - 1/m) / m and m the norm, at least 1: the Jacobian is
    (s + s'(m) p grad(m)^T) / 4, where grad(m) is 0 inside.
    """
    if CONTRACTION == 0:
        return a * 0.5, b * 0.5, c * 0.5
    else:
        norm = raised_norm(x, y, z)
        inverse = 1.0 / norm
        scale = (2.0 - inverse) * inverse
        # In units of the norm, as squares of distant coordinates would overflow.
        u, v, w = x * inverse, y * inverse, z * inverse
        along = 2.0 * inverse * (inverse - 1.0) * (u * a + v * b + w * c)
        return (scale * a + along * u) * 0.25, (scale * b + along * v) * 0.25, (scale * c + along * w) * 0.25


@jit
def _backward(
    origins, directions, starts, ends, offsets, gradient, by_origin,
    by_direction, rays, CONTRACTION: tl.constexpr, RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    ray, there, first, last, longest = own_rays(offsets, rays, RAYS)
    ox, oy, oz = load3(origins, ray[:, None], there[:, None])
    dx, dy, dz = load3(directions, ray[:, None], there[:, None])
    ax, ay, az = (tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32))
    bx, by, bz = (tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32), tl.zeros([RAYS], tl.float32))
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        t = (tl.load(starts + i, mask=valid, other=0.0) + tl.load(ends + i, mask=valid, other=0.0)) * 0.5
        a, b, c = load3(gradient, i, valid)
        a, b, c = _back_from_cube(ox + dx * t, oy + dy * t, oz + dz * t, a, b, c, CONTRACTION)
        ax += tl.sum(a, 1)
        ay += tl.sum(b, 1)
        az += tl.sum(c, 1)
        bx += tl.sum(a * t, 1)
        by += tl.sum(b * t, 1)
        bz += tl.sum(c * t, 1)
    store3(by_origin, ray, there, ax, ay, az)
    store3(by_direction, ray, there, bx, by, bz)


def ray_gradients(
    origins: Tensor,
    directions: Tensor,
    starts: Tensor,
    ends: Tensor,
    *,
    offsets: Tensor,
    contraction: str,
    gradient: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the gradients (R, 3) by origins and directions, from those (N, 3) by `reference.sample_coordinates`."""
    given = [x.detach().contiguous() for x in (origins, directions, starts, ends, offsets, gradient)]
    by_origin, by_direction, count = torch.empty_like(given[0]), torch.empty_like(given[0]), len(origins)
    launch(
        _backward, blocks_of(count), *given, by_origin, by_direction, count,
        CONTRACTION=CONTRACTIONS.index(contraction), RAYS=RAYS, STEPS=STEPS,
    )  # fmt: skip
    return by_origin, by_direction
