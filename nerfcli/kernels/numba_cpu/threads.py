"""How many threads the compiled loops use."""

import numba
import torch
from numba.core import config


def thread_count() -> int:
    """Torch's thread count, which --threads sets, as far as Numba has threads; from now on its loops use as many."""
    count = min(torch.get_num_threads(), int(config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    numba.set_num_threads(count)
    return count


def _launch() -> None:
    """Start Numba's threads now: both libraries share one OpenMP, and the start overwrites torch's thread count."""
    wanted = torch.get_num_threads()
    thread_count()
    torch.set_num_threads(wanted)


_launch()
