"""The processors and the device to work with."""

import os

from nerfcli.errors import UserError


def thread_count(threads: int) -> int:
    """Return the number of CPU threads to use: as given, or for 0 the processors this process may run on."""
    if threads:
        return threads
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def device_name(device: str) -> str:
    """Return the torch device for "auto", "cpu" or "cuda".

    Raises:
        UserError: CUDA is wanted and not there, or the name is unknown.
    """
    import torch

    if device not in ("auto", "cpu", "cuda"):
        raise UserError(f"unknown device {device!r}", "use --device auto, cpu or cuda", exit_code=2)
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: torch finds no CUDA device", "use --device cpu, or install torch with CUDA")
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return device
