"""Observers of the tensors of a training step: none, or one that records the first non-finite tensor."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class BadTensor:
    """A tensor that is not finite.

    Args:
        name: what it is: "density of samples", "gradient of weights.0".
        count, total: how many of its numbers are not finite, and how many it has.
        rays: numbers of the rays of the batch that the bad numbers belong to; empty where they belong to no ray.
    """

    name: str
    count: int
    total: int
    rays: tuple[int, ...]


class NonFiniteError(Exception):
    """A step met a number that is not finite. `Sentinel` handles it; the user never sees it."""


class Watch:
    """Observer that receives the tensors of a step in the order of computation; this one ignores them."""

    def state(self, give: Callable[[], tuple[dict[str, Tensor], Any]]) -> None:
        """Look at the state between two steps, which `give` collects."""

    def values(self, name: str, tensor: Tensor) -> None:
        """Look at a tensor."""

    def rows(self, name: str, tensor: Tensor, rays: Tensor) -> None:
        """Look at a tensor whose rows belong to rays (N,), and at the gradient that will come to it."""


UNWATCHED = Watch()


class FirstBad(Watch):
    """Looks at every number of every tensor, and remembers the first tensor that is not finite."""

    def __init__(self) -> None:
        self.found: BadTensor | None = None

    def state(self, give: Callable[[], tuple[dict[str, Tensor], Any]]) -> None:
        for name, tensor in that_must_be_finite(give()[0]).items():
            self.values(name.removeprefix("field."), tensor)

    def values(self, name: str, tensor: Tensor, rays: Tensor | None = None) -> None:
        """Look at a tensor; `rays` (N,) are the rays that its rows belong to."""
        if self.found is not None or is_finite(tensor):
            return
        bad = ~tensor.detach().isfinite()
        which: Tensor = torch.empty(0)
        if rays is not None:
            which = rays[bad.reshape(len(bad), -1).any(1)].unique()
        self.found = BadTensor(name, int(bad.sum()), bad.numel(), tuple(which.long().tolist()))

    def rows(self, name: str, tensor: Tensor, rays: Tensor) -> None:
        self.values(name, tensor, rays)
        if tensor.requires_grad:
            tensor.register_hook(lambda gradient: self.values(f"gradient of {name}", gradient, rays))


def that_must_be_finite(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors of a state that must be finite; cells that no step has evaluated yet have infinite density."""
    return {name: tensor for name, tensor in state.items() if name not in ("optical_depth", "fine_depth")}


def is_finite(tensor: Tensor) -> bool:
    """Return whether all values of a tensor are finite, without a temporary of its size."""
    if tensor.numel() == 0 or not tensor.is_floating_point():
        return True
    smallest, largest = tensor.detach().aminmax()
    return bool((smallest.isfinite() & largest.isfinite()).item())
