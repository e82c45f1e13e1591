"""Entry point of the command `nerfcli`, and of `python -m nerfcli` if the command is not on the path.

Imports take longer than many commands; Ctrl-C during them ends with one line, as it does later.
"""

import atexit
import gc
import sys

from nerfcli.errors import INTERRUPTED, TERMINATED
from nerfcli.interrupts import Terminated

# Instead of 10. A full collection visits every object that the imports of torch and numba create, and with the default,
# dozens of them took a quarter of the import time; young garbage is collected as often as before.
_YOUNG_PER_FULL_COLLECTION = 100


def start() -> None:
    """Run the command line."""
    gc.set_threshold(*gc.get_threshold()[:2], _YOUNG_PER_FULL_COLLECTION)
    # At the end, Python collects once more what the system takes back in any case: 0.5 s after torch and Numba.
    atexit.register(gc.freeze)
    try:
        from nerfcli.cli import main

        main()
    except Terminated:
        sys.stderr.write("Ended by SIGTERM; nothing was begun.\n")
        raise SystemExit(TERMINATED) from None
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted; nothing was begun.\n")
        raise SystemExit(INTERRUPTED) from None


if __name__ == "__main__":
    start()
