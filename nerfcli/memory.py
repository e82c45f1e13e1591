"""Memory of the machine and of processes.

What counts is what is resident. A limit on the address space (RLIMIT_AS) would be simpler, but it counts what is merely
reserved: the libraries, the stacks and heaps of threads, gigabytes that never become memory.
"""

import os
import subprocess
from pathlib import Path

# Of what the machine, or the container, has. The rest is for its other processes and for the cache of files.
_DEFAULT_SHARE = 0.8
_CGROUP_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


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
