"""How many threads the compiled loops use."""

import torch
from numba.core import config


def thread_count() -> int:
    """Torch's thread count, which --threads sets, as far as Numba has threads."""
    return min(torch.get_num_threads(), int(config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
