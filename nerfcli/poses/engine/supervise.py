"""Run the worker process: receive its progress, enforce limits, stop it with the parent, and explain its failures."""

import json
import os
import shutil
import signal
import subprocess
import time
from contextlib import closing
from errno import ENOSPC
from pathlib import Path
from typing import Any

from nerfcli import child
from nerfcli.errors import OUT_OF_MEMORY, UserError, duration
from nerfcli.machine import resident_bytes
from nerfcli.poses.input.job import Report, Tell, repeatedly
from nerfcli.poses.input.plan import STAGES
from nerfcli.poses.judge.checks import UNDERWAY

_GO_ON = "completed work is kept; run the same command again to continue"
_LESS_MEMORY = "use smaller photos (--max-size), fewer features (--quality fast) or fewer threads (--threads)"


class WorkerDiedError(UserError):
    """The worker ended by itself, or at a limit of time or memory; not because the disk was full.

    check: the name of the check that it was computing, if any.
    """

    check: str | None = None


def run_worker(
    job_path: Path,
    *,
    threads: int,
    progress: Report,
    memory_bytes: int | None = None,
    lock: int | None = None,
    notify: Tell = lambda note: None,
) -> None:
    """Run `nerfcli.poses.engine.worker` on a job until it is done; it has ended when this returns or raises.

    Args:
        job_path: the job's JSON file; the worker's log is written beside it.
        threads: for OpenMP inside pycolmap.
        memory_bytes: the worker is stopped when its resident memory exceeds this; None for no limit.
        lock: a descriptor that the worker inherits.

    Raises:
        WorkerDiedError: the worker died; the message has the stage, and the last lines of its log. Or it was stopped
            because it needed too much memory, or a check too much time.
        UserError: the disk is full.
    """
    log = job_path.with_name("worker.log")
    stage = "starting"
    with log.open("wb") as stderr:
        module, descriptors = "nerfcli.poses.engine.worker", () if lock is None else (lock,)
        worker = child.spawn(module, job_path, log=stderr, threads=threads, descriptors=descriptors)
        underway = job_path.with_name(UNDERWAY)
        guard = _Guard(worker, memory_bytes, underway)
        # Memory can double in a second or two, when a photo is decoded or a bundle adjustment begins.
        with repeatedly(guard.look, seconds=0.1), closing(child.messages(worker)) as messages:
            for message in messages:
                if "note" in message:
                    notify(message["note"])
                    continue
                stage = f"{STAGES[message['stage']].doing} ({message['done']} of {message['total']} done)"
                progress(message["stage"], message["done"], message["total"])
    if worker.returncode == 0:
        return
    if guard.reached == "check":
        overdue = WorkerDiedError(f"it took longer than {duration(guard.check['seconds'])}", _GO_ON)
        overdue.check = guard.check["check"]
        raise overdue
    if guard.reached == "memory":
        assert memory_bytes is not None
        error = _out_of_memory(f"was stopped while {stage}: it needed more than {memory_bytes / 1e9:.3g} GB of memory")
    else:
        free_bytes = shutil.disk_usage(job_path.parent).free
        error = explain_death(worker.returncode, stage, log.read_text(encoding="utf-8", errors="replace"), free_bytes)
    if isinstance(error, WorkerDiedError) and underway.exists():
        error.check = json.loads(underway.read_text(encoding="utf-8"))["check"]
    raise error


def explain_death(returncode: int, stage: str, log: str, free_bytes: int) -> UserError:
    """Return the error for a worker that ended during `stage`, by its log, which may be empty if the disk is full."""
    # With less free space, SQLite and pycolmap cannot write the next part.
    if free_bytes < 2_000_000 or "disk is full" in log or os.strerror(ENOSPC) in log:
        return UserError(
            f"structure from motion stopped while {stage}: the disk is full ({free_bytes / 1e6:.1f} MB free)",
            f"free some disk space, or choose another disk with -o; {_GO_ON}",
        )
    if returncode == -9:  # SIGKILL, which Python's signals on Windows lack
        return _out_of_memory(f"was killed while {stage}, most likely because memory ran out")
    if "bad_alloc" in log or "MemoryError" in log:
        return _out_of_memory(f"ran out of memory while {stage}")
    how = signal.Signals(-returncode).name if returncode < 0 else f"exit status {returncode}"
    return WorkerDiedError(
        f"structure from motion crashed ({how}) while {stage}: {_last_words(log)}",
        "try again with --threads 1; if it crashes again, remove the last photos, or report it",
    )


class _Guard:
    """Kills a worker when it exceeds a limit; `reached` is then the name of the limit.

    check: the content of `UNDERWAY` when it was last read.
    """

    def __init__(self, worker: subprocess.Popen[bytes], most_bytes: int | None, underway: Path):
        self._worker, self._most_bytes, self._underway = worker, most_bytes, underway
        self.reached: str | None = None
        self.check: dict[str, Any] = {}
        self._check_written, self._check_seen = 0, 0.0

    def look(self) -> None:
        """Look at the worker's memory and at the time of its current check."""
        if self.reached is not None:
            return
        if self._most_bytes is not None and resident_bytes(self._worker.pid) > self._most_bytes:
            self.reached = "memory"
        elif self._is_overdue():
            self.reached = "check"
        if self.reached is not None:
            self._worker.kill()

    def _is_overdue(self) -> bool:
        """Return whether the current check has exceeded its time limit."""
        try:
            written = self._underway.stat().st_mtime_ns
            if written != self._check_written:
                self.check = json.loads(self._underway.read_text(encoding="utf-8"))
                self._check_written, self._check_seen = written, time.monotonic()
        except OSError:  # no check is under way, or it has just ended
            return False
        most = self.check["seconds"]
        return most is not None and time.monotonic() - self._check_seen > most


def _out_of_memory(how: str) -> WorkerDiedError:
    return WorkerDiedError(f"structure from motion {how}", f"{_LESS_MEMORY}; {_GO_ON}", OUT_OF_MEMORY)


def _last_words(log: str) -> str:
    """Return the last informative lines of the log, without the stack frames that glog prints below them."""
    lines = [line.strip() for line in log.splitlines() if line.strip() and not line.strip().startswith(("@", "***"))]
    return " / ".join(lines[-3:]) or "no message"
