"""Adam for a field: on the weights, which every sample uses, and on the rows that a step has touched."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor
from torch.optim.adam import adam as adam_step

from nerfcli.field.interface import Field
from nerfcli.kernels import AdamStep

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
        adam_step(
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


class FieldOptimiser:
    """Adam's moments for a field's rows and weights.

    `table_grad` accumulates the gradient of the rows: it is allocated once, passed to `Backend.render_rays`, and zero
    again after each step. None for a field without rows.
    """

    def __init__(self, field: Field):
        self._field = field
        rows = field.rows()
        self._weights = {name: parameter for name, parameter in field.named_parameters() if parameter is not rows}
        self._adam = Adam(self._weights.values())
        self.table_grad = self._first = self._second = None
        if rows is not None:
            self.table_grad, self._first, self._second = (torch.zeros_like(rows, requires_grad=False) for _ in range(3))

    def zero_grad(self) -> None:
        """Clear the gradients of the weights; the step that used those of the rows has cleared them already."""
        self._adam.zero_grad()

    def weights(self) -> list[Tensor]:
        """Return all parameters but the rows."""
        return list(self._weights.values())

    def gradients(self) -> dict[str, Tensor]:
        """Return by name the gradients that any non-finite number reaches: those of the weights, or of rows alone."""
        if not self._weights and self.table_grad is not None:
            return {"rows": self.table_grad}
        return {name: weight.grad for name, weight in self._weights.items() if weight.grad is not None}

    def step(self, number: int, rate: float, *, decay: float) -> None:
        """Take step `number`, counted from 1, at a learning rate and with a weight decay of rows."""
        rate = rate * self._field.rate_factor
        self._adam.step(rate)
        rows = self._field.rows()
        if rows is not None and self.table_grad is not None and self._first is not None and self._second is not None:
            step = AdamStep(number, rate, BETAS, EPS, decay)
            self._field.backend.adam_rows(rows, self.table_grad, self._first, self._second, step=step)

    def state(self) -> dict[str, Tensor]:
        """Return the state for `restore`, without the field's own tensors."""
        tensors: dict[str, Tensor] = {}
        if self._first is not None and self._second is not None:
            tensors |= {"table_first": self._first, "table_second": self._second}
        return tensors | self._adam.state("adam")

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `state`; other tensors are ignored."""
        if self._first is not None:
            self._first, self._second = tensors["table_first"], tensors["table_second"]
        if self.table_grad is not None:
            self.table_grad.zero_()  # a step may have failed before using it
        self._adam.restore(tensors, "adam")


class PartsOptimiser:
    """Adam for groups of parameters learned besides the field, each with a multiple of the field's learning rate."""

    def __init__(self, groups: Sequence[tuple[Sequence[Tensor], float]]):
        self._groups = [(Adam(parameters), multiple) for parameters, multiple in groups]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for adam, _ in self._groups:
            adam.zero_grad()

    def step(self, rate: float) -> None:
        """Take one step at multiples of a learning rate."""
        for adam, multiple in self._groups:
            adam.step(rate * multiple)

    def state(self) -> dict[str, Tensor]:
        """Return the state for `restore`, without the parts' own tensors."""
        tensors: dict[str, Tensor] = {}
        for number, (adam, _) in enumerate(self._groups):
            tensors |= adam.state(f"parts_adam.{number}")
        return tensors

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `state`; other tensors are ignored."""
        for number, (adam, _) in enumerate(self._groups):
            adam.restore(tensors, f"parts_adam.{number}")
