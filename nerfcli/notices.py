"""Callbacks of workflows: messages, warnings, progress; by default only warnings are shown."""

import warnings
from collections.abc import Callable

# Called with a line of text for the user.
Notify = Callable[[str], None]
# Called with the fraction done, in [0, 1], and a short text about it, as often as desired.
Progress = Callable[[float, str], None]


def silent(text: str) -> None:
    """Discard a line."""


def no_progress(fraction: float, detail: str) -> None:
    """Show no progress."""


def part_of(progress: Progress, start: float, end: float, words: str) -> Callable[[float], None]:
    """Return a function that reports the progress of a part of the work, from `start` to `end` of the whole."""
    return lambda fraction: progress(start + (end - start) * fraction, words)


def warn_python(text: str) -> None:
    """Issue a Python warning with `warnings.warn`."""
    warnings.warn(text, stacklevel=3)
