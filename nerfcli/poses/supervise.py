"""Run the worker: hear its progress, end it when we end, and tell in words how it died if it did."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import nerfcli
from nerfcli.errors import OUT_OF_MEMORY, UserError

_STAGES = {"extract": "finding features", "match": "matching photos", "map": "placing photos"}


def run_worker(job_path: Path, *, threads: int, progress: Callable[[str, int, int], None]) -> None:
    """Run `nerfcli.poses.worker` on a job until it is done; it is dead when this returns or raises.

    Args:
        job_path: the job's JSON file; the worker's log is written beside it.
        threads: for OpenMP inside pycolmap, -1 for all.
        progress: told (stage, done, total).

    Raises:
        UserError: the worker died; the text says while doing what, and its last words.
    """
    log = job_path.with_name("worker.log")
    package_root = str(Path(nerfcli.__file__).parent.parent)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([package_root, os.environ.get("PYTHONPATH", "")])}
    if threads > 0:
        environment["OMP_NUM_THREADS"] = str(threads)
    stage = "starting"
    with log.open("wb") as stderr:
        worker = subprocess.Popen(
            [sys.executable, "-m", "nerfcli.poses.worker", str(job_path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            env=environment,
            # Ctrl-C on a terminal goes to its whole process group; only we answer it, by ending the worker.
            start_new_session=True,
        )
        try:
            assert worker.stdout is not None
            for line in worker.stdout:
                message = json.loads(line)
                stage = f"{_STAGES[message['stage']]} ({message['done']} of {message['total']} done)"
                progress(message["stage"], message["done"], message["total"])
            worker.wait()
        finally:
            worker.kill()
            worker.communicate()
    if worker.returncode != 0:
        raise explain_death(worker.returncode, stage, log.read_text(encoding="utf-8", errors="replace"))


def explain_death(returncode: int, stage: str, log: str) -> UserError:
    """The error for a worker that ended with `returncode` while at `stage`, with the last words of its log."""
    if returncode == -signal.SIGKILL:
        return UserError(
            f"structure from motion was killed while {stage}, most likely for want of memory",
            "use smaller photos, fewer features or fewer threads",
            OUT_OF_MEMORY,
        )
    how = signal.Signals(-returncode).name if returncode < 0 else f"exit status {returncode}"
    return UserError(
        f"structure from motion died ({how}) while {stage}: {_last_words(log)}",
        "try once more with one thread; if it dies again, leave out the photos that came last, or report it",
    )


def _last_words(log: str) -> str:
    """The last lines that say something: not the stack frames that glog prints below them."""
    lines = [line.strip() for line in log.splitlines() if line.strip() and not line.strip().startswith(("@", "***"))]
    return " / ".join(lines[-3:]) or "no message"
