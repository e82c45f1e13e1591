"""Number of threads of the compiled loops."""

import numba
import torch
from numba.core import config
from numba.np.ufunc.parallel import threading_layer


def use_threads() -> int:
    """Set Numba's thread count to torch's, which --threads sets, or to Numba's maximum if less; return it."""
    count = min(torch.get_num_threads(), int(config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    numba.set_num_threads(count)
    return count


def thread_safe() -> bool:
    """Return whether several threads may run compiled loops at once; the workqueue layer would abort the process."""
    return threading_layer() != "workqueue"


def _launch() -> None:
    """Start Numba's threads now: both libraries share one OpenMP, and starting it overwrites torch's thread count."""
    wanted = torch.get_num_threads()
    use_threads()
    torch.set_num_threads(wanted)


_launch()
