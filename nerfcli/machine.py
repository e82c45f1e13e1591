"""Threads, devices, memory and processes of this machine; everything that depends on the operating system is here."""

import ctypes
import math
import os
import platform
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from nerfcli.errors import UserError

# Fraction of the memory of the machine or container; the rest is for other processes and the file cache.
_DEFAULT_FRACTION = 0.8
# The control groups of this process (Linux), and where they are.
_OWN_GROUPS, _GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
# Parameters of glibc's mallopt, and thresholds: arrays of this size, and free memory beyond this, are always returned.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_RETURNED_ARRAY, _RETURNED_REST = 2**30, 2**31 - 1
_CPU_INFO = Path("/proc/cpuinfo")
_STATUS, _CLEAR_REFS = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Resources:
    """What a workflow may use of this machine.

    Args:
        threads: number of CPU threads; 0 for all.
        device: "auto", "cpu", "cuda" or "cuda:1".
        memory_bytes: limit of resident memory, or of memory on the GPU that trains; None for four fifths of the
            machine's, or for all that is free on the GPU.
    """

    threads: int = 0
    device: str = "auto"
    memory_bytes: int | None = None

    @property
    def cores(self) -> int:
        """Number of CPU threads, at least 1."""
        return thread_count(self.threads)

    @property
    def torch_device(self) -> str:
        """Name of the torch device; see `device_name`."""
        return device_name(self.device)

    def memory_limit(self, device: str = "cpu") -> int | None:
        """Return the limit of this process in bytes; None where there is none.

        Processes that torchrun has started on this machine share its memory; each has a GPU of its own.
        """
        limit = self.memory_bytes or default_memory_limit(device)
        return limit if limit is None or device != "cpu" else limit // local_rank_and_size()[1]

    def begin(self) -> int:
        """Have torch use the threads, from the calling thread, and return their number."""
        use_threads(self.cores)
        return self.cores


def use_threads(count: int) -> None:
    """Have torch use this many threads for what the calling thread computes."""
    import torch

    torch.set_num_threads(count)


def is_one_of_several() -> bool:
    """Return True if torchrun started this process as one of several."""
    return "TORCHELASTIC_RUN_ID" in os.environ and int(os.environ["WORLD_SIZE"]) > 1


def is_first() -> bool:
    """Return True if this process writes and reports: it is the only one, or the first."""
    return not is_one_of_several() or int(os.environ["RANK"]) == 0


def local_rank_and_size() -> tuple[int, int]:
    """Return the number of this process on its machine, from 0, and how many are there."""
    return (int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])) if is_one_of_several() else (0, 1)


def thread_count(threads: int) -> int:
    """Return the number of CPU threads to use: as given or, for 0, the number of processors this process may run on.

    A limit on processor time counts as fewer processors. They are divided among the processes that torchrun has started
    on this machine.
    """
    if threads:
        return threads
    # Not every system has sched_getaffinity.
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    version_1 = (_limits_of_groups(f"cpu.cfs_{part}_us", "cpu") for part in ("quota", "period"))
    for text in (*_limits_of_groups("cpu.max"), *map(" ".join, zip(*version_1, strict=True))):
        quota, _, period = text.partition(" ")
        if quota.isdecimal():
            processors = min(processors, math.ceil(int(quota) / int(period)))
    return max(1, processors // local_rank_and_size()[1])


def _limits_of_groups(name: str, controller: str = "") -> Iterator[str]:
    """Yield a limit of this process's control group and of those around it, as containers, Slurm and systemd set them.

    Args:
        name: of the file of the limit.
        controller: of version 1; in version 2 there is one hierarchy for all.
    """
    lines = _OWN_GROUPS.read_text().splitlines() if _OWN_GROUPS.exists() else []
    for _, controllers, group in (line.split(":", 2) for line in lines):
        if controller in controllers.split(","):
            place = _GROUPS / controller / group.lstrip("/")
            for folder in (place, *place.parents):
                if folder.is_relative_to(_GROUPS / controller):
                    with suppress(OSError):  # it sets no limit
                        yield (folder / name).read_text().strip()


def device_name(device: str) -> str:
    """Return the torch device for "auto", "cpu", "cuda" or "cuda:1"; with torchrun, each process gets its own GPU.

    Raises:
        UserError: the name is unknown, the CUDA device does not exist, or torchrun started more processes than GPUs.
    """
    import torch

    named = re.fullmatch(r"auto|cpu|cuda(?::(\d+))?", device)
    if named is None:
        raise UserError(f"unknown device {device!r}", "use --device auto, cpu, cuda or cuda:1", exit_code=2)
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(
            f"--device {device}: torch finds no CUDA device", "use --device cpu, or install torch with CUDA"
        )
    if named[1] is not None and int(named[1]) >= torch.cuda.device_count():
        last = torch.cuda.device_count() - 1
        raise UserError(
            f"--device {device}: there is no such device", f"use --device cuda:0{f' to cuda:{last}' if last else ''}"
        )
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    number, count = local_rank_and_size()
    if device != "cuda" or count == 1:
        return device
    if count > torch.cuda.device_count():
        raise UserError(
            f"torchrun starts {count} processes on this machine, which has {torch.cuda.device_count()} GPUs",
            f"use --nproc-per-node {torch.cuda.device_count()}",
        )
    return f"cuda:{number}"


def processor_name() -> str:
    """Return the CPU's model."""
    if _CPU_INFO.exists():
        for line in _CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return " ".join(line.split(":", 1)[1].split())
    return platform.processor() or platform.machine()


def is_running(process: int) -> bool:
    """Return whether a process with this number runs on this machine."""
    import psutil

    return psutil.pid_exists(process)


# Only resident memory counts. A limit on the address space (RLIMIT_AS) would be simpler, but it includes memory that is
# merely reserved: libraries, thread stacks and heaps, gigabytes that are never used.


def default_memory_limit(device: str = "cpu") -> int | None:
    """Return four fifths of the memory of the machine or, where it has a limit, of the container or job, in bytes.

    None for a GPU, whose free memory may all be used.
    """
    import psutil

    if device != "cpu":
        return None
    total = psutil.virtual_memory().total
    for text in (*_limits_of_groups("memory.max"), *_limits_of_groups("memory.limit_in_bytes", "memory")):
        if text.isdecimal():  # otherwise "max"
            total = min(total, int(text))
    return int(_DEFAULT_FRACTION * total)


def resident_bytes(process: int | None = None) -> int:
    """Return the resident memory of a process, by default of this one, in bytes; 0 if it has ended."""
    import psutil

    try:
        return psutil.Process(process).memory_info().rss
    except psutil.Error:
        return 0


def peak_resident_bytes() -> int:
    """Return the largest resident memory of this process since it or `begin_recent_peak` began, in bytes."""
    if (recent := recent_peak_bytes()) is not None:
        return recent
    if sys.platform == "win32":
        import psutil

        return psutil.Process().memory_info().peak_wset
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # on Linux, at least that of the process that started it
    return peak if sys.platform == "darwin" else peak * 1024  # kilobytes everywhere else


def begin_recent_peak() -> None:
    """Have the peaks of resident memory count from now on, where the system allows it: on Linux."""
    if _CLEAR_REFS.exists():
        with suppress(OSError):  # some containers forbid it
            _CLEAR_REFS.write_text("5")  # resets the peak of the resident size: Linux, proc(5)


def recent_peak_bytes() -> int | None:
    """Return the largest resident memory since `begin_recent_peak`; None if the system does not report it."""
    if not (_CLEAR_REFS.exists() and _STATUS.exists()):
        return None
    for line in _STATUS.read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    return None


def keep_freed_memory() -> None:
    """Keep the memory of freed arrays for later ones, in one heap for all threads, instead of returning it.

    A training step allocates what the last one freed. Otherwise the system would clear each page again, for up to 14 ms
    of CPU time in a step of 62 ms on two threads. Call it before libraries start threads: existing heaps remain. If the
    C library is not glibc, nothing changes.
    """
    if (mallopt := _glibc_function("mallopt")) is not None:
        mallopt(_ARENA_MAX, 1)
        mallopt(_MMAP_THRESHOLD, _RETURNED_ARRAY)
        mallopt(_TRIM_THRESHOLD, _RETURNED_REST)


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
