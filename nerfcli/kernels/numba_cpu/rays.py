"""Steps along rays and the cells that they cross: building blocks of `visible`; and `ray_indices`."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.numba_cpu.steps import steps_in_ball, steps_in_cube
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.vector import LANES

# Steps of a ray that are processed together.
CHUNK = LANES


@numba.njit(inline="always")
def cube(x: Any, y: Any, z: Any, contraction: Any) -> Any:
    """Return `contraction.grid_coordinates` of one point, without branches on it, so that loops can be vectorised.

    `contraction` is the number of the name in `CONTRACTIONS`.
    """
    half, quarter, one, two = np.float32(0.5), np.float32(0.25), np.float32(1), np.float32(2)
    if contraction == 0:
        return x * half + half, y * half + half, z * half + half
    norm = np.sqrt(max(x * x + y * y + z * z, one))
    scale = (two - one / norm) / norm * quarter
    return x * scale + half, y * scale + half, z * scale + half


@numba.njit(inline="always")
def cut(edges: Any, shift: Any, k: Any) -> Any:
    """Return the jittered edge number k."""
    return edges[k] + shift * (edges[k + 1] - edges[k])


@numba.njit(inline="always")
def look_ahead(
    origins: Any, directions: Any, edges: Any, jitter: Any, ray: Any, first: Any, side: Any, contraction: Any,
    places: Any, cells: Any,
) -> None:  # fmt: skip
    """Write coordinates (3 CHUNK,) of the midpoints of CHUNK intervals from `first` on, and their cells, -1 outside.

    `edges` must be `padded`; the caller has to leave out steps beyond the last interval.
    """
    if contraction == 0:
        steps_in_cube(origins, directions, ray, edges, jitter[ray], first, side, places, cells)
    else:
        steps_in_ball(origins, directions, ray, edges, jitter[ray], first, side, places, cells)


def padded(edges: Tensor) -> np.ndarray:
    """Return edges followed by the CHUNK copies of the last one that `look_ahead` may read."""
    values = edges.numpy()
    return np.concatenate([values, np.repeat(values[-1:], CHUNK)])  # torch pads this in 0.3 ms, not 0.01


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _ray_indices(offsets: Any, out: Any) -> None:
    for ray in numba.prange(offsets.shape[0] - 1):
        out[offsets[ray] : offsets[ray + 1]] = ray


def ray_indices(offsets: Tensor) -> Tensor:
    """See `reference.ray_indices`."""
    use_threads()
    out = torch.empty(int(offsets[-1]), dtype=torch.int64)
    _ray_indices(offsets.numpy(), out.numpy())
    return out
