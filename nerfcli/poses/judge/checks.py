"""Run the checks of a finished model so that none of them can cause its loss.

A check is auxiliary: if it raises an exception, the reason is noted and the other checks continue. A check that ends
the whole process leaves its name in a file, so that the next process leaves it out. The file also has the time limit of
the check, which the supervising process enforces, since no thread of the worker can while C++ code computes.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from nerfcli.atomic import write_json
from nerfcli.errors import reason_of
from nerfcli.poses.input.job import Job
from nerfcli.poses.input.plan import checking_seconds, limit_seconds

T = TypeVar("T")

# Holds the name of the check being computed; it exists only during a check.
UNDERWAY = "check-underway.json"


class Checks:
    """Run checks by name and remember which could not be computed.

    Args:
        folder: where the name of the check being computed is written; None to write nothing.
        skip: reasons, by name, of checks that must not be started because they ended an earlier process.
        seconds: time limit of each check.
    """

    def __init__(
        self, folder: Path | None = None, *, skip: Mapping[str, str] | None = None, seconds: float | None = None
    ) -> None:
        self.not_computed: dict[str, str] = {}
        self._folder = folder
        self._skip = dict(skip or {})
        self._seconds = seconds

    def run(self, name: str, compute: Callable[[], T], *, otherwise: T, seconds: float | None = None) -> T:
        """Return what `compute` returns within `seconds`, or `otherwise` if it raises or is to be skipped.

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
        except Exception as error:  # pycolmap, SciPy and NumPy raise various types
            self.not_computed[name] = reason_of(error)
            return otherwise
        finally:
            if marker is not None:
                marker.unlink(missing_ok=True)


def checks_of(job: Job) -> Checks:
    """Return a runner of the checks of one model of a job's photos, within a time limit."""
    most = limit_seconds(checking_seconds(len(job.files)))
    return Checks(Path(job.folder), skip=dict(job.skipped_checks), seconds=most)
