"""The hot operations of the program behind one interface: `reference` defines them, faster backends agree with it.

A backend is chosen once, for a training or a model, by the device and the precision of its field.
"""

import functools
import warnings
from collections.abc import Callable
from types import ModuleType

import torch

from nerfcli.errors import UserError
from nerfcli.kernels.contraction import CONTRACTIONS, contract, contract_to_cube, grid_coordinates
from nerfcli.kernels.harmonics import spherical_harmonics
from nerfcli.kernels.interface import (
    Backend,
    HashGrid,
    Intervals,
    LightEnds,
    March,
    Medium,
    PixelTable,
    Rays,
    RaysSeen,
    RaySums,
    Targets,
)
from nerfcli.kernels.reference import ray_indices, sum_along_rays
from nerfcli.kernels.reference.backend import ReferenceBackend

__all__ = [
    "CONTRACTIONS",
    "Backend",
    "HashGrid",
    "Intervals",
    "LightEnds",
    "March",
    "Medium",
    "PixelTable",
    "RaySums",
    "Rays",
    "RaysSeen",
    "Targets",
    "backend_for",
    "contract",
    "contract_to_cube",
    "grid_coordinates",
    "has_compiled",
    "prepare",
    "ray_indices",
    "spherical_harmonics",
    "sum_along_rays",
]

BACKENDS = ("auto", "reference", "numba_cpu")


def backend_for(device: torch.device, dtype: torch.dtype, *, wanted: str = "auto") -> Backend:
    """Choose who computes for a field.

    Args:
        device, dtype: of its numbers.
        wanted: one of `BACKENDS`; auto takes the fastest that fits, with one warning where it should work here and does
            not.

    Raises:
        ValueError: there is no backend of this name.
        UserError: the one that is wanted by name does not work here, or not on such numbers.
    """
    if wanted not in BACKENDS:
        raise ValueError(f"backend must be one of {BACKENDS}, got {wanted!r}")
    if wanted == "auto" and (device.type != "cpu" or dtype != torch.float32):
        return ReferenceBackend(device)
    compiled = _numba_backend() if wanted != "reference" else None
    if wanted == "numba_cpu":
        refusal = "Numba does not work on this machine" if compiled is None else compiled.refuses(device, dtype)
        if refusal is not None:
            raise UserError(f"the backend numba_cpu cannot be used: {refusal}", "use auto or reference")
    return compiled or ReferenceBackend(device)


def has_compiled() -> bool:
    """Return whether the compiled CPU kernels work on this machine."""
    return _numba_cpu() is not None


def prepare(notify: Callable[[str], None]) -> None:
    """Compile what has to be compiled for this machine, so that no clock runs meanwhile; once per machine."""
    numba_cpu = _numba_cpu()
    if numba_cpu is not None:
        if not numba_cpu.is_compiled():
            notify("compiling the CPU kernels (once per machine, about a minute)")
        numba_cpu.warm_up()


def _numba_backend() -> Backend | None:
    if _numba_cpu() is None:
        return None
    from nerfcli.kernels.numba_cpu.backend import NumbaBackend

    return NumbaBackend()


@functools.cache
def _numba_cpu() -> ModuleType | None:
    """The CPU kernels, or None with one warning where Numba does not work."""
    try:
        from nerfcli.kernels import numba_cpu
    except ImportError as error:
        warnings.warn(
            f"Numba does not work on this machine ({error}); using plain torch instead, which is much slower",
            stacklevel=3,
        )
        return None
    return numba_cpu
