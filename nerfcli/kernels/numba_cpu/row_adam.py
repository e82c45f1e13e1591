"""Adam on the rows of a table that have a gradient, on CPU threads; the gradient is set to zero on the way.

Same operation as `reference.adam_rows`.
"""

from typing import Any

import numba
import numpy as np
from torch import Tensor

from nerfcli.kernels.numba_cpu.threads import use_threads

FEATURES = 4


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _update(
    table: Any, gradient: Any, first: Any, second: Any, rate: Any, beta1: Any, beta2: Any, correction: Any, eps: Any
) -> None:
    one = np.float32(1)
    for row in numba.prange(table.shape[0]):
        touched = False
        for j in range(FEATURES):
            touched |= gradient[row, j] != 0
        if touched:
            for j in range(FEATURES):
                g = gradient[row, j]
                m = beta1 * first[row, j] + (one - beta1) * g
                v = beta2 * second[row, j] + (one - beta2) * g * g
                first[row, j], second[row, j] = m, v
                table[row, j] -= rate * m / (np.sqrt(v) * correction + eps)
                gradient[row, j] = np.float32(0)


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
) -> None:
    """See `reference.adam_rows`; float32 on the CPU, rows of 4 features."""
    use_threads()
    scale = rate / (1 - betas[0] ** step)
    correction = (1 - betas[1] ** step) ** -0.5
    flat = (x.detach().view(-1, FEATURES).numpy() for x in (table, gradient, first, second))
    _update(*flat, *(np.float32(x) for x in (scale, *betas, correction, eps)))
