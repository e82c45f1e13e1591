"""State of one bench: its time, its records, its progress messages."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nerfcli.bench.records import Records


@dataclass
class Session:
    """State of one bench; its time includes measurements of earlier calls.

    Args:
        records: the measurements, earlier calls included.
        budget_seconds: time limit for the whole bench.
        tell: called with (fraction of the budget used, current work).
        notify: called with lines for the user.
    """

    records: Records
    budget_seconds: float
    tell: Callable[[float, str], None]
    notify: Callable[[str], None]
    _spent: float = 0.0
    _lap: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self._spent = sum(entry.get("took", 0.0) for entry in self.records.all())

    @property
    def folder(self) -> Path:
        return self.records.folder

    @property
    def spent(self) -> float:
        """Seconds used so far."""
        return self._spent + time.monotonic() - self._lap

    def record(self, kind: str, **content: Any) -> None:
        """Record a measurement, with the time since the previous one."""
        now = time.monotonic()
        self.records.append(kind, took=round(now - self._lap, 3), **content)
        self._spent += now - self._lap
        self._lap = now

    def say(self, doing: str) -> None:
        """Report the current work and the remaining time."""
        left = max(0.0, self.budget_seconds - self.spent)
        text = f"{left / 60:.0f} min" if left >= 90 else f"{left:.0f} s"
        self.tell(min(1.0, self.spent / self.budget_seconds), f"{doing}, about {text} left")
