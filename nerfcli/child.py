"""Child processes that report lines of JSON on stdout, and end when their parent ends."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from pathlib import Path
from typing import IO, Any

import nerfcli


def spawn(
    module: str, job: Path, *, log: IO[bytes], threads: int = 0, descriptors: tuple[int, ...] = ()
) -> subprocess.Popen[bytes]:
    """Start `python -m MODULE JOB` with its stderr in a log.

    Args:
        module: a module of this package, which calls `take_stdout` first.
        job: its argument.
        log: an open file.
        threads: OpenMP threads, if above 0.
        descriptors: file descriptors for the child to inherit; ignored on Windows.
    """
    package_root = str(Path(nerfcli.__file__).parent.parent)
    # An empty entry would mean the current folder, whose files must not be imported.
    places = [package_root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
    if threads > 0:
        environment["OMP_NUM_THREADS"] = str(threads)
    return subprocess.Popen(
        # -P: otherwise a file numpy.py or a folder nerfcli in the user's current folder would be imported.
        [sys.executable, "-P", "-m", module, str(job)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log,
        env=environment,
        pass_fds=() if sys.platform == "win32" else descriptors,
        # Ctrl-C reaches the whole process group of a terminal; only the parent handles it, and ends the child.
        start_new_session=True,
    )


def messages(child: subprocess.Popen[bytes]) -> Generator[dict[str, Any], None, None]:
    """Yield the messages of the child until it ends; closing the iterator kills the child."""
    try:
        assert child.stdout is not None
        for line in child.stdout:
            yield json.loads(line)
        child.wait()
    finally:
        child.kill()
        child.communicate()


def take_stdout() -> Callable[[dict[str, Any]], None]:
    """Return, in the child, a function that sends a message; from now on nothing else writes to stdout.

    The process ends at once when its stdin closes, which happens whenever the parent dies, even if it is killed.
    """
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # sent to all processes of a command, but handled by the parent

    def send(message: dict[str, Any]) -> None:
        channel.write(json.dumps(message) + "\n")
        channel.flush()

    return send


def _end_with_parent() -> None:
    os.read(0, 1)
    os._exit(1)
