"""The hot operations of the program behind one interface: `reference` defines them, faster modules agree with it.

Contracts, shapes and sources stand with each operation in `reference`. A fast version is taken where its device, dtype
and sizes fit; everything else, float64 and CUDA tensors among it, goes through the reference.
"""

import functools
import warnings
from types import ModuleType

from torch import Tensor

from nerfcli.kernels import reference
from nerfcli.kernels.reference import (
    composite,
    contract,
    grid_coordinates,
    interval_weights,
    march,
    optical_depth_before,
    ray_indices,
    sum_along_rays,
)

__all__ = [
    "composite",
    "contract",
    "grid_coordinates",
    "hash_encode",
    "interval_weights",
    "march",
    "optical_depth_before",
    "ray_indices",
    "sum_along_rays",
]


def hash_encode(points: Tensor, table: Tensor, resolutions: tuple[int, ...]) -> Tensor:
    """See `reference.hash_encode`. Gradients with respect to points come from the reference alone."""
    numba_cpu = _numba_cpu()
    if numba_cpu is not None and numba_cpu.can_hash_encode(points, table, resolutions):
        return numba_cpu.hash_encode(points, table, resolutions)
    return reference.hash_encode(points, table, resolutions)


@functools.cache
def _numba_cpu() -> ModuleType | None:
    """The CPU kernels, or None with one warning where Numba does not work."""
    try:
        from nerfcli.kernels import numba_cpu
    except ImportError as error:
        warnings.warn(f"Numba does not work here ({error}); the CPU kernels fall back to plain torch", stacklevel=3)
        return None
    return numba_cpu
