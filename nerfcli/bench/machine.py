"""The machine that measurements run on, its load, and the peak memory of a piece of work."""

import os
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

_CPU_INFO = Path("/proc/cpuinfo")
_STATUS, _CLEAR_REFS = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def describe_machine(device: str, threads: int) -> dict[str, Any]:
    """Describe the machine: everything that a time depends on besides the settings."""
    return {
        "processor": processor_name(),
        "processors": os.cpu_count(),
        "device": "cpu" if device == "cpu" else torch.cuda.get_device_name(device),
        "threads": threads,
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def processor_name() -> str:
    """Return the CPU's model."""
    if _CPU_INFO.exists():
        for line in _CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return " ".join(line.split(":", 1)[1].split())
    return platform.processor() or platform.machine()


def load_average() -> float | None:
    """Return the mean number of runnable processes over the last minute, ours included; None if not reported."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def is_busy(load: float | None) -> bool:
    """Return whether a load average from before the start shows that other programs use the processors."""
    # Measured times suffer if other programs use more than a quarter of the processors.
    return load is not None and load > 0.25 * (os.cpu_count() or 1)


@dataclass(frozen=True)
class PeakMemory:
    """Peak memory since `begin`, of this process or, if the device is a GPU, of the GPU."""

    device: str

    def begin(self) -> None:
        """Reset the peak."""
        if self.device != "cpu":
            torch.cuda.reset_peak_memory_stats(self.device)
        elif _CLEAR_REFS.exists():
            _CLEAR_REFS.write_text("5")  # resets the peak of the resident size: Linux, proc(5)

    def read(self) -> int | None:
        """Return the peak in bytes; None if the system does not report it."""
        if self.device != "cpu":
            return torch.cuda.max_memory_allocated(self.device)
        if not (_CLEAR_REFS.exists() and _STATUS.exists()):
            return None
        for line in _STATUS.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
        return None
