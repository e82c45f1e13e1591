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


def warn_python(text: str) -> None:
    """Issue a Python warning with `warnings.warn`."""
    warnings.warn(text, stacklevel=3)
