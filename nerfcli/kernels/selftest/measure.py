"""Rows of the selftest, and the definition of errors and precisions."""

import math
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
    """An arithmetic for an operation: plain torch on the device, or the compiled kernels of the CPU or the GPU."""

    name: str
    dtype: torch.dtype
    device: str
    compiled: bool = False
    for_gpu: bool = False

    @property
    def parts(self) -> ModuleType:
        """Module of the single operations in this arithmetic."""
        if self.for_gpu:
            from nerfcli.kernels.triton_cuda import operations

            return operations
        if self.compiled:
            from nerfcli.kernels import numba_cpu  # which may not work here

            return numba_cpu
        return reference

    @property
    def unit(self) -> float:
        """Largest relative error of one rounding."""
        return torch.finfo(self.dtype).eps / 2

    @property
    def tiny(self) -> float:
        """Smallest normal number; below it, errors are absolute."""
        return float(torch.finfo(self.dtype).tiny)

    @property
    def deepest(self) -> float:
        """Optical depth beyond which this precision cannot represent the remaining light."""
        return -math.log(self.tiny)

    def tensor(self, values: Any) -> Tensor:
        """Return values in this precision, on its device."""
        return torch.tensor(values, dtype=torch.float64).to(self.device, self.dtype)


@dataclass(frozen=True)
class Errors:
    """Largest relative error of the values, and of the gradients if there are any."""

    value: float
    gradient: float | None = None


@dataclass(frozen=True)
class Row:
    """One hard case in one precision.

    Args:
        precision: name of the arithmetic.
        errors: errors of nerfcli.
        bounds: largest permitted errors.
        reason: derivation of the bounds.
        seconds: time of one run of the operation, forward and backward.
    """

    case: str
    operation: str
    precision: str
    errors: Errors
    bounds: Errors
    reason: str
    seconds: float

    @property
    def verdict(self) -> str:
        """Verdict on the errors against the bounds; NaN exceeds any bound."""
        return MET if self.holds(self.errors) else NOT_MET

    def holds(self, errors: Errors) -> bool:
        """Return True if the errors are within the bounds of this row."""
        pairs = ((errors.value, self.bounds.value), (errors.gradient, self.bounds.gradient))
        return all(error <= bound for error, bound in pairs if error is not None and bound is not None)

    def to_json(self) -> dict[str, Any]:
        """Return plain values; non-finite numbers as strings, since JSON cannot hold them."""

        def plain(value: Any) -> Any:
            if isinstance(value, dict):
                return {name: plain(inner) for name, inner in value.items()}
            return str(value) if isinstance(value, float) and not math.isfinite(value) else value

        return {**plain(asdict(self)), "verdict": self.verdict}


def largest_error(values: Any, wanted: Any, *, tiny: float, scale: Any = None) -> float:
    """Return the largest |value - wanted| / max(|wanted|, tiny).

    Args:
        wanted: the answers; NaN where undefined.
        tiny: errors of smaller answers are relative to this.
        scale: magnitudes that errors are relative to, instead of |wanted|.

    Returns:
        The error: 0 for empty values, infinite if only one of a value and its answer is NaN.
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
