"""Gradients of the coordinates of samples with respect to their rays, on CPU threads; a thread owns rays."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.contraction import CONTRACTIONS
from nerfcli.kernels.numba_cpu.threads import use_threads


@numba.njit(inline="always")
def _back_from_cube(x: Any, y: Any, z: Any, contraction: Any, a: Any, b: Any, c: Any) -> Any:
    """Return the transposed Jacobian of `rays.cube` at (x, y, z), times (a, b, c).

    cube(p) = s(m) p / 4 + 1/2 with s(m) = (2 - 1/m) / m and m the norm, at least 1: the Jacobian is
    (s + s'(m) p grad(m)^T) / 4, where grad(m) is 0 inside.
    """
    half, quarter, one, two = np.float32(0.5), np.float32(0.25), np.float32(1), np.float32(2)
    if contraction == 0:
        return a * half, b * half, c * half
    norm = np.sqrt(x * x + y * y + z * z)
    if norm <= one:
        return a * quarter, b * quarter, c * quarter
    inverse = one / norm
    scale = (two - inverse) * inverse
    # In units of the norm, as squares of distant coordinates would overflow.
    u, v, w = x * inverse, y * inverse, z * inverse
    along = two * inverse * (inverse - one) * (u * a + v * b + w * c)
    return ((scale * a + along * u) * quarter, (scale * b + along * v) * quarter, (scale * c + along * w) * quarter)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _backward(
    origins: Any, directions: Any, starts: Any, ends: Any, offsets: Any, contraction: Any, gradient: Any,
    by_origin: Any, by_direction: Any,
) -> None:  # fmt: skip
    for ray in numba.prange(origins.shape[0]):
        for i in range(offsets[ray], offsets[ray + 1]):
            t = (starts[i] + ends[i]) * np.float32(0.5)
            a, b, c = _back_from_cube(
                origins[ray, 0] + directions[ray, 0] * t,
                origins[ray, 1] + directions[ray, 1] * t,
                origins[ray, 2] + directions[ray, 2] * t,
                contraction,
                gradient[i, 0],
                gradient[i, 1],
                gradient[i, 2],
            )
            by_origin[ray, 0] += a
            by_origin[ray, 1] += b
            by_origin[ray, 2] += c
            by_direction[ray, 0] += a * t
            by_direction[ray, 1] += b * t
            by_direction[ray, 2] += c * t


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
    use_threads()
    o, d, s, e, at = (x.detach().contiguous().numpy() for x in (origins, directions, starts, ends, offsets))
    by_origin, by_direction = (torch.zeros(len(origins), 3) for _ in range(2))
    number = CONTRACTIONS.index(contraction)
    _backward(o, d, s, e, at, number, gradient.contiguous().numpy(), by_origin.numpy(), by_direction.numpy())
    return by_origin, by_direction
