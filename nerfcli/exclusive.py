"""One process at a time: locks that a process which is killed lets go of."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfcli.atomic import cannot_write
from nerfcli.errors import UserError


@contextmanager
def exclusive(path: Path, holder: str) -> Iterator[int]:
    """Hold the lock of a file, which is made if need be, with its folder.

    Args:
        path: the file; its content is unused.
        holder: who holds it, for those that come too late: "nerfcli poses is at work on photos-scene".

    Yields:
        The descriptor. A child process that inherits it holds the lock, too, until both have ended.

    Raises:
        UserError: another process holds it, or the file cannot be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise cannot_write(path.parent, error) from error
    try:
        if not _take(lock):
            raise UserError(f"another {holder}", "wait until it has finished, or choose another folder with -o")
        yield lock
    finally:
        os.close(lock)


if sys.platform == "win32":
    import msvcrt

    def _take(lock: int) -> bool:
        try:
            msvcrt.locking(lock, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def _take(lock: int) -> bool:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True
