"""Backend of the compiled CPU kernels, for float32.

The pass with gradients reuses the coordinates and features of samples that marching has computed.
"""

import torch
from torch import Tensor

from nerfcli.kernels import numba_cpu
from nerfcli.kernels.composition import Backend
from nerfcli.kernels.interface import HashGrid, March, Medium, Rays, RaysSeen, Samples, TraceOptions


class NumbaBackend(Backend):
    """Backend composed of `numba_cpu`. The same seed and number of threads give the same bits."""

    name = "numba_cpu"
    operations = numba_cpu
    adam_rows = staticmethod(numba_cpu.adam_rows)
    project = staticmethod(numba_cpu.project)
    back_project = staticmethod(numba_cpu.back_project)
    denoise_total_variation = staticmethod(numba_cpu.denoise_total_variation)

    @torch.no_grad()
    def trace_rays(
        self,
        rays: Rays,
        march: March,
        medium: HashGrid | Medium,
        options: TraceOptions = TraceOptions(),
        *,
        background: Tensor,
    ) -> RaysSeen:
        if not isinstance(medium, HashGrid):
            return super().trace_rays(rays, march, medium, options, background=background)
        return numba_cpu.trace_rays(rays.detached(), march, medium, options, background=background)

    def hash_encode(
        self, points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, table_grad: Tensor | None = None
    ) -> Tensor:
        return numba_cpu.hash_encode(points, table, resolutions, table_grad)

    def _encoded(self, samples: Samples, grid: HashGrid) -> Tensor:
        return numba_cpu.hash_encode(
            samples.coordinates, grid.table, grid.resolutions, grid.table_grad, samples.encoded, samples.widths
        )
