"""Table rows and trilinear weights of the corners of cells, for 16 samples at a time.

Written as vectors: LLVM does not vectorise the same loops in Numba, and the hash grid then takes five times as long.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from nerfcli.kernels.numba_cpu.vector import FLOAT, FLOATS, INT, INTS, floats, in_all_lanes, ints, vector_at
from nerfcli.kernels.reference.encoding import HASH_PRIMES


def _cells(builder: Any, coordinates: Any, resolution: Any) -> tuple[list[Any], list[Any]]:
    """Return cells and positions in them by axis; coordinates are clamped to [0, 1], NaN gives cell 0, position NaN."""
    top = in_all_lanes(builder, builder.sitofp(resolution, FLOAT), FLOATS)
    last = in_all_lanes(builder, builder.sub(resolution, ir.Constant(INT, 1)), INTS)
    zero, one = floats(0.0), floats(1.0)
    cells, inside = [], []
    for along in coordinates:
        along = builder.select(builder.fcmp_ordered("<", along, zero), zero, along)
        along = builder.select(builder.fcmp_ordered(">", along, one), one, along)
        scaled = builder.fmul(along, top)
        whole = builder.fptosi(builder.select(builder.fcmp_unordered("uno", scaled, scaled), zero, scaled), INTS)
        cell = builder.select(builder.icmp_signed("<", whole, last), whole, last)
        cells.append(cell)
        inside.append(builder.fsub(scaled, builder.sitofp(cell, FLOATS)))
    return cells, inside


def _hashed_rows(builder: Any, cells: Any, resolution: Any, rows: Any) -> list[Any]:
    mask = in_all_lanes(builder, builder.sub(rows, ir.Constant(INT, 1)), INTS)
    x = [cells[0], builder.add(cells[0], ints(1))]
    y, z = (
        [product := builder.mul(cell, ints(factor)), builder.add(product, ints(factor))]
        for cell, factor in zip(cells[1:], HASH_PRIMES[1:], strict=True)
    )
    yz = [builder.xor(y[corner & 1], z[corner >> 1]) for corner in range(4)]
    return [builder.and_(builder.xor(x[corner & 1], yz[corner >> 1]), mask) for corner in range(8)]


def _dense_rows(builder: Any, cells: Any, resolution: Any, rows: Any) -> list[Any]:
    side = builder.add(resolution, ir.Constant(INT, 1))
    line, layer = (in_all_lanes(builder, step, INTS) for step in (side, builder.mul(side, side)))
    first = builder.add(builder.mul(builder.add(builder.mul(cells[2], line), cells[1]), line), cells[0])
    z = [first, builder.add(first, layer)]
    yz = [z[corner >> 1] if corner & 1 == 0 else builder.add(z[corner >> 1], line) for corner in range(4)]
    return [yz[corner >> 1] if corner & 1 == 0 else builder.add(yz[corner >> 1], ints(1)) for corner in range(8)]


def _weights(builder: Any, inside: Any) -> list[Any]:
    x, y, z = ([builder.fsub(floats(1.0), place), place] for place in inside)
    xy = [builder.fmul(x[corner & 1], y[corner >> 1]) for corner in range(4)]
    return [builder.fmul(xy[corner & 3], z[corner >> 2]) for corner in range(8)]


def _corners(rows_of: Callable[..., list[Any]]) -> Any:
    """Return an intrinsic (points, at, stride, resolution, rows, place, apart, index, weight, inside).

    Reads the coordinates of 16 samples at points[at], points[at + stride], points[at + 2 stride]; writes the table row
    and the weight of corner c to index[place + c apart] and weight[place + c apart] (bit 0 of c is x, bit 1 is y, bit 2
    is z), and the positions inside the cells to inside[place + axis apart]. All arrays are flat, `index` of uint32.
    """

    @intrinsic
    def corners(
        typing_context: Any, points: Any, at: Any, stride: Any, resolution: Any, rows: Any, place: Any, apart: Any,
        index: Any, weight: Any, inside: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            def data(which: int) -> Any:
                return context.make_array(signature.args[which])(context, builder, args[which]).data

            at, stride, place, apart = (
                context.cast(builder, args[i], signature.args[i], types.intp) for i in (1, 2, 5, 6)
            )
            resolution, rows = (context.cast(builder, args[i], signature.args[i], types.int32) for i in (3, 4))
            coordinates = [
                builder.load(vector_at(builder, data(0), at, stride, axis, FLOATS), align=4) for axis in range(3)
            ]
            cells, within = _cells(builder, coordinates, resolution)
            for which, kind, values in (
                (7, INTS, rows_of(builder, cells, resolution, rows)),
                (8, FLOATS, _weights(builder, within)),
                (9, FLOATS, within),
            ):
                for count, value in enumerate(values):
                    builder.store(value, vector_at(builder, data(which), place, apart, count, kind), align=4)
            return context.get_dummy_value()

        return types.none(points, at, stride, resolution, rows, place, apart, index, weight, inside), generate

    return corners


# See `_corners`; for levels with a separate row for each vertex, and for levels whose vertices share rows by a hash.
dense_corners = _corners(_dense_rows)
hashed_corners = _corners(_hashed_rows)
