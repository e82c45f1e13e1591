"""The server of `train --view` in a separate process: `python -m nerfcli.workflows.view_worker RUN`.

Training therefore gives the same result in the same time with or without a viewer.
"""

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from nerfcli.child import messages, spawn, take_stdout
from nerfcli.errors import UserError
from nerfcli.runs.live import end_request
from nerfcli.workflows.notices import Notify
from nerfcli.workflows.view import view_run

MODULE = "nerfcli.workflows.view_worker"
# The viewer gets one thread for this many threads of the training.
_TRAINING_THREADS_PER_VIEWER_THREAD = 2


@contextmanager
def viewer_beside(run: Path, *, threads: int, notify: Notify) -> Iterator[Callable[[], None]]:
    """Yield a function that starts the server of a run, once; the server ends with the context.

    Args:
        run: the run folder, which need not exist before the server starts.
        threads: number of threads of the training.
        notify: called with the address.
    """
    with ExitStack() as ending:
        log = ending.enter_context(open(os.devnull, "wb"))
        child: subprocess.Popen[bytes] | None = None

        def start() -> None:
            nonlocal child
            if child is None:
                child = spawn(MODULE, run, log=log, threads=max(1, threads // _TRAINING_THREADS_PER_VIEWER_THREAD))
                listener = threading.Thread(target=_announce, args=(child, notify), daemon=True)
                listener.start()
                ending.callback(end_request, run)
                ending.callback(listener.join)
                ending.callback(child.kill)

        yield start


def _announce(child: subprocess.Popen[bytes], notify: Notify) -> None:
    for message in messages(child):
        for line in message["lines"]:
            notify(line)


def main() -> None:
    """Serve the run given as the first argument."""
    send = take_stdout()

    def on_ready(url: str, from_elsewhere: str) -> None:
        send({"lines": [f"view the training at {url}", f"from another machine: {from_elsewhere}"]})

    try:
        threads = int(os.environ.get("OMP_NUM_THREADS", "0"))
        view_run(Path(sys.argv[1]), threads=threads, browser=True, on_ready=on_ready)
    except UserError as error:
        send({"lines": [f"the training cannot be viewed: {error.message}"]})


if __name__ == "__main__":
    main()
