"""File locks for one process at a time, released when the process ends or is killed."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfcli.atomic import cannot_write
from nerfcli.errors import UserError


@contextmanager
def exclusive(path: Path, holder: str) -> Iterator[int]:
    """Hold the lock of a file, which is created with its folder if necessary.

    Args:
        path: the file; its content is unused.
        holder: description of the holder for the error message: "nerfcli poses is at work on photos-scene".

    Yields:
        The descriptor. A child process that inherits it also holds the lock, until both have ended.

    Raises:
        UserError: another process holds the lock, or the file cannot be created.
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
