"""Rows of the selftest, and the definition of errors."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels import reference

MET, NOT_MET = "met", "not met"


@dataclass(frozen=True)
class Precision:
    """An arithmetic that an operation is tried in: plain torch on the device, or the compiled kernels of CPU or GPU."""

    name: str
    dtype: torch.dtype
    device: str
    compiled: bool = False
    for_gpu: bool = False

    @property
    def parts(self) -> ModuleType:
        """The single operations in this arithmetic."""
        if self.for_gpu:
            from nerfcli.kernels.triton_cuda import operations

            return operations
        if self.compiled:
            from nerfcli.kernels import numba_cpu  # which may not work here

            return numba_cpu
        return reference

    @property
    def unit(self) -> float:
        """The largest relative error of one rounding."""
        return torch.finfo(self.dtype).eps / 2

    @property
    def tiny(self) -> float:
        """The smallest number with all its digits; below, errors are absolute."""
        return float(torch.finfo(self.dtype).tiny)

    @property
    def deepest(self) -> float:
        """Optical depth beyond which this precision cannot represent the remaining light."""
        return -math.log(self.tiny)

    def tensor(self, values: Any) -> Tensor:
        """Numbers in this precision on its device."""
        return torch.tensor(values, dtype=torch.float64).to(self.device, self.dtype)


@dataclass(frozen=True)
class Errors:
    """The largest relative error of a value, and that of a gradient where there is one."""

    value: float
    gradient: float | None = None


@dataclass(frozen=True)
class Row:
    """One hard case in one precision.

    Args:
        case: what is hard.
        operation: which operation it is tried on.
        precision: name of the arithmetic.
        errors: of the program.
        bounds: what they may be.
        reason: where the bounds come from.
        formula: what textbooks do; "" where there is none.
        textbook: its errors on the same numbers; None also for the compiled kernels, whose float32 has its own row.
        seconds: one run of the operation, forward and backward.
        no_gradient: why an operation that others take the gradient of has none here.
    """

    case: str
    operation: str
    precision: str
    errors: Errors
    bounds: Errors
    reason: str
    formula: str = ""
    textbook: Errors | None = None
    seconds: float | None = None
    no_gradient: str = ""

    @property
    def verdict(self) -> str:
        """Verdict on the bounds; NaN exceeds all."""
        return MET if self.holds(self.errors) else NOT_MET

    def holds(self, errors: Errors) -> bool:
        """Return whether errors are within the bounds of this row."""
        pairs = ((errors.value, self.bounds.value), (errors.gradient, self.bounds.gradient))
        return all(error <= bound for error, bound in pairs if error is not None and bound is not None)

    @property
    def textbook_fails(self) -> bool:
        """Whether the textbook formula exceeds the bounds of this row."""
        return self.textbook is not None and not self.holds(self.textbook)

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers; non-finite ones by name, since JSON has none."""

        def plain(value: Any) -> Any:
            if isinstance(value, dict):
                return {name: plain(inner) for name, inner in value.items()}
            return str(value) if isinstance(value, float) and not math.isfinite(value) else value

        return {**plain(asdict(self)), "verdict": self.verdict}


def by_formula(rows: Sequence[Row]) -> list[Row]:
    """Return one row for each textbook formula:
    where it is farthest beyond the bounds, in float32 if it has such rows.
    """
    formulas: dict[str, list[Row]] = {}
    for row in rows:
        if row.textbook is not None:
            formulas.setdefault(row.formula, []).append(row)
    single = ([row for row in own if row.precision == "float32"] or own for own in formulas.values())
    return [max(own, key=_beyond) for own in single]


def _beyond(row: Row) -> float:
    """Return how many times its bounds the textbook's errors are."""
    assert row.textbook is not None
    pairs = ((row.textbook.value, row.bounds.value), (row.textbook.gradient, row.bounds.gradient))
    bounded = [(error, bound) for error, bound in pairs if error is not None and bound is not None]
    return max(error / bound if bound else math.inf * error if error else 0.0 for error, bound in bounded)


def largest_error(values: Any, wanted: Any, *, tiny: float, scale: Any = None) -> float:
    """Return the largest |value - wanted| / max(|wanted|, tiny).

    Args:
        values: tensor, array or numbers, as all that follow.
        wanted: the answers; NaN where undefined.
        tiny: below, errors are relative to it.
        scale: what errors are relative to, in place of |wanted|.

    Returns:
        0 for nothing at all; infinite where only one of the two is a number.
    """
    got = _plain(values)
    want = _plain(wanted).reshape(got.shape)
    if got.size == 0:
        return 0.0
    size = np.abs(want if scale is None else _plain(scale).reshape(got.shape))
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(got - want) / np.maximum(size, tiny)
    error = np.where(np.isnan(got) & np.isnan(want), 0.0, np.where(got == want, 0.0, error))
    return float(np.where(np.isnan(error), np.inf, error).max())


def _plain(values: Any) -> np.ndarray:
    return values.detach().to("cpu", torch.float64).numpy() if isinstance(values, Tensor) else np.asarray(values, float)
