"""The processes that torchrun has started to train one field together; in a single one, nothing here changes anything.

Each has the whole state of the training and draws the same pixels from the same random numbers, but renders only every
`count()`-th of them, beginning with the one of its rank. Before the optimiser steps, all add up what they have found:
losses, gradients, numbers of samples. Equal states therefore stay equal, and match those of one process except for the
order of float32 sums.
"""

import atexit
import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from nerfcli.errors import LOST_RANK, UserError

# Timeouts: long while photos are loaded and components selected, short for joining and for steps. A process that ends
# is noticed at once by its closed connections; only a machine that goes silent takes this long.
PREPARATION, STEP = timedelta(hours=12), timedelta(minutes=5)

Value = TypeVar("Value")
# The group with the long timeout; None in a single process, and while the first one computes something alone.
_group: dist.ProcessGroup | None = None


def join(device: str) -> None:
    """Meet the other processes, once, until this one ends.

    Args:
        device: of this process.

    Raises:
        UserError: another process has ended already.
    """
    global _group
    if _group is not None:
        return
    if device != "cpu":
        torch.cuda.set_device(device)
    with _lost_processes_reported():
        dist.init_process_group("gloo" if device == "cpu" else "cpu:gloo,cuda:nccl", timeout=STEP)
        group = dist.new_group(timeout=PREPARATION)
    assert isinstance(group, dist.ProcessGroup)  # this process is in it
    _group = group
    atexit.register(_leave)


def _leave() -> None:
    """Disconnect before this process exits: threads that still listen would abort it."""
    global _group
    _group = None
    dist.destroy_process_group()


def rank() -> int:
    """Return the number of this process, from 0; the first one decides, writes and reports."""
    return 0 if _group is None else dist.get_rank()


def count() -> int:
    """Return the number of processes."""
    return 1 if _group is None else dist.get_world_size()


def own(rows: Tensor, total: int) -> Tensor:
    """Return this process's share of `rows`, the last `len(rows)` of `total` rows."""
    if count() == 1:
        return rows
    return rows[(rank() - (total - len(rows))) % count() :: count()].contiguous()


def whole_row(own_row: int) -> int:
    """Return the number of a row in the whole, from that in what `own` has returned."""
    return rank() + count() * own_row


def add_up_step(
    losses: Mapping[str, Tensor],
    of_rays: Tensor,
    samples: int,
    *,
    rays: int,
    leaves: Iterable[Tensor],
    table_grad: Tensor | None,
) -> tuple[dict[str, Tensor], Tensor, int]:
    """Add up what all processes have found in a step; return the losses, the numbers of all rays and of samples.

    Args:
        losses: this process's contributions (), by name.
        of_rays: a number for each of its rays, see `own`.
        samples: number of its samples.
        rays: number of the rays of all processes.
        leaves: tensors whose gradients are added up in place; a process none of whose rays has a sample contributes 0.
        table_grad: a further gradient, added up in place.
    """
    if count() == 1:
        return dict(losses), of_rays, samples
    numbers = torch.stack([*losses.values(), torch.tensor(samples).to(of_rays)])
    every = of_rays.new_zeros(rays, *of_rays.shape[1:])
    every[rank() :: count()] = of_rays
    _add_up(numbers)
    _add_up(every)
    *added, total = numbers
    if total > 0:
        learning = [leaf for leaf in leaves if leaf.requires_grad]
        for leaf in learning:
            leaf.grad = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        _add_up(*(leaf.grad for leaf in learning if leaf.grad is not None))
        if table_grad is not None:
            _add_up(table_grad)
    return dict(zip(losses, added, strict=True)), every, int(total)


def _add_up(*tensors: Tensor) -> None:
    """Replace tensors of one type by their sums over all processes, identical to the bit in each."""
    if not tensors:
        return
    with _lost_processes_reported():
        if len(tensors) == 1:
            dist.all_reduce(tensors[0])
            return
        joined = torch.cat([tensor.reshape(-1) for tensor in tensors])
        dist.all_reduce(joined)
    for tensor, part in zip(tensors, joined.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(part.view_as(tensor))


def keep_largest(tensor: Tensor) -> None:
    """Replace each element of a tensor by its maximum over all processes."""
    if count() > 1:
        with _lost_processes_reported():
            dist.all_reduce(tensor, op=dist.ReduceOp.MAX)


def largest(number: float) -> float:
    """Return the maximum of a number over all processes."""
    found = torch.tensor(number, dtype=torch.float64)
    keep_largest(found)
    return float(found)


def gathered(value: Value) -> list[Value]:
    """Return the values of all processes, in order of rank."""
    values: list[Any] = [value] * count()
    if count() > 1:
        with _lost_processes_reported():
            dist.all_gather_object(values, value, group=_group)
    return values


def from_first(compute: Callable[[], Value]) -> Value:
    """Return what the first process computes, alone, while the others wait; tensors on its GPU come to their own."""
    global _group
    group = _group
    if group is None:
        return compute()
    packed = io.BytesIO()
    if rank() == 0:
        _group = None
        try:
            torch.save(compute(), packed)
        finally:
            _group = group
    sent = [packed.getvalue()]
    with _lost_processes_reported():
        dist.broadcast_object_list(sent, src=0, device=torch.device("cpu"), group=group)
    place = {"cuda:0": f"cuda:{torch.cuda.current_device()}"} if torch.cuda.is_initialized() else None
    return torch.load(io.BytesIO(sent[0]), map_location=place, weights_only=False)


def copy_from_first(*tensors: Tensor) -> None:
    """Overwrite tensors with those of the first process."""
    if count() > 1:
        with _lost_processes_reported():
            for tensor in tensors:
                dist.broadcast(tensor, src=0)


@contextmanager
def interrupted_together() -> Iterator[None]:
    """Let a KeyboardInterrupt that is raised inside in any process end all of them here."""
    came: KeyboardInterrupt | None = None
    try:
        yield
    except KeyboardInterrupt as error:
        came = error
    if largest(came is not None):
        raise came or KeyboardInterrupt


@contextmanager
def _lost_processes_reported() -> Iterator[None]:
    """Report a process that has ended, or does not answer, as a `UserError` with exit code `LOST_RANK`."""
    try:
        yield
    except RuntimeError as error:
        raise UserError(
            "another process of this training has ended, or its machine does not answer",
            "see what it reported; if the run has a checkpoint, continue with the same command and --resume",
            LOST_RANK,
        ) from error
