"""Entry point of the command `nerfcli`, and of `python -m nerfcli` where that is not on the path.

Importing what a command needs takes longer than many commands: Ctrl-C meanwhile ends as it does later, in one line.
"""

import sys

from nerfcli.errors import INTERRUPTED


def start() -> None:
    """Run the command line."""
    try:
        from nerfcli.cli import main

        main()
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted; nothing was begun.\n")
        raise SystemExit(INTERRUPTED) from None


if __name__ == "__main__":
    start()
