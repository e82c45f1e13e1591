"""Steps along rays and the cells that they cross: building blocks of `visible`; and `ray_indices`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from torch import Tensor

from nerfcli.kernels.contraction import CONTRACTIONS
from nerfcli.kernels.interface import March, Rays
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.vector import (
    FLOAT,
    FLOATS,
    INTS,
    LANES,
    LONG,
    arguments_of,
    floats,
    in_all_lanes,
    ints,
    of_each,
    vector_at,
)

_ONE_BIT = ir.VectorType(ir.IntType(1), LANES)


def _larger(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _smaller(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _unit_cube(builder: Any, points: list[Any]) -> list[Any]:
    return [builder.fadd(builder.fmul(along, floats(0.5)), floats(0.5)) for along in points]


def _ball(builder: Any, points: list[Any]) -> list[Any]:
    x, y, z = (builder.fmul(along, along) for along in points)
    square = builder.fadd(builder.fadd(x, y), z)
    norm = of_each(builder, "llvm.sqrt", _larger(builder, square, floats(1.0)))
    shrink = builder.fdiv(builder.fsub(floats(2.0), builder.fdiv(floats(1.0), norm)), norm)
    scale = builder.fmul(shrink, floats(0.25))
    return [builder.fadd(builder.fmul(along, scale), floats(0.5)) for along in points]


def _cells(builder: Any, coordinates: list[Any], side: Any) -> Any:
    """Return indices of cells in a grid, -1 outside; coordinates are clamped first, as distant ones would overflow."""
    zero, one = floats(0.0), floats(1.0)
    scale = in_all_lanes(builder, builder.sitofp(side, FLOAT), FLOATS)
    line = in_all_lanes(builder, side, INTS)
    last = builder.sub(line, ints(1))
    inside, places = ir.Constant(_ONE_BIT, [1] * LANES), []
    for along in coordinates:
        within = _smaller(builder, _larger(builder, along, zero), one)
        inside = builder.and_(inside, builder.fcmp_ordered("==", within, along))
        place = builder.fptosi(builder.fmul(within, scale), INTS)
        places.append(builder.select(builder.icmp_signed("<", place, last), place, last))
    column, row, layer = places
    cell = builder.add(builder.mul(builder.add(builder.mul(layer, line), row), line), column)
    return builder.select(inside, cell, ints(-1))


def _steps(cube_of: Callable[[Any, list[Any]], list[Any]]) -> Any:
    """Return an intrinsic (origins, directions, ray, edges, shift, first, side, places, cells), on flat arrays.

    Edge k of the ray is edges[k] + shift * (edges[k + 1] - edges[k]). It writes the coordinates of the midpoints of 16
    intervals from number `first` on to places[axis * 16 + i], and their cells in a grid of `side` to cells[i].
    """

    @intrinsic
    def steps(
        typing_context: Any, origins: Any, directions: Any, ray: Any, edges: Any, shift: Any, first: Any, side: Any,
        places: Any, cells: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data, integer = arguments_of(context, builder, signature, args)
            ray, first, side = integer(2), integer(5), integer(6, types.int32)
            one, begin = ir.Constant(LONG, 1), builder.mul(ray, ir.Constant(LONG, 3))

            def of_ray(which: int, axis: int) -> Any:
                place = builder.gep(data(which), [builder.add(begin, ir.Constant(LONG, axis))])
                return in_all_lanes(builder, builder.load(place), FLOATS)

            near, middle, far = (
                builder.load(vector_at(builder, data(3), first, one, count, FLOATS), align=4) for count in range(3)
            )
            jitter = in_all_lanes(builder, args[4], FLOATS)
            start, end = (
                builder.fadd(low, builder.fmul(jitter, builder.fsub(high, low)))
                for low, high in ((near, middle), (middle, far))
            )
            t = builder.fmul(builder.fadd(start, end), floats(0.5))
            points = [builder.fadd(of_ray(0, axis), builder.fmul(of_ray(1, axis), t)) for axis in range(3)]
            coordinates = cube_of(builder, points)
            zero = ir.Constant(LONG, 0)
            for axis, along in enumerate(coordinates):
                builder.store(along, vector_at(builder, data(7), zero, ir.Constant(LONG, LANES), axis, FLOATS), align=4)
            builder.store(_cells(builder, coordinates, side), vector_at(builder, data(8), zero, one, 0, INTS), align=4)
            return context.get_dummy_value()

        return types.none(origins, directions, ray, edges, shift, first, side, places, cells), generate

    return steps


# See `_steps`; one for each of `CONTRACTIONS`.
steps_in_cube = _steps(_unit_cube)
steps_in_ball = _steps(_ball)


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
def cut(walk: Any, ray: Any, k: Any) -> Any:
    """Return the jittered edge number k of a ray."""
    return walk.edges[k] + walk.jitter[ray] * (walk.edges[k + 1] - walk.edges[k])


@numba.njit(inline="always")
def look_ahead(walk: Any, ray: Any, first: Any, places: Any, cells: Any) -> None:
    """Write coordinates (3 CHUNK,) of the midpoints of CHUNK intervals from `first` on, and their cells, -1 outside.

    The caller has to leave out steps beyond the last interval.
    """
    if walk.contraction == 0:
        steps_in_cube(walk.origins, walk.directions, ray, walk.edges, walk.jitter[ray], first, walk.side, places, cells)
    else:
        steps_in_ball(walk.origins, walk.directions, ray, walk.edges, walk.jitter[ray], first, walk.side, places, cells)


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
