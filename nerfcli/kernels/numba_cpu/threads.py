"""Number of threads of the compiled loops."""

import numba
import torch
from numba.core import config
from numba.np.ufunc.parallel import threading_layer


def use_threads() -> int:
    """Have Numba's loops use as many threads as torch, which --threads sets; returns how many these are."""
    count = min(torch.get_num_threads(), int(config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    numba.set_num_threads(count)
    return count


def thread_safe() -> bool:
    """Return whether several threads may run compiled loops at the same time; workqueue then ends the process."""
    return threading_layer() != "workqueue"


def _launch() -> None:
    """Start Numba's threads now: both libraries share one OpenMP, and the start overwrites torch's thread count."""
    wanted = torch.get_num_threads()
    use_threads()
    torch.set_num_threads(wanted)


_launch()
