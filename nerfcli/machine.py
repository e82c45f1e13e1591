"""Choose the number of CPU threads and the torch device, alone or as one of the processes that torchrun has started."""

import os
import re

from nerfcli.errors import UserError


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

    The processors are divided among the processes that torchrun has started on this machine.
    """
    if threads:
        return threads
    # Not every system has sched_getaffinity.
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, processors // local_rank_and_size()[1])


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
        raise UserError(f"--device {device}: there is no such device", f"the last one is cuda:{last}")
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
