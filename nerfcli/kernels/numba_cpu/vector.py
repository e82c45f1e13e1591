"""What Numba has no words for: asking for a cache line ahead of time, and a block of a matrix product in registers."""

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

# Lanes of a vector; LLVM splits it into what the processor has (AVX-512: one register, AVX2: two, NEON: four).
LANES = 16
# Rows of a block: with two vectors each they fill half of AVX-512's registers and hide the latency of a product.
ROWS = 8


@intrinsic
def _prefetch(typing_context: Any, array: Any, index: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        byte = ir.PointerType(ir.IntType(8))
        place = builder.bitcast(builder.gep(data, [args[1]]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, *[ir.IntType(32)] * 3])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        read, keep, data_cache = (ir.Constant(ir.IntType(32), value) for value in (0, 3, 1))
        builder.call(function, [place, read, keep, data_cache])
        return context.get_dummy_value()

    return types.none(array, index), generate


# prefetch(array, index) asks for the cache line of array[index] of a flat float32 array, without waiting for it.
prefetch: Callable[[Any, Any], None] = cast(Any, _prefetch)


def _block_product(vectors: int) -> Callable[..., None]:
    """An intrinsic for blocks that are `vectors` vectors wide."""

    @intrinsic
    def add_product(
        typing_context: Any, a: Any, a_at: Any, a_row: Any, a_step: Any, b: Any, b_at: Any, b_step: Any, depth: Any,
        c: Any, c_at: Any, c_row: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            def data(which: int) -> Any:
                return context.make_array(signature.args[which])(context, builder, args[which]).data

            a_data, b_data, c_data = data(0), data(4), data(8)
            a_at, a_row, a_step, b_at, b_step, depth, c_at, c_row = (
                context.cast(builder, args[i], signature.args[i], types.intp) for i in (1, 2, 3, 5, 6, 7, 9, 10)
            )
            index, scalar = ir.IntType(64), ir.FloatType()
            vector = ir.VectorType(scalar, LANES)

            def vector_at(pointer: Any, at: Any, lane: int) -> Any:
                place = builder.gep(pointer, [builder.add(at, ir.Constant(index, lane))])
                return builder.bitcast(place, vector.as_pointer())

            cells = [(row, column) for row in range(ROWS) for column in range(vectors)]
            places = {
                (row, column): vector_at(
                    c_data, builder.add(c_at, builder.mul(c_row, ir.Constant(index, row))), column * LANES
                )
                for row, column in cells
            }
            sums = {}
            for cell in cells:
                sums[cell] = cgutils.alloca_once(builder, vector)
                builder.store(builder.load(places[cell], align=4), sums[cell])
            zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
            with cgutils.for_range(builder, depth) as loop:
                b_row = builder.add(b_at, builder.mul(b_step, loop.index))
                right = [builder.load(vector_at(b_data, b_row, v * LANES), align=4) for v in range(vectors)]
                a_column = builder.add(a_at, builder.mul(a_step, loop.index))
                for row in range(ROWS):
                    place = builder.add(a_column, builder.mul(a_row, ir.Constant(index, row)))
                    left = builder.load(builder.gep(a_data, [place]))
                    first = builder.insert_element(
                        ir.Constant(vector, ir.Undefined), left, ir.Constant(ir.IntType(32), 0)
                    )
                    spread = builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)
                    for column in range(vectors):
                        # "contract" lets LLVM fuse the two where the processor can; nothing else is relaxed.
                        product = builder.fmul(spread, right[column], flags=("contract",))
                        total = builder.fadd(builder.load(sums[row, column]), product, flags=("contract",))
                        builder.store(total, sums[row, column])
            for cell in cells:
                builder.store(builder.load(sums[cell]), places[cell], align=4)
            return context.get_dummy_value()

        return types.none(a, a_at, a_row, a_step, b, b_at, b_step, depth, c, c_at, c_row), generate

    return add_product


# add_product_N(a, a_at, a_row, a_step, b, b_at, b_step, depth, c, c_at, c_row), on flat float32 arrays, adds a block of
# ROWS x N of a matrix product to c:
#     c[c_at + r c_row + j] += sum_k a[a_at + r a_row + k a_step] * b[b_at + k b_step + j],  r < ROWS, j < N, k < depth
add_product_16 = _block_product(1)
add_product_32 = _block_product(2)
