"""The hot operations on CPU threads, compiled by Numba for the processor they run on, cached on disk."""

from nerfcli.kernels.numba_cpu import machine_code
from nerfcli.kernels.numba_cpu.compile_all import warm_up
from nerfcli.kernels.numba_cpu.compositing import composite, distortion, interval_weights, optical_depth_before
from nerfcli.kernels.numba_cpu.coordinates import ray_gradients
from nerfcli.kernels.numba_cpu.depth import ray_termination
from nerfcli.kernels.numba_cpu.hash_grid import hash_encode
from nerfcli.kernels.numba_cpu.marching import keep_largest, occupied_samples
from nerfcli.kernels.numba_cpu.networks import density, radiance
from nerfcli.kernels.numba_cpu.pixels import pixel_rays
from nerfcli.kernels.numba_cpu.rays import ray_indices
from nerfcli.kernels.numba_cpu.row_adam import adam_rows
from nerfcli.kernels.numba_cpu.threads import thread_safe
from nerfcli.kernels.numba_cpu.tracing import trace_rays
from nerfcli.kernels.numba_cpu.visible import visible_samples
from nerfcli.kernels.numba_cpu.volumes import back_project, denoise_total_variation, project

machine_code.discard_outdated(machine_code.sources(), machine_code.folder())


def is_compiled() -> bool:
    """Return whether compiled kernels are cached on disk."""
    return machine_code.is_there()
