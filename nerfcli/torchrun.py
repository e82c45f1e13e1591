"""Read torchrun's environment: whether this process is one of several, and which."""

import os


def is_one_of_several() -> bool:
    """Return whether torchrun has started this process as one of several."""
    return "TORCHELASTIC_RUN_ID" in os.environ and int(os.environ["WORLD_SIZE"]) > 1


def is_first() -> bool:
    """Return whether this process writes and reports: the only one, or rank 0."""
    return not is_one_of_several() or int(os.environ["RANK"]) == 0


def place_on_machine() -> tuple[int, int]:
    """Return the number of this process among those of its machine, and how many these are."""
    return (int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])) if is_one_of_several() else (0, 1)
