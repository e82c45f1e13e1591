"""Adam on the rows of a table that have a gradient, on CPU threads; the gradient is zeroed in the same pass.

Same operation as `reference.adam_rows`. Four rows make a vector, which is updated if any of them has a gradient; its
other rows keep their values. LLVM does not vectorise such a loop written in Numba, which takes 1.3 times as long if a
fifth of the rows has a gradient, and 3.8 times if all have one.
"""

from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from torch import Tensor

from nerfcli.kernels.interface import AdamStep
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.vector import FLOATS, INTS, LANES, arguments_of, floats, in_all_lanes, ints, of_each


def _touched(builder: Any, gradient: Any) -> Any:
    """Return -1 in all lanes of a row if any of its numbers is nonzero or NaN, else 0."""
    touched = builder.sext(builder.fcmp_unordered("!=", gradient, floats(0.0)), INTS)
    for distance in (1, 2):
        swapped = ir.Constant(INTS, [lane ^ distance for lane in range(LANES)])
        touched = builder.or_(touched, builder.shuffle_vector(touched, touched, swapped))
    return touched


def _step(builder: Any, places: Any, numbers: Any) -> None:
    """Update the rows of a vector that have a gradient; `numbers` as in `_update`."""
    table_at, gradient_at, first_at, second_at = places
    gradient = builder.load(gradient_at, align=4)
    touched = _touched(builder, gradient)
    bits = builder.bitcast(touched, ir.IntType(32 * LANES))
    with builder.if_then(builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))):
        rate, beta1, beta2, correction, eps, decay = (in_all_lanes(builder, number, FLOATS) for number in numbers)
        one = floats(1.0)
        table, first, second = (builder.load(place, align=4) for place in (table_at, first_at, second_at))
        g = builder.fadd(gradient, builder.fmul(decay, table))
        m = builder.fadd(builder.fmul(beta1, first), builder.fmul(builder.fsub(one, beta1), g))
        square = builder.fmul(builder.fmul(builder.fsub(one, beta2), g), g)
        v = builder.fadd(builder.fmul(beta2, second), square)
        spread = builder.fadd(builder.fmul(of_each(builder, "llvm.sqrt", v), correction), eps)
        stepped = builder.fsub(table, builder.fdiv(builder.fmul(rate, m), spread))
        rows = builder.icmp_signed("!=", touched, ints(0))
        for place, new, old in ((first_at, m, first), (second_at, v, second), (table_at, stepped, table)):
            builder.store(builder.select(rows, new, old), place, align=4)
        builder.store(floats(0.0), gradient_at, align=4)


@intrinsic
def _step_vector(
    typing_context: Any, table: Any, gradient: Any, first: Any, second: Any, at: Any, rate: Any, beta1: Any,
    beta2: Any, correction: Any, eps: Any, decay: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data, integer = arguments_of(context, builder, signature, args)
        places = [builder.bitcast(builder.gep(data(i), [integer(4)]), FLOATS.as_pointer()) for i in range(4)]
        _step(builder, places, args[5:])
        return context.get_dummy_value()

    return types.none(table, gradient, first, second, at, rate, beta1, beta2, correction, eps, decay), generate


# step_vector(table, gradient, first, second, at, rate, ...) updates LANES numbers of flat arrays, from `at` on.
step_vector: Any = _step_vector


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _update(
    table: Any, gradient: Any, first: Any, second: Any, rate: Any, beta1: Any, beta2: Any, correction: Any, eps: Any,
    decay: Any, threads: Any,
) -> None:  # fmt: skip
    vectors = table.shape[0] // LANES
    for thread in numba.prange(threads):
        for i in range(thread * vectors // threads, (thread + 1) * vectors // threads):
            step_vector(table, gradient, first, second, i * LANES, rate, beta1, beta2, correction, eps, decay)


def adam_rows(table: Tensor, gradient: Tensor, first: Tensor, second: Tensor, *, step: AdamStep) -> None:
    """See `reference.adam_rows`; float32 on the CPU, rows of 4 features."""
    number, rate, betas, eps, decay = step
    scale = rate / (1 - betas[0] ** number)
    correction = (1 - betas[1] ** number) ** -0.5
    flat = [x.detach().view(-1).numpy() for x in (table, gradient, first, second)]
    numbers = [np.float32(x) for x in (scale, *betas, correction, eps, decay)]
    _update(*(*flat, *numbers, use_threads()))
    rest = len(flat[0]) % LANES
    if rest:  # rows beyond the last whole vector, followed by rows without a gradient
        padded = [np.pad(x[-rest:], (0, LANES - rest)) for x in flat]
        _update(*(*padded, *numbers, 1))
        for whole, part in zip(flat, padded, strict=True):
            whole[-rest:] = part[:rest]
