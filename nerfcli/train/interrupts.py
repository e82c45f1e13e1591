"""Ctrl-C between steps: what is saved then is a state from which the training goes on bit for bit."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupts:
    """Whether Ctrl-C came."""

    def __init__(self) -> None:
        self._came = False

    def note(self, signum: int, frame: FrameType | None) -> None:
        """Remember the first; the second does not wait."""
        if self._came:
            raise KeyboardInterrupt
        self._came = True

    def answer(self) -> None:
        """Raise what came meanwhile.

        Raises:
            KeyboardInterrupt: Ctrl-C came.
        """
        if self._came:
            raise KeyboardInterrupt


@contextmanager
def held_back() -> Iterator[Interrupts]:
    """Hold Ctrl-C back until it is asked for; a second one comes through at once.

    Outside of the main thread, to which Ctrl-C does not come, nothing is held back.
    """
    interrupts = Interrupts()
    try:
        before = signal.signal(signal.SIGINT, interrupts.note)
    except ValueError:
        yield interrupts
        return
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)
