"""RUN/.live: how a viewer of a run and its training, which are two processes, talk to each other.

While somebody looks, the viewer writes a request about every second; a counter in it shows that the viewer lives. The
training answers with its status and, every few seconds, its field. Nobody looks: there are no files, and the training
only looks for one twice a second. Clocks of two machines that share a disk are never compared.
"""

import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nerfcli.atomic import write_json
from nerfcli.runs.files import FIELD, LIVE

REQUEST, STATUS = "request.json", "status.json"
# Without a new count for so long, the other side has gone.
VIEWER_SECONDS, TRAINING_SECONDS = 5.0, 20.0


@dataclass(frozen=True)
class Request:
    """Request of a viewer: fields to show, a pause, or the end of the training."""

    count: int
    paused: bool = False
    stop: bool = False


@dataclass(frozen=True)
class Status:
    """State of a training: `share` of the budget, `fields` written for viewers."""

    count: int
    share: float
    step: int
    seconds: float
    loss: float
    paused: bool
    fields: int


class Pulse:
    """Tells by a counter whether the other side lives.

    Args:
        seconds: without a new count after which it has gone.
        clock: seconds of this process.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic):
        self._seconds, self._clock = seconds, clock
        self._count: int | None = None
        self._since = -float("inf")

    def beats(self, count: int | None) -> bool:
        """Return whether it lives; `count` is what it last wrote, None where there is nothing."""
        if count != self._count:
            # The first count that is seen may be years old.
            fresh = self._count is not None and count is not None
            self._since = self._clock() if fresh else -float("inf")
            self._count = count
        return count is not None and self._clock() - self._since < self._seconds


def live_field(run: Path) -> Path:
    """Return where a training puts its field for viewers."""
    return run / LIVE / FIELD


def write_request(run: Path, request: Request) -> None:
    """Write what a viewer wants."""
    write_json(run / LIVE / REQUEST, asdict(request))


def read_request(run: Path) -> Request | None:
    """Return what a viewer wants; None where nothing can be read."""
    content = _read(run / LIVE / REQUEST)
    return None if content is None else Request(**content)


def write_status(run: Path, status: Status) -> None:
    """Write the state of a training."""
    write_json(run / LIVE / STATUS, asdict(status))


def read_status(run: Path) -> Status | None:
    """Return the state of a training; None where nothing can be read."""
    content = _read(run / LIVE / STATUS)
    return None if content is None else Status(**content)


def end_request(run: Path) -> None:
    """Remove the viewer's request, and the folder if the training has left it."""
    (run / LIVE / REQUEST).unlink(missing_ok=True)
    with suppress(OSError):  # it is not empty, or not there
        (run / LIVE).rmdir()


def end_training(run: Path) -> None:
    """Remove what the training wrote."""
    for name in (STATUS, FIELD):
        (run / LIVE / name).unlink(missing_ok=True)


def _read(path: Path) -> dict[str, Any] | None:
    # Files are replaced whole; one that goes away, or is of another version, is none.
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    kind = Request if path.name == REQUEST else Status
    return content if isinstance(content, dict) and content.keys() == kind.__dataclass_fields__.keys() else None
