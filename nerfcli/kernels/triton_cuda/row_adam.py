"""Adam on the rows of a table that have a gradient: moments, table and its float16 copy in one pass.

The pass also zeroes the gradient. Same operation as `reference.adam_rows`, for rows of 4 features.
"""

import triton.language as tl
from torch import Tensor

from nerfcli.kernels.interface import FEATURES, AdamStep
from nerfcli.kernels.triton_cuda.launch import Size, blocks, jit, launch

BLOCK = Size.of(256, interpreted=1024)


@jit
def _update(
    table, half, gradient, first, second, rows, rate, beta1, beta2,
    correction, eps, decay, BLOCK: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    at = row[:, None] * 4 + tl.arange(0, 4)[None, :]
    valid = (row < rows)[:, None]
    g = tl.load(gradient + at, mask=valid, other=0.0)
    touched = valid & (tl.max(tl.where(g == 0.0, 0, 1), 1) > 0)[:, None]
    value = tl.load(table + at, mask=touched, other=0.0)
    g += decay * value
    m = beta1 * tl.load(first + at, mask=touched, other=0.0) + (1.0 - beta1) * g
    v = beta2 * tl.load(second + at, mask=touched, other=0.0) + (1.0 - beta2) * g * g
    value -= rate * m / (tl.sqrt_rn(v) * correction + eps)
    tl.store(first + at, m, mask=touched)
    tl.store(second + at, v, mask=touched)
    tl.store(table + at, value, mask=touched)
    tl.store(half + at, value.to(tl.float16), mask=touched)
    tl.store(gradient + at, tl.zeros([BLOCK, 4], tl.float32), mask=touched)


def adam_rows(table: Tensor, gradient: Tensor, first: Tensor, second: Tensor, *, half: Tensor, step: AdamStep) -> None:
    """See `reference.adam_rows`; float32, rows of 4 features. Changed rows are copied to `half`, the float16 table."""
    rows = table.numel() // FEATURES
    number, rate, betas, eps, decay = step
    scale, correction = rate / (1 - betas[0] ** number), (1 - betas[1] ** number) ** -0.5
    launch(
        _update, (blocks(rows, BLOCK),), table.detach(), half, gradient, first, second, rows, scale, *betas,
        correction, float(eps), float(decay), BLOCK=BLOCK,
    )  # fmt: skip
