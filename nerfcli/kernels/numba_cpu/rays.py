"""Steps along rays and the cells that they cross: building blocks of `visible`; and `ray_indices`."""

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.contraction import CONTRACTIONS
from nerfcli.kernels.interface import March, Rays
from nerfcli.kernels.numba_cpu.threads import use_threads

# Steps of a ray that are processed together.
CHUNK = 16


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


class Walk(NamedTuple):
    """Rays and a march through cells, as compiled loops take them.

    Args:
        origins, directions, jitter: of `Rays`.
        cones: of `Rays`; (0,) for rays without width.
        edges: of `March`, followed by the CHUNK copies of the last one that `look_ahead` may read.
        occupied: of `March`, (G^3,).
        side: G.
        contraction: its number in `CONTRACTIONS`.
    """

    origins: Any
    directions: Any
    jitter: Any
    cones: Any
    edges: Any
    occupied: Any
    side: Any
    contraction: Any


def walk_of(rays: Rays, along: March, *, has_width: bool = False) -> Walk:
    """Return rays and a march as compiled loops take them; rays have their width only if that is asked for."""
    edges = along.edges.numpy()
    cones = rays.cones if has_width and rays.cones is not None else rays.origins.new_empty(0)
    return Walk(
        origins=rays.origins.contiguous().numpy(),
        directions=rays.directions.contiguous().numpy(),
        jitter=rays.jitter.contiguous().numpy(),
        cones=cones.contiguous().numpy(),
        edges=np.concatenate([edges, np.repeat(edges[-1:], CHUNK)]),  # torch pads this in 0.3 ms, not 0.01
        occupied=along.occupied.contiguous().view(-1).numpy(),
        side=along.occupied.shape[0],
        contraction=CONTRACTIONS.index(along.contraction),
    )


@numba.njit(inline="always")
def cut(edges: Any, shift: Any, k: Any) -> Any:
    """Return edge number k of a ray with the jitter `shift`."""
    return edges[k] + shift * (edges[k + 1] - edges[k])


@numba.njit(inline="always")
def _cell(along: Any, side: Any) -> Any:
    """Return the cell of a coordinate along one axis, and whether the coordinate is inside; NaN is not."""
    within = min(max(np.float32(0), along), np.float32(1))  # distant ones would overflow
    return min(np.int32(within * np.float32(side)), np.int32(side - 1)), within == along


@numba.njit(inline="always")
def look_ahead(walk: Any, ray: Any, first: Any, places: Any, cells: Any) -> None:
    """Write coordinates (3 CHUNK,) of the midpoints of CHUNK intervals from `first` on, and their cells, -1 outside.

    The caller has to leave out steps beyond the last interval.
    """
    ox, oy, oz = walk.origins[ray, 0], walk.origins[ray, 1], walk.origins[ray, 2]
    dx, dy, dz = walk.directions[ray, 0], walk.directions[ray, 1], walk.directions[ray, 2]
    shift, side = walk.jitter[ray], np.int32(walk.side)
    edges = walk.edges[first : first + CHUNK + 2]  # an index that may be negative would not be vectorised
    for i in range(CHUNK):
        t = (cut(edges, shift, i) + cut(edges, shift, i + 1)) * np.float32(0.5)
        x, y, z = cube(ox + dx * t, oy + dy * t, oz + dz * t, walk.contraction)
        places[i], places[CHUNK + i], places[2 * CHUNK + i] = x, y, z
        (column, x_inside), (row, y_inside), (layer, z_inside) = _cell(x, side), _cell(y, side), _cell(z, side)
        # Numba computes with 64 bits, and LLVM with 32 where it sees that no more are kept.
        cell = np.int32(np.int32(np.int32(layer * side) + row) * side) + column
        cells[i] = np.int32(cell) if x_inside & y_inside & z_inside else np.int32(-1)


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
