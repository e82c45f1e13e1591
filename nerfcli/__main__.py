"""Entry point of the command `nerfcli`, and of `python -m nerfcli` where that is not on the path.

Importing what a command needs takes longer than many commands: Ctrl-C meanwhile ends as it does later, in one line.
"""

import gc
import sys

from nerfcli.errors import INTERRUPTED

# Instead of 10. A full collection visits everything that torch and numba made while they were imported, and importing
# them caused dozens, a quarter of its time; young garbage is collected as often as before.
_YOUNG_PER_FULL_COLLECTION = 100


def start() -> None:
    """Run the command line."""
    gc.set_threshold(*gc.get_threshold()[:2], _YOUNG_PER_FULL_COLLECTION)
    try:
        from nerfcli.cli import main

        main()
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted; nothing was begun.\n")
        raise SystemExit(INTERRUPTED) from None


if __name__ == "__main__":
    start()
