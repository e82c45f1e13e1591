"""RUN/.live: files through which the viewer of a run and its training communicate; they are two processes.

While a viewer is open, it writes a request about every second; a counter in the request shows that the viewer is alive.
The training answers with its status and, every few seconds, its field. Without a viewer there are no files, and the
training only checks for a request twice a second. The clocks of two machines that share a disk are never compared.
"""

import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TypeVar

from nerfcli.atomic import write_json
from nerfcli.runs.files import FIELD, LIVE

REQUEST, STATUS = "request.json", "status.json"
# After this long without a new count, the other side is considered gone.
VIEWER_SECONDS, TRAINING_SECONDS = 5.0, 20.0


@dataclass(frozen=True)
class Request:
    """Request of a viewer: fields to show, a pause, or the end of the training."""

    count: int
    paused: bool = False
    stop: bool = False


@dataclass(frozen=True)
class Status:
    """State of a training: `fraction` is the fraction of the budget spent, `fields` the number written for viewers."""

    count: int
    fraction: float
    step: int
    seconds: float
    loss: float
    paused: bool
    fields: int


Message = TypeVar("Message", Request, Status)


class Pulse:
    """Detects from a counter whether the other side is alive.

    Args:
        seconds: time without a new count after which the other side is considered gone.
        clock: returns the time of this process, seconds.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic):
        self._seconds, self._clock = seconds, clock
        self._count: int | None = None
        self._since = -float("inf")

    def beats(self, count: int | None) -> bool:
        """Return whether the other side is alive; `count` is the last count that it wrote, None if there is none."""
        if count != self._count:
            # The first count may have been written years ago.
            fresh = self._count is not None and count is not None
            self._since = self._clock() if fresh else -float("inf")
            self._count = count
        return count is not None and self._clock() - self._since < self._seconds


def live_field(run: Path) -> Path:
    """Return the path at which a training writes its field for viewers."""
    return run / LIVE / FIELD


def write_request(run: Path, request: Request) -> None:
    """Write the request of a viewer."""
    write_json(run / LIVE / REQUEST, asdict(request))


def read_request(run: Path) -> Request | None:
    """Return the request of a viewer; None if there is none, or it cannot be read."""
    return _read(run / LIVE / REQUEST, Request)


def write_status(run: Path, status: Status) -> None:
    """Write the state of a training."""
    write_json(run / LIVE / STATUS, asdict(status))


def read_status(run: Path) -> Status | None:
    """Return the state of a training; None if there is none, or it cannot be read."""
    return _read(run / LIVE / STATUS, Status)


def end_request(run: Path) -> None:
    """Remove the viewer's request, and the folder if the training has no files in it."""
    (run / LIVE / REQUEST).unlink(missing_ok=True)
    with suppress(OSError):  # the folder is not empty, or does not exist
        (run / LIVE).rmdir()


def end_training(run: Path) -> None:
    """Remove the files that the training wrote."""
    for name in (STATUS, FIELD):
        (run / LIVE / name).unlink(missing_ok=True)


def _read(path: Path, kind: type[Message]) -> Message | None:
    # Files are replaced atomically. One that has just been removed, or is of another version, counts as missing.
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    is_whole = isinstance(content, dict) and content.keys() == {entry.name for entry in fields(kind)}
    return kind(**content) if is_whole else None
