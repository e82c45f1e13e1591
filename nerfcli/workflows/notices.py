"""Callbacks of workflows: messages, warnings, progress; by default only warnings are shown."""

import warnings
from collections.abc import Callable

# Takes a line for the user.
Notify = Callable[[str], None]
# Takes how much is done, in [0, 1], and a few words about it, as often as one likes.
Progress = Callable[[float, str], None]


def silent(text: str) -> None:
    """Drop a line."""


def no_progress(fraction: float, detail: str) -> None:
    """Show no progress."""


def warn_python(text: str) -> None:
    """Warn as Python programs do, by `warnings.warn`."""
    warnings.warn(text, stacklevel=3)
