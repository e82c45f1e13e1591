"""Single operations on packed samples, by the GPU kernels or, where none is worth it, by the reference."""

from nerfcli.kernels.reference import mixture_quantile
from nerfcli.kernels.triton_cuda.compositing import composite, distortion, interval_weights, optical_depth_before
from nerfcli.kernels.triton_cuda.depth import light_ends
from nerfcli.kernels.triton_cuda.marching import occupied_samples
from nerfcli.kernels.triton_cuda.pixels import pixel_rays
from nerfcli.kernels.triton_cuda.rays import ray_indices

__all__ = [
    "composite",
    "distortion",
    "interval_weights",
    "light_ends",
    "mixture_quantile",
    "occupied_samples",
    "optical_depth_before",
    "pixel_rays",
    "ray_indices",
]
