"""The processors and the device to work with."""

import os
import re

from nerfcli.errors import UserError
from nerfcli.torchrun import place_on_machine


def thread_count(threads: int) -> int:
    """Return the number of CPU threads to use: as given, or for 0 the processors this process may run on, which the
    processes that torchrun has started on this machine divide among them.
    """
    if threads:
        return threads
    # Not every system has the first.
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, processors // place_on_machine()[1])


def device_name(device: str) -> str:
    """Return the torch device for "auto", "cpu", "cuda" or "cuda:1"; with torchrun, each process has a GPU of its own.

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
        device = "cuda" if torch.cuda.is_available() else "cpu"
    number, count = place_on_machine()
    if device != "cuda" or count == 1:
        return device
    if count > torch.cuda.device_count():
        raise UserError(
            f"torchrun starts {count} processes on this machine, which has {torch.cuda.device_count()} GPUs",
            f"use --nproc-per-node {torch.cuda.device_count()}",
        )
    return f"cuda:{number}"
