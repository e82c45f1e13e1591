"""Child processes that report in lines of JSON on stdout, and end when their parent does."""

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
        module: of this program; it calls `take_stdout` first.
        job: the argument.
        log: an open file.
        threads: for OpenMP, where above 0.
        descriptors: that the child inherits; none on Windows.
    """
    package_root = str(Path(nerfcli.__file__).parent.parent)
    # An empty entry would mean the current folder, whose files must not pass for libraries.
    places = [package_root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
    if threads > 0:
        environment["OMP_NUM_THREADS"] = str(threads)
    return subprocess.Popen(
        # -P: else a file numpy.py or a folder nerfcli where the user happens to be would be taken for ours.
        [sys.executable, "-P", "-m", module, str(job)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log,
        env=environment,
        pass_fds=() if sys.platform == "win32" else descriptors,
        # Ctrl-C on a terminal goes to its whole process group; only the parent answers it, by ending the child.
        start_new_session=True,
    )


def messages(child: subprocess.Popen[bytes]) -> Generator[dict[str, Any], None, None]:
    """Yield what the child reports until it ends; it is dead when the iterator is exhausted or closed."""
    try:
        assert child.stdout is not None
        for line in child.stdout:
            yield json.loads(line)
        child.wait()
    finally:
        child.kill()
        child.communicate()


def take_stdout() -> Callable[[dict[str, Any]], None]:
    """Return a function, in the child, that sends a message; nothing else writes to stdout from here on.

    The process ends at once when its stdin closes, which is what happens when the parent dies, however it dies.
    """
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # sent to all processes of a command: the parent answers it

    def send(message: dict[str, Any]) -> None:
        channel.write(json.dumps(message) + "\n")
        channel.flush()

    return send


def _end_with_parent() -> None:
    os.read(0, 1)
    os._exit(1)
