"""Read torchrun's environment: the rank of this process, and if it is one of several."""

import os


def is_one_of_several() -> bool:
    """Return True if torchrun started this process as one of several."""
    return "TORCHELASTIC_RUN_ID" in os.environ and int(os.environ["WORLD_SIZE"]) > 1


def is_first() -> bool:
    """Return True if this process writes and reports: it is the only one, or rank 0."""
    return not is_one_of_several() or int(os.environ["RANK"]) == 0


def local_rank_and_size() -> tuple[int, int]:
    """Return the rank of this process on its machine, and the number of processes on that machine."""
    return (int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])) if is_one_of_several() else (0, 1)
