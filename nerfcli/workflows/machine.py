"""The processors and the device to work with."""

import os
import re

from nerfcli.errors import UserError


def thread_count(threads: int) -> int:
    """Return the number of CPU threads to use: as given, or for 0 the processors this process may run on."""
    if threads:
        return threads
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def device_name(device: str) -> str:
    """Return the torch device for "auto", "cpu", "cuda" or "cuda:1".

    Raises:
        UserError: CUDA or this number of its devices is wanted and not there, or the name is unknown.
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
        raise UserError(f"--device {device}: there is no such device", f"the last one is cuda:{last}")
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return device
