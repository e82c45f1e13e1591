"""The processes that train one field together, called ranks and numbered from 0, and the sums over all of them.

All ranks draw the same pixels from the same random numbers. Each renders every `count`-th pixel, starting from its own
rank, and the results are added up over the ranks: losses, gradients, sample counts, normal equations. Equal states
therefore stay equal, and match those of one process that renders all pixels, except for the order of float32 sums.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from nerfcli.errors import LOST_RANK, UserError


class SingleProcess:
    """A single process: sums are its own values, and nothing is sent."""

    rank, count = 0, 1

    @property
    def own(self) -> slice:
        """The rows that belong to this rank, of those that all ranks draw."""
        return slice(self.rank, None, self.count)

    def add_up(self, *tensors: Tensor) -> None:
        """Replace tensors of one type by their sums over all ranks, identical to the bit on each."""

    def add_up_gradients(self, learned: Sequence[Tensor], *, rays: Sequence[Tensor], sink: Tensor | None) -> None:
        """Add up gradients of parameters and of rows in a sink; rays keep their own, or get 0 if they have none."""

    def keep_largest(self, tensor: Tensor) -> None:
        """Replace each element of a tensor by its maximum over all ranks."""

    def total(self, number: int) -> int:
        """Return the sum of a number over all ranks."""
        return number

    def gathered(self, value: Any) -> list[Any]:
        """Return the values of all ranks, in order of rank."""
        return [value]

    def from_first(self, value: Any) -> Any:
        """Return the value of rank 0."""
        return value

    def announce(self, fraction: float) -> float:
        """Return the `fraction` of rank 0, which says what comes next; see `train.following`."""
        return fraction

    def copy_from_first(self, *tensors: Tensor) -> None:
        """Overwrite tensors with those of rank 0."""


ALONE = SingleProcess()


class Ranks(SingleProcess):
    """Several processes, of which this is one.

    Args:
        rank, count: the number of this process, and the number of processes.
        preparation: the group with a long timeout, for preparation; the default group is for steps.
    """

    def __init__(self, rank: int, count: int, preparation: dist.ProcessGroup):
        self.rank, self.count = rank, count
        self._preparation = preparation

    def leave(self) -> None:
        """Disconnect from the other processes before this one exits: threads that still listen would abort it."""
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
            if tensor.requires_grad and tensor.grad is None:  # no ray of this rank has any sample
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
        announced = torch.tensor(fraction, dtype=torch.float64)
        with lost_ranks_reported():
            dist.broadcast(announced, src=0)
        return float(announced)

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
