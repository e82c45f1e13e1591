"""The processes that train one field together, called ranks, from 0 on: what they add up in each step.

All ranks draw the same pixels from the same random numbers. Each renders every `count`-th of them, from its own number
on, and what comes of that is added up over the ranks: losses, gradients, numbers of samples, normal equations. So
equal states stay equal, and are those of one process that renders all pixels, but for the order in which float32 sums
are added up.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from nerfcli.errors import LOST_RANK, UserError


class Alone:
    """One process, alone: sums are its own, and nothing is sent."""

    rank, count = 0, 1

    @property
    def own(self) -> slice:
        """Return which rows of what all ranks draw are those of this one."""
        return slice(self.rank, None, self.count)

    def add_up(self, *tensors: Tensor) -> None:
        """Replace tensors of one type by their sums over all ranks, which are the same bits on each."""

    def add_up_gradients(self, learned: Sequence[Tensor], *, rays: Sequence[Tensor], sink: Tensor | None) -> None:
        """Add up the gradients of parameters, and of rows in a sink; rays only get one, 0 where they have no sample."""

    def keep_largest(self, tensor: Tensor) -> None:
        """Replace each number of a tensor by the largest over all ranks."""

    def total(self, number: int) -> int:
        """Return the sum of a number over all ranks."""
        return number

    def joined(self, rows: Tensor, count: int) -> Tensor:
        """Return all `count` rows, of which each rank has its `own`."""
        return rows

    def gathered(self, value: Any) -> list[Any]:
        """Return the values of all ranks, in their order."""
        return [value]

    def from_first(self, value: Any) -> Any:
        """Return the value of rank 0."""
        return value

    def announce(self, fraction: float) -> float:
        """Return what rank 0 says comes next."""
        return fraction

    def copy_from_first(self, *tensors: Tensor) -> None:
        """Overwrite tensors with those of rank 0."""


ALONE = Alone()


class Ranks(Alone):
    """Several processes, of which this is one.

    Args:
        rank, count: its number, and how many there are.
        preparation: the group in which they may wait for long; the default group is for steps.
    """

    def __init__(self, rank: int, count: int, preparation: dist.ProcessGroup):
        self.rank, self.count = rank, count
        self._preparation = preparation

    def leave(self) -> None:
        """Part from the other processes, at the end of this one: threads that still listen to them would abort it."""
        del self._preparation
        if dist.is_initialized():
            dist.destroy_process_group()

    def add_up(self, *tensors: Tensor) -> None:
        with lost_ranks_reported():
            if len(tensors) == 1:
                dist.all_reduce(tensors[0])
                return
            joined = torch.cat([tensor.reshape(-1) for tensor in tensors])
            dist.all_reduce(joined)
        for tensor, part in zip(tensors, joined.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def add_up_gradients(self, learned: Sequence[Tensor], *, rays: Sequence[Tensor], sink: Tensor | None) -> None:
        for tensor in (*learned, *rays):
            if tensor.requires_grad and tensor.grad is None:  # no ray of this rank has a sample
                tensor.grad = torch.zeros_like(tensor)
        self.add_up(*(tensor.grad for tensor in learned if tensor.grad is not None))
        if sink is not None:
            self.add_up(sink)

    def keep_largest(self, tensor: Tensor) -> None:
        with lost_ranks_reported():
            dist.all_reduce(tensor, op=dist.ReduceOp.MAX)

    def total(self, number: int) -> int:
        summed = torch.tensor(number)
        self.add_up(summed)
        return int(summed)

    def joined(self, rows: Tensor, count: int) -> Tensor:
        every = rows.new_zeros(count, *rows.shape[1:])
        every[self.own] = rows
        self.add_up(every)
        return every

    def gathered(self, value: Any) -> list[Any]:
        values: list[Any] = [None] * self.count
        with lost_ranks_reported():
            dist.all_gather_object(values, value, group=self._preparation)
        return values

    def from_first(self, value: Any) -> Any:
        values = [value]
        with lost_ranks_reported():
            dist.broadcast_object_list(values, src=0, device=torch.device("cpu"), group=self._preparation)
        return values[0]

    def announce(self, fraction: float) -> float:
        said = torch.tensor(fraction, dtype=torch.float64)
        with lost_ranks_reported():
            dist.broadcast(said, src=0)
        return float(said)

    def copy_from_first(self, *tensors: Tensor) -> None:
        with lost_ranks_reported():
            for tensor in tensors:
                dist.broadcast(tensor, src=0)


@contextmanager
def lost_ranks_reported() -> Iterator[None]:
    """Report a process that has ended, or does not answer, as a `UserError` with exit code `LOST_RANK`."""
    try:
        yield
    except RuntimeError as error:
        raise UserError(
            "another process of this training has ended, or its machine does not answer",
            "see what it reported; if the run has a checkpoint, continue with the same command and --resume",
            LOST_RANK,
        ) from error
