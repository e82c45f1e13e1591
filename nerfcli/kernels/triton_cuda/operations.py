"""Single operations on packed samples, by the GPU kernels or, where a kernel is not worth it, by the reference."""

from torch import Tensor

from nerfcli.kernels.interface import AdamStep, HashGrid, March, Rays, Samples
from nerfcli.kernels.reference import keep_largest
from nerfcli.kernels.triton_cuda import marching, row_adam
from nerfcli.kernels.triton_cuda.compositing import composite, distortion, interval_weights, optical_depth_before
from nerfcli.kernels.triton_cuda.coordinates import ray_gradients
from nerfcli.kernels.triton_cuda.depth import ray_termination
from nerfcli.kernels.triton_cuda.hash_grid import hash_encode
from nerfcli.kernels.triton_cuda.marching import occupied_samples
from nerfcli.kernels.triton_cuda.pixels import pixel_rays
from nerfcli.kernels.triton_cuda.rays import ray_indices

__all__ = [
    "adam_rows",
    "composite",
    "distortion",
    "hash_encode",
    "interval_weights",
    "keep_largest",
    "occupied_samples",
    "optical_depth_before",
    "pixel_rays",
    "ray_gradients",
    "ray_indices",
    "ray_termination",
    "visible_samples",
]


def visible_samples(rays: Rays, along: March, grid: HashGrid) -> Samples:
    """See `reference.visible_samples`."""
    return marching.visible_samples(rays, along, grid, table=grid.table.half(), capacity=marching.Capacity())


def adam_rows(table: Tensor, gradient: Tensor, first: Tensor, second: Tensor, *, step: AdamStep) -> None:
    """See `reference.adam_rows`."""
    row_adam.adam_rows(table, gradient, first, second, half=table.half(), step=step)
