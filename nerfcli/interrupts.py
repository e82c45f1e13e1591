"""Ctrl-C and SIGTERM: both end a command in the same way, at the next point where the saved state is complete.

SIGTERM comes from `kill`, `timeout`, systemd and cluster schedulers. Some of them send it more than once, to the
command alone and to its group; only the first one counts. SIGKILL ends a command without waiting.
"""

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

# Long enough for the callback to return, short enough to go unnoticed.
_AGAIN_SECONDS = 0.05


class Terminated(KeyboardInterrupt):
    """SIGTERM was received; code that handles Ctrl-C handles this, too."""


def install_handlers() -> None:
    """Make SIGTERM raise `Terminated`, unless the parent process ignores it, and make sure that no interrupt is lost.

    Python drops exceptions raised in a callback from C code (as in numba's compiler) or while an object is freed;
    a dropped interrupt is raised again shortly afterwards.
    """
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)
    sys.unraisablehook = _raise_again


def restore_sigterm() -> None:
    """Restore Python's SIGTERM handler after a C++ library has replaced it.

    Only the main thread may set handlers; in other threads nothing changes.
    """
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None:
        with suppress(ValueError):
            signal.signal(signal.SIGTERM, handler)


class Interrupts:
    """Records whether Ctrl-C or SIGTERM arrived."""

    def __init__(self) -> None:
        self.came: type[KeyboardInterrupt] | None = None

    def note(self, signum: int, frame: FrameType | None) -> None:
        """Record the first signal; a Ctrl-C after it is raised at once."""
        if signum == signal.SIGTERM:
            self.came = self.came or Terminated
        elif self.came is not None:
            raise KeyboardInterrupt
        else:
            self.came = KeyboardInterrupt

    def raise_if_pending(self) -> None:
        """Raise the interrupt that arrived, if any.

        Raises:
            KeyboardInterrupt: Ctrl-C arrived.
            Terminated: SIGTERM arrived.
        """
        if self.came is not None:
            raise self.came


@contextmanager
def deferred_interrupts() -> Iterator[Interrupts]:
    """Defer Ctrl-C, and SIGTERM if `install_handlers` handles it, until `raise_if_pending`.

    In other threads than the main thread, which do not receive signals, nothing is deferred.
    """
    interrupts = Interrupts()
    try:
        before = signal.signal(signal.SIGINT, interrupts.note)
    except ValueError:
        yield interrupts
        return
    heard = signal.getsignal(signal.SIGTERM) is _terminate
    if heard:
        signal.signal(signal.SIGTERM, interrupts.note)
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)
        if heard:
            signal.signal(signal.SIGTERM, signal.SIG_IGN if interrupts.came is Terminated else _terminate)


def _terminate(signum: int, frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise Terminated


def _raise_again(dropped: "sys.UnraisableHookArgs") -> None:
    if not isinstance(dropped.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(dropped)
        return
    number = signal.SIGINT
    if isinstance(dropped.exc_value, Terminated):
        number = signal.SIGTERM
        signal.signal(number, _terminate)
    again = threading.Timer(_AGAIN_SECONDS, _send, [number])
    again.daemon = True  # the command may end first
    again.start()


def _send(number: signal.Signals) -> None:
    if sys.platform == "win32":
        _thread.interrupt_main(number)
        return
    main = threading.main_thread().ident
    assert main is not None
    signal.pthread_kill(main, number)  # also ends a blocking wait
