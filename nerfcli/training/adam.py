"""Adam on a few tensors, with torch's function instead of its class, whose constructor loads a compiler for 1.5 s."""

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.optim.adam import adam

BETAS = (0.9, 0.99)
EPS = 1e-15
_MOMENTS = ("exp_avg", "exp_avg_sq")


class Adam:
    """Adam and its moments for some tensors.

    Args:
        parameters: the tensors; a step leaves those without a gradient unchanged.

    Source: Kingma and Ba 2015, arXiv:1412.6980, algorithm 1.
    """

    def __init__(self, parameters: Iterable[Tensor]):
        self._parameters = list(parameters)
        self._state = [
            {
                "step": torch.zeros((), device=_place_of_count(parameter)),
                "exp_avg": torch.zeros_like(parameter, requires_grad=False),
                "exp_avg_sq": torch.zeros_like(parameter, requires_grad=False),
            }
            for parameter in self._parameters
        ]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Take one step at a learning rate."""
        learned = [
            (parameter, parameter.grad, state)
            for parameter, state in zip(self._parameters, self._state, strict=True)
            if parameter.grad is not None
        ]
        if not learned:
            return
        first, second = ([state[name] for _, _, state in learned] for name in _MOMENTS)
        adam(
            [parameter for parameter, _, _ in learned],
            [gradient for _, gradient, _ in learned],
            first,
            second,
            [],
            [state["step"] for _, _, state in learned],
            amsgrad=False,
            beta1=BETAS[0],
            beta2=BETAS[1],
            lr=rate,
            weight_decay=0.0,
            eps=EPS,
            maximize=False,
            fused=True if learned[0][0].is_cuda else None,
        )

    def state(self, prefix: str) -> dict[str, Tensor]:
        """Return the state for `restore`, with names that begin with `prefix`."""
        return {f"{prefix}.{i}.{name}": value for i, entry in enumerate(self._state) for name, value in entry.items()}

    def restore(self, tensors: dict[str, Tensor], prefix: str) -> None:
        """Restore the state from `state`; ignore other tensors, and reset parameters that have no stored state."""
        for index, entry in enumerate(self._state):
            for name, value in entry.items():
                stored = tensors.get(f"{prefix}.{index}.{name}")
                entry[name] = torch.zeros_like(value) if stored is None else stored.to(value.device)


def _place_of_count(parameter: Tensor) -> torch.device:
    """Return where the number of steps is read: on a GPU by the one kernel that steps all parameters."""
    return parameter.device if parameter.is_cuda else torch.device("cpu")
