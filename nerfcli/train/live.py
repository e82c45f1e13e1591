"""Live view of a training: its field every few seconds, pause and stop."""

import time
from collections.abc import Callable
from pathlib import Path

from nerfcli.errors import UserError
from nerfcli.render.model import Model, save_model
from nerfcli.runs.live import (
    VIEWER_SECONDS,
    Pulse,
    Request,
    Status,
    end_training,
    live_field,
    read_request,
    write_status,
)

# Interval at which a training looks for viewers, interval at which they get a field, and fraction of time for that.
LOOK_SECONDS, FIELD_SECONDS, MOST_OF_TIME = 0.5, 2.0, 0.03
_PAUSED_SECONDS = 0.1


class LiveTraining:
    """Answers the viewers of a training, see `runs.live`.

    Args:
        still_wanted: called while the training is paused; raises to end it.
    """

    def __init__(
        self,
        run: Path,
        model: Callable[[], Model],
        *,
        still_wanted: Callable[[], None],
        notify: Callable[[str], None],
    ):
        self._run, self._model, self._still_wanted, self._notify = run, model, still_wanted, notify
        self._pulse = Pulse(VIEWER_SECONDS)
        self._next_look = self._next_field = 0.0
        self._count = self._fields = 0
        self._watched = self._failed = False

    def after_step(self, *, fraction: float, step: int, seconds: float, loss: float) -> None:
        """Write what viewers request, and wait while they have the training paused.

        Raises:
            KeyboardInterrupt: somebody stopped the training.
        """
        if time.monotonic() < self._next_look or self._failed:
            return

        def write(paused: bool) -> None:
            self._count += 1
            write_status(self._run, Status(self._count, fraction, step, seconds, loss, paused, self._fields))

        try:
            request = self._request()
            if request is not None:
                if request.paused or time.monotonic() >= self._next_field:
                    self._write_field()
                write(request.paused)
                if request.paused:
                    self._wait(lambda: write(True))
                    write(False)
        except UserError as error:  # a training goes on without its viewer
            self._failed = True
            self._notify(f"the training can no longer be viewed: {error.message}")
        self._next_look = time.monotonic() + LOOK_SECONDS

    def end(self, *, seconds: float = 0.0) -> None:
        """Remove the live files; wait some seconds if a viewer is there, so that it can load the last checkpoint."""
        if not self._watched:
            return
        end_training(self._run)
        request = read_request(self._run)
        if self._pulse.beats(None if request is None else request.count):
            time.sleep(seconds)

    def _request(self) -> Request | None:
        """Return the request of a viewer, None without a live viewer; raise KeyboardInterrupt if it is to stop."""
        request = read_request(self._run)
        if not self._pulse.beats(None if request is None else request.count):
            return None
        self._watched = True
        if request is not None and request.stop:
            raise KeyboardInterrupt
        return request

    def _write_field(self) -> None:
        began = time.monotonic()
        save_model(live_field(self._run), self._model())
        self._fields += 1
        took = time.monotonic() - began
        self._next_field = began + max(FIELD_SECONDS, took / MOST_OF_TIME)

    def _wait(self, write: Callable[[], None]) -> None:
        """Wait as long as a live viewer requests a pause."""
        next_status = 0.0
        while (request := self._request()) is not None and request.paused:
            if time.monotonic() >= next_status:
                write()
                next_status = time.monotonic() + 1.0
            time.sleep(_PAUSED_SECONDS)
            self._still_wanted()
