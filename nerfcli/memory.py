"""Memory of the machine and of processes.

Only resident memory counts. A limit on the address space (RLIMIT_AS) would be simpler, but it includes memory that is
merely reserved: libraries, thread stacks and heaps, gigabytes that are never used.
"""

import ctypes
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

# Fraction of the memory of the machine or container; the rest is for other processes and the file cache.
_DEFAULT_FRACTION = 0.8
_CGROUP_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
# Parameters of glibc's mallopt, and thresholds: arrays of this size, and free memory beyond this, are always returned.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_RETURNED_ARRAY, _RETURNED_REST = 2**30, 2**31 - 1


def default_memory_limit(device: str = "cpu") -> int | None:
    """Return four fifths of the memory of the machine or container, in bytes.

    None if unknown, and for a GPU, whose free memory may all be used.
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
    return int(_DEFAULT_FRACTION * total)


def resident_bytes(pid: int) -> int:
    """Return the resident memory of a process in bytes; 0 if it has ended or the system does not report it."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return _resident_by_ps(pid)


def _resident_by_ps(pid: int) -> int:
    """Read resident memory from `ps`, on systems without /proc."""
    try:
        text = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=False).stdout
    except OSError:
        return 0
    return int(text) * 1024 if text.strip().isdigit() else 0


def keep_freed_memory() -> bool:
    """Keep the memory of freed arrays for later ones, in one heap for all threads, instead of returning it.

    A training step allocates what the last one freed. Otherwise the system would clear each page again, for up to 14 ms
    of CPU time in a step of 62 ms on two threads. Call it before libraries start threads: existing heaps remain.

    Returns:
        False if the C library is not glibc; then nothing changes.
    """
    mallopt = _glibc_function("mallopt")
    if mallopt is None:
        return False
    mallopt(_ARENA_MAX, 1)
    mallopt(_MMAP_THRESHOLD, _RETURNED_ARRAY)
    mallopt(_TRIM_THRESHOLD, _RETURNED_REST)
    return True


def return_freed_memory() -> None:
    """Return the memory that `keep_freed_memory` has kept to the system, after work that needed a lot of it."""
    if (trim := _glibc_function("malloc_trim")) is not None:
        trim(0)


def _glibc_function(name: str) -> Callable[..., int] | None:
    """Find a function of the C library; None on Windows, and if the library lacks it."""
    try:
        return getattr(ctypes.CDLL(None), name, None)
    except TypeError:  # Windows does not accept None
        return None
