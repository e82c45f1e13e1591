"""Errors that a user can fix: one exception, the exit codes that scripts rely on, and parts of messages."""

import shlex
from collections.abc import Sequence
from pathlib import Path

BAD_INPUT = 3
TOO_FEW_PHOTOS = 4
NON_FINITE = 5
OUT_OF_MEMORY = 6
GATE_NOT_MET = 7
LOST_RANK = 8
INTERRUPTED = 130
TERMINATED = 143


class UserError(Exception):
    """A problem that the user can fix, reported in two lines.

    Args:
        message: the problem, with the value and the file; no trailing full stop needed.
        hint: what was expected, and how to fix it.
        exit_code: the process's exit status, one of the constants of this module.
    """

    def __init__(self, message: str, hint: str, exit_code: int = BAD_INPUT):
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.exit_code = exit_code


def reason_of(error: BaseException) -> str:
    """Describe an exception in one line: its type and the first line of its text."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def several(count: int, singular: str, plural: str = "") -> str:
    """Return a count with its noun: 1 photo, 2 photos."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def duration(seconds: float) -> str:
    """Format a duration: 8 s, 3 min, 1.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def listed(names: Sequence[str]) -> str:
    """Return names separated by commas; if there are more than six, the others are only counted."""
    more = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return ", ".join(names[:6]) + more


def in_shell(path: Path) -> str:
    """Return a path as it is typed in a shell: quoted if it has spaces, and with ./ if it begins with a dash."""
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)
