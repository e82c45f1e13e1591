"""Intrinsics that Numba lacks: prefetching of a cache line, table rows as vectors, a register block of a matrix
product.
"""

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba.core import cgutils, types
from numba.extending import intrinsic

from nerfcli.kernels.interface import FEATURES

# Lanes of a vector; LLVM splits it into the processor's registers (AVX-512: one register, AVX2: two, NEON: four).
LANES = 16
# Rows of a block of a matrix product, for rows of 32 and of 16 numbers. The block's sums fill at most half of the
# registers (32 with AVX-512, else 16, half as wide with AVX2), and hide the latency of a product. With AVX2, 8 rows of
# 32 numbers would be spilled to memory at every product: 35 instead of 84 GFLOP/s.
ROWS_32, ROWS_16 = (8, 8) if get_host_cpu_features().get("avx512f") else (2, 4)

# Types of LLVM, and vectors of them.
INT, FLOAT, LONG = ir.IntType(32), ir.FloatType(), ir.IntType(64)
INTS, FLOATS = ir.VectorType(INT, LANES), ir.VectorType(FLOAT, LANES)


def ints(value: int) -> Any:
    """Return a vector with one integer in all lanes."""
    return ir.Constant(INTS, [value % 2**32] * LANES)


def floats(value: float) -> Any:
    """Return a vector with one number in all lanes, which float32 must represent exactly."""
    return ir.Constant(FLOATS, [value] * LANES)


def in_all_lanes(builder: Any, scalar: Any, kind: Any) -> Any:
    """Return a vector of type `kind` with a scalar, computed by the machine code, in all lanes."""
    undefined, first = ir.Constant(kind, ir.Undefined), ir.Constant(ir.VectorType(INT, kind.count), [0] * kind.count)
    return builder.shuffle_vector(builder.insert_element(undefined, scalar, ir.Constant(INT, 0)), undefined, first)


def vector_at(builder: Any, pointer: Any, first: Any, step: Any, count: int, kind: Any) -> Any:
    """Return a pointer to a vector of type `kind`, `count` steps after element `first`."""
    element = builder.add(first, builder.mul(step, ir.Constant(LONG, count)))
    return builder.bitcast(builder.gep(pointer, [element]), kind.as_pointer())


def of_each(builder: Any, name: str, vector: Any) -> Any:
    """Return an LLVM function of floats, such as "llvm.sqrt", of each lane; LLVM's builder has none of them."""
    kind = ir.FunctionType(FLOATS, [FLOATS])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"{name}.v{LANES}f32"), [vector])


def arguments_of(
    context: Any, builder: Any, signature: Any, args: Any
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return what gives the arguments of an intrinsic by their numbers: data of arrays, and integers of a type."""

    def data(which: int) -> Any:
        return context.make_array(signature.args[which])(context, builder, args[which]).data

    def integer(which: int, kind: Any = types.intp) -> Any:
        return context.cast(builder, args[which], signature.args[which], kind)

    return data, integer


@intrinsic
def _prefetch(typing_context: Any, array: Any, index: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data, _ = arguments_of(context, builder, signature, args)
        byte = ir.PointerType(ir.IntType(8))
        place = builder.bitcast(builder.gep(data(0), [args[1]]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, *[INT] * 3])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        read, keep, data_cache = (ir.Constant(INT, value) for value in (0, 3, 1))
        builder.call(function, [place, read, keep, data_cache])
        return context.get_dummy_value()

    return types.none(array, index), generate


# prefetch(array, index) requests the cache line of array[index] of a flat float32 array, without waiting for it.
prefetch: Callable[[Any, Any], None] = cast(Any, _prefetch)


ROW_FLOATS = ir.VectorType(FLOAT, FEATURES)


def _row_access(generate: Callable[..., None]) -> Any:
    """Return an intrinsic over the 8 corners of a cell: (flat, offset, index, weight, at, stride, row, row_at).

    Corner c has the table row index[at + c stride], at flat[offset + 4 index], and the weight weight[at + c stride].
    `generate` is given the builder, pointers to the corners' rows and weights, and one to row[row_at : row_at + 4].
    """

    @intrinsic
    def access(
        typing_context: Any, flat: Any, offset: Any, index: Any, weight: Any, at: Any, stride: Any, row: Any,
        row_at: Any,
    ) -> Any:  # fmt: skip
        def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data, integer = arguments_of(context, builder, signature, args)
            flat_data, index_data, weight_data, row_data = map(data, (0, 2, 3, 6))
            offset, at, stride, row_at = map(integer, (1, 4, 5, 7))
            corners = []
            for corner in range(8):
                place = builder.add(at, builder.mul(stride, ir.Constant(LONG, corner)))
                number = builder.zext(builder.load(builder.gep(index_data, [place])), LONG)
                pointer = vector_at(builder, flat_data, offset, number, FEATURES, ROW_FLOATS)
                corners.append((pointer, builder.gep(weight_data, [place])))
            generate(builder, corners, builder.bitcast(builder.gep(row_data, [row_at]), ROW_FLOATS.as_pointer()))
            return context.get_dummy_value()

        return types.none(flat, offset, index, weight, at, stride, row, row_at), build

    return access


def _gather(builder: Any, corners: Any, row: Any) -> None:
    # All weights are loaded before anything is stored: the compiler cannot know that they do not overlap the row.
    weights = [in_all_lanes(builder, builder.load(weight), ROW_FLOATS) for _, weight in corners]
    total = None
    for (pointer, _), weight in zip(corners, weights, strict=True):
        product = builder.fmul(weight, builder.load(pointer, align=4), flags=("contract",))
        total = product if total is None else builder.fadd(total, product, flags=("contract",))
    builder.store(total, row, align=4)


def _scatter(builder: Any, corners: Any, row: Any) -> None:
    gradient = builder.load(row, align=4)
    weights = [in_all_lanes(builder, builder.load(weight), ROW_FLOATS) for _, weight in corners]
    for (pointer, _), weight in zip(corners, weights, strict=True):  # one after the other: two corners may share a row
        product = builder.fmul(weight, gradient, flags=("contract",))
        builder.store(builder.fadd(builder.load(pointer, align=4), product, flags=("contract",)), pointer, align=4)


def _dot(builder: Any, corners: Any, row: Any) -> None:
    vector = builder.load(row, align=4)
    lanes = [ir.Constant(INT, lane) for lane in range(FEATURES)]
    sums = []
    for pointer, _ in corners:
        product = builder.fmul(vector, builder.load(pointer, align=4))
        parts = [builder.extract_element(product, lane) for lane in lanes]
        sums.append(builder.fadd(builder.fadd(parts[0], parts[1]), builder.fadd(parts[2], parts[3])))
    for (_, place), total in zip(corners, sums, strict=True):
        builder.store(total, place)


# gather_rows: row[row_at : row_at + 4] = sum over corners of weight * flat row.  All arrays flat; index is uint32.
gather_rows = _row_access(_gather)
# scatter_rows: each flat row += weight * row[row_at : row_at + 4].
scatter_rows = _row_access(_scatter)
# dot_rows: each weight becomes the scalar product of the flat row with row[row_at : row_at + 4].
dot_rows = _row_access(_dot)


def _block_product(
    rows: int, vectors: int, *, begin: Callable[..., Any], finish: Callable[..., Any]
) -> Callable[..., None]:
    """Return an intrinsic for blocks of `rows` rows that are `vectors` vectors wide.

    Args:
        rows, vectors: of a block.
        begin: returns the initial vector of sums, given the builder and the pointer to which it will be stored.
        finish: returns the vector to store, given the builder and the sums.
    """

    @intrinsic
    def add_product(
        typing_context: Any, a: Any, a_at: Any, a_row: Any, a_step: Any, b: Any, b_at: Any, b_step: Any, depth: Any,
        c: Any, c_at: Any, c_row: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data, integer = arguments_of(context, builder, signature, args)
            a_data, b_data, c_data = map(data, (0, 4, 8))
            a_at, a_row, a_step, b_at, b_step, depth, c_at, c_row = map(integer, (1, 2, 3, 5, 6, 7, 9, 10))
            width = ir.Constant(LONG, LANES)
            cells = [(row, column) for row in range(rows) for column in range(vectors)]
            places, sums = {}, {}
            for row, column in cells:
                first = builder.add(c_at, builder.mul(c_row, ir.Constant(LONG, row)))
                place = places[row, column] = vector_at(builder, c_data, first, width, column, FLOATS)
                total = sums[row, column] = cgutils.alloca_once(builder, FLOATS)
                builder.store(begin(builder, place), total)
            with cgutils.for_range(builder, depth) as loop:
                b_row = builder.add(b_at, builder.mul(b_step, loop.index))
                right = [
                    builder.load(vector_at(builder, b_data, b_row, width, column, FLOATS), align=4)
                    for column in range(vectors)
                ]
                a_column = builder.add(a_at, builder.mul(a_step, loop.index))
                for row in range(rows):
                    place = builder.add(a_column, builder.mul(a_row, ir.Constant(LONG, row)))
                    spread = in_all_lanes(builder, builder.load(builder.gep(a_data, [place])), FLOATS)
                    for column in range(vectors):
                        # "contract" lets LLVM fuse the two where the processor can; nothing else is relaxed.
                        product = builder.fmul(spread, right[column], flags=("contract",))
                        total = builder.fadd(builder.load(sums[row, column]), product, flags=("contract",))
                        builder.store(total, sums[row, column])
            for cell in cells:
                builder.store(finish(builder, builder.load(sums[cell])), places[cell], align=4)
            return context.get_dummy_value()

        return types.none(a, a_at, a_row, a_step, b, b_at, b_step, depth, c, c_at, c_row), generate

    return add_product


def _stored(builder: Any, place: Any) -> Any:
    return builder.load(place, align=4)


def _zero(builder: Any, place: Any) -> Any:
    return floats(0.0)


def _as_it_is(builder: Any, total: Any) -> Any:
    return total


def _rectified(builder: Any, total: Any) -> Any:
    zero = floats(0.0)
    return builder.select(builder.fcmp_ordered("<=", total, zero), zero, total)  # NaN stays NaN, so that it is detected


# X_N(a, a_at, a_row, a_step, b, b_at, b_step, depth, c, c_at, c_row), on flat float32 arrays, computes a block of
# ROWS_N x N of a matrix product
#     p[r, j] = sum_k a[a_at + r a_row + k a_step] * b[b_at + k b_step + j],  r < ROWS_N, j < N, k < depth
# and writes to c[c_at + r c_row + j]: add_product adds p, product stores p, rectified_product stores max(0, p).
add_product_16 = _block_product(ROWS_16, 1, begin=_stored, finish=_as_it_is)
add_product_32 = _block_product(ROWS_32, 2, begin=_stored, finish=_as_it_is)
product_16 = _block_product(ROWS_16, 1, begin=_zero, finish=_as_it_is)
product_32 = _block_product(ROWS_32, 2, begin=_zero, finish=_as_it_is)
rectified_product_32 = _block_product(ROWS_32, 2, begin=_zero, finish=_rectified)
