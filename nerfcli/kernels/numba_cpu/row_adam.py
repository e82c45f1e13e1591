"""Adam on the rows of a table that have a gradient, on CPU threads; the gradient is set to zero on the way.

Same operation as `reference.adam_rows`.
"""

from typing import Any

import numba
import numpy as np
from torch import Tensor

from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.vector import prefetch

FEATURES = 4


# Rows that a thread looks through before it updates those of them that have a gradient, and how many of these it asks
# for ahead: with one loop for both, every row waits for memory.
LOOK = 4096
AHEAD = 16


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _update(
    table: Any, gradient: Any, first: Any, second: Any, rate: Any, beta1: Any, beta2: Any, correction: Any, eps: Any,
    decay: Any, threads: Any,
) -> None:  # fmt: skip
    one, zero, rows = np.float32(1), np.float32(0), table.shape[0] // FEATURES
    for thread in numba.prange(threads):
        places = np.empty(LOOK, np.int64)
        last = (thread + 1) * rows // threads
        for begin in range(thread * rows // threads, last, LOOK):
            count = 0
            for row in range(begin, min(begin + LOOK, last)):
                at = row * FEATURES
                a, b, c, d = gradient[at], gradient[at + 1], gradient[at + 2], gradient[at + 3]
                places[count] = at
                count += (a != zero) | (b != zero) | (c != zero) | (d != zero)  # a branch would be guessed wrongly
            for i in range(count):
                coming = places[min(i + AHEAD, count - 1)]
                prefetch(first, coming)
                prefetch(second, coming)
                prefetch(table, coming)
                for at in range(places[i], places[i] + FEATURES):
                    g = gradient[at] + decay * table[at]
                    m = beta1 * first[at] + (one - beta1) * g
                    v = beta2 * second[at] + (one - beta2) * g * g
                    first[at], second[at] = m, v
                    table[at] -= rate * m / (np.sqrt(v) * correction + eps)
                    gradient[at] = zero


def adam_rows(
    table: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    *,
    step: int,
    rate: float,
    betas: tuple[float, float],
    eps: float,
    decay: float = 0.0,
) -> None:
    """See `reference.adam_rows`; float32 on the CPU, rows of 4 features."""
    scale = rate / (1 - betas[0] ** step)
    correction = (1 - betas[1] ** step) ** -0.5
    flat = [x.detach().view(-1).numpy() for x in (table, gradient, first, second)]
    numbers = [np.float32(x) for x in (scale, *betas, correction, eps, decay)]
    _update(*(*flat, *numbers, use_threads()))
