"""Run the checks of a finished model so that none of them can lose it.

A check is auxiliary: what it raises is noted as its reason, and the other checks go on. A check that ends the whole
process leaves its name behind in a file, by which the next process knows which one to leave out. The file also says how
long the check may take: who supervises the process ends it then, since no thread of its own can while C++ computes.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from nerfcli.atomic import write_json
from nerfcli.errors import reason_of

T = TypeVar("T")

# Holds the name of the check that is being computed; it is there only while one is.
UNDERWAY = "check-underway.json"


class Checks:
    """Run checks by name and remember which could not be computed.

    Args:
        folder: where the name of the check being computed is written; None to write nothing.
        skip: reasons by the names of checks that must not be started, because they ended an earlier process.
        seconds: that each may take.
    """

    def __init__(
        self, folder: Path | None = None, *, skip: Mapping[str, str] | None = None, seconds: float | None = None
    ) -> None:
        self.not_computed: dict[str, str] = {}
        self._folder = folder
        self._skip = dict(skip or {})
        self._seconds = seconds

    def run(self, name: str, compute: Callable[[], T], *, otherwise: T, seconds: float | None = None) -> T:
        """Return what `compute` returns, or `otherwise` if it raises or is to be skipped.

        Args:
            name: of the check.
            compute: computes it.
            otherwise: what to return where it cannot be computed.
            seconds: that it may take, if not as long as each of the others.

        Example:
            >>> Checks().run("pose uncertainty", lambda: 1 / 0, otherwise=None)
        """
        if name in self._skip:
            self.not_computed[name] = self._skip[name]
            return otherwise
        marker = None if self._folder is None else self._folder / UNDERWAY
        if marker is not None:
            write_json(marker, {"check": name, "seconds": self._seconds if seconds is None else seconds})
        try:
            return compute()
        except Exception as error:  # pycolmap, SciPy and NumPy raise what they like
            self.not_computed[name] = reason_of(error)
            return otherwise
        finally:
            if marker is not None:
                marker.unlink(missing_ok=True)
