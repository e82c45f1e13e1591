"""Join the processes that torchrun has started for one training."""

import atexit
import functools
from datetime import timedelta

import torch
import torch.distributed as dist

from nerfcli.fit.ranks import ALONE, Ranks, SingleProcess, lost_ranks_reported
from nerfcli.torchrun import is_one_of_several

# Timeouts: long while photos are loaded and components selected, short for joining and for steps. A process that ends
# is noticed at once by its closed connections; only a machine that goes silent takes this long.
PREPARATION, STEP = timedelta(hours=12), timedelta(minutes=5)


@functools.cache  # they meet once, and stay together as long as they live
def joined_ranks(device: str) -> SingleProcess:
    """Join the processes that torchrun has started; return `ALONE` if it has started one, or none.

    Args:
        device: of this process.

    Raises:
        UserError: another process has ended already.
    """
    if not is_one_of_several():
        return ALONE
    if device != "cpu":
        torch.cuda.set_device(device)
    with lost_ranks_reported():
        dist.init_process_group("gloo" if device == "cpu" else "cpu:gloo,cuda:nccl", timeout=STEP)
        preparation = dist.new_group(timeout=PREPARATION)
    assert isinstance(preparation, dist.ProcessGroup)  # this process is in it
    ranks = Ranks(dist.get_rank(), dist.get_world_size(), preparation)
    atexit.register(ranks.leave)
    return ranks
