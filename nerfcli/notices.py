"""What a workflow tells the user: lines of text, warnings, progress."""

import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

# Called with a line of text for the user.
Notify = Callable[[str], None]
# Called with the fraction done, in [0, 1], and a short text about it, as often as desired.
Progress = Callable[[float, str], None]


def silent(text: str) -> None:
    """Discard a line."""


def no_progress(fraction: float, detail: str) -> None:
    """Show no progress."""


def warn_python(text: str) -> None:
    """Issue a Python warning with `warnings.warn`."""
    warnings.warn(text, stacklevel=3)


@dataclass(frozen=True)
class Reporter:
    """Where a workflow's messages go; by default only warnings are shown.

    Args:
        note: called with lines for the user.
        warn: called with warnings.
        progress: called with the fraction done and a short text.
        titled: called with the title of a stage; provides the reporter of that stage.
    """

    note: Notify = silent
    warn: Notify = warn_python
    progress: Progress = no_progress
    titled: "Callable[[str], AbstractContextManager[Reporter]] | None" = None

    def stage(self, title: str) -> "AbstractContextManager[Reporter]":
        """Provide the reporter of a stage of the work, whose progress runs from 0 to 1."""
        return nullcontext(self) if self.titled is None else self.titled(title)

    def part(self, start: float, end: float, words: str) -> Callable[[float], None]:
        """Return a function that reports the progress of a part of the work, from `start` to `end` of the whole."""
        return lambda fraction: self.progress(start + (end - start) * fraction, words)
