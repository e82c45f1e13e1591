"""Backend of the compiled CPU kernels, for float32.

The pass with gradients reuses the coordinates and features of samples that marching has computed. A hash grid of sizes
that are not compiled, see `can_radiance`, is sampled and evaluated by the reference.
"""

import torch
from torch import Tensor

from nerfcli.kernels import numba_cpu, reference
from nerfcli.kernels.composition import Backend
from nerfcli.kernels.harmonics import spherical_harmonics
from nerfcli.kernels.interface import FEATURES, AdamStep, HashGrid, March, Medium, Rays, RaysSeen, Samples


class NumbaBackend(Backend):
    """Backend composed of `numba_cpu`. The same seed and number of threads give the same bits."""

    name = "numba_cpu"
    operations = numba_cpu
    project = staticmethod(numba_cpu.project)
    back_project = staticmethod(numba_cpu.back_project)
    denoise_total_variation = staticmethod(numba_cpu.denoise_total_variation)

    @torch.no_grad()
    def trace_rays(
        self,
        rays: Rays,
        march: March,
        medium: HashGrid | Medium,
        *,
        background: Tensor,
        fractions: tuple[float, ...] = (),
        negligible: float = 0.0,
        keep_intervals: bool = True,
    ) -> RaysSeen:
        if not isinstance(medium, HashGrid) or not _fits(medium, medium.layers):
            return super().trace_rays(
                rays, march, medium, background=background, fractions=fractions, negligible=negligible
            )
        return numba_cpu.trace_rays(
            rays.detached(),
            march,
            medium,
            background=background,
            fractions=fractions,
            negligible=negligible,
            keep_intervals=keep_intervals,
        )

    def hash_encode(
        self, points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, table_grad: Tensor | None = None
    ) -> Tensor:
        if numba_cpu.can_hash_encode(points, table, resolutions):
            return numba_cpu.hash_encode(points, table, resolutions, table_grad)
        return super().hash_encode(points, table, resolutions, table_grad=table_grad)

    def adam_rows(self, table: Tensor, gradient: Tensor, first: Tensor, second: Tensor, *, step: AdamStep) -> None:
        module = numba_cpu if table.shape[-1] == FEATURES else reference
        module.adam_rows(table, gradient, first, second, step=step)

    def _visible_in_grid(self, rays: Rays, along: March, grid: HashGrid, cell_depths: Tensor | None) -> Samples:
        module = numba_cpu if _fits(grid, grid.layers[:2]) else reference
        return module.visible_samples(rays, along, grid, cell_depths)

    def _coordinates(self, rays: Rays, samples: Samples, contraction: str) -> Tensor:
        return numba_cpu.sample_coordinates(
            rays.origins,
            rays.directions,
            samples.starts,
            samples.ends,
            offsets=samples.offsets,
            contraction=contraction,
            computed=samples.coordinates,
        )

    def _encoded(self, samples: Samples, grid: HashGrid) -> Tensor:
        if not numba_cpu.can_hash_encode(samples.coordinates, grid.table, grid.resolutions):
            return super()._encoded(samples, grid)
        return numba_cpu.hash_encode(
            samples.coordinates, grid.table, grid.resolutions, grid.table_grad, samples.encoded, samples.widths
        )

    def _density_of(self, encoded: Tensor, grid: HashGrid) -> Tensor:
        module = numba_cpu if numba_cpu.can_radiance(encoded, grid.layers[:2]) else reference
        return module.density(encoded, grid.layers)

    def _networks(self, encoded: Tensor, directions: Tensor, index: Tensor, grid: HashGrid) -> tuple[Tensor, Tensor]:
        module = numba_cpu if numba_cpu.can_radiance(encoded, grid.layers) else reference
        return module.radiance(encoded, spherical_harmonics(directions, grid.view_degree), index, grid.layers)


def _fits(grid: HashGrid, layers: tuple[Tensor, ...]) -> bool:
    """Return whether marching is compiled for the sizes of a grid's table and of these layers."""
    code = grid.table.new_empty(0, grid.table.shape[0] * grid.table.shape[2])
    return numba_cpu.can_hash_encode(code, grid.table, grid.resolutions) and numba_cpu.can_radiance(code, layers)
