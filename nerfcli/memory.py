"""Memory of the machine and of processes.

What counts is what is resident. A limit on the address space (RLIMIT_AS) would be simpler, but it counts what is merely
reserved: the libraries, the stacks and heaps of threads, gigabytes that never become memory.
"""

import ctypes
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

# Of what the machine, or the container, has. The rest is for its other processes and for the cache of files.
_DEFAULT_SHARE = 0.8
_CGROUP_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
# Parameters of glibc's mallopt; memory that is always returned: arrays of this size, and more than this left over.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_RETURNED_ARRAY, _RETURNED_REST = 2**30, 2**31 - 1


def default_memory_limit(device: str = "cpu") -> int | None:
    """Return four fifths of the memory of the machine or container, in bytes; None if unknown, and for a GPU, where all
    that is free may be used.
    """
    if device != "cpu":
        return None
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not a POSIX system
        return None
    for path in _CGROUP_LIMITS:
        try:
            total = min(total, int(Path(path).read_text()))
        except (OSError, ValueError):  # no such file, or the word "max"
            continue
    return int(_DEFAULT_SHARE * total)


def resident_bytes(pid: int) -> int:
    """Resident memory of a process, 0 if it has ended or the system has no word for it."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return _resident_by_ps(pid)


def _resident_by_ps(pid: int) -> int:
    """Ask `ps`, on systems without /proc."""
    try:
        text = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=False).stdout
    except OSError:
        return 0
    return int(text) * 1024 if text.strip().isdigit() else 0


def keep_freed_memory() -> bool:
    """Keep the memory of freed arrays for the next ones, in one heap for all threads, instead of returning it.

    A training step allocates what the last one freed. The system would clear each page of it again, for up to 14 ms
    of CPU time in a step of 62 ms on two threads. Call it before libraries start threads: heaps that exist stay.

    Returns:
        False where the C library is not glibc; nothing changes then.
    """
    mallopt = _glibc_function("mallopt")
    if mallopt is None:
        return False
    mallopt(_ARENA_MAX, 1)
    mallopt(_MMAP_THRESHOLD, _RETURNED_ARRAY)
    mallopt(_TRIM_THRESHOLD, _RETURNED_REST)
    return True


def return_freed_memory() -> None:
    """Return to the system what `keep_freed_memory` has kept, after work that needed much of it."""
    if (trim := _glibc_function("malloc_trim")) is not None:
        trim(0)


def _glibc_function(name: str) -> Callable[..., int] | None:
    """Find a function of the C library; None on Windows, and where the library lacks it."""
    try:
        return getattr(ctypes.CDLL(None), name, None)
    except TypeError:  # Windows takes no None
        return None
