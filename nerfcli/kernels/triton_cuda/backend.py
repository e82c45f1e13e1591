"""Backend of the GPU kernels: float32 fields, computed in float16 with float32 sums where it is safe.

The reference, on the device, looks up tables of 2^31 numbers and more, and computes total variation and projections of
scans.
"""

import weakref
from typing import Any

import torch
from torch import Tensor

from nerfcli.kernels.composition import Backend
from nerfcli.kernels.interface import AdamStep, HashGrid, March, Rays, Samples
from nerfcli.kernels.triton_cuda import compositing, hash_grid, marching, networks, operations, rays
from nerfcli.kernels.triton_cuda.row_adam import adam_rows


class HalfCopy:
    """The float16 copy of a table, remade when anything but `adam_rows` has changed the table."""

    def __init__(self) -> None:
        self._of: tuple[weakref.ref[Tensor], int, int] | None = None
        self._half = torch.empty(0)

    def of(self, table: Tensor) -> Tensor:
        """Return the copy of a table."""
        now = (table.data_ptr(), table._version)
        if self._of is None or self._of[0]() is not table or self._of[1:] != now:
            self._half = table.detach().to(torch.float16).contiguous()
            self._of = (weakref.ref(table), *now)
        return self._half


class TritonBackend(Backend):
    """Backend composed of `triton_cuda`. Sums are atomic: results of the same seed differ in their last digits."""

    name = "triton_cuda"
    operations = operations

    def __init__(self, device: torch.device):
        super().__init__(device)
        self.deterministic = False
        self._half = HalfCopy()
        self._capacity = marching.Capacity()

    def hash_encode(
        self, points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, table_grad: Tensor | None = None
    ) -> Tensor:
        if table.numel() < 2**31:  # indices into the table have 32 bits
            return hash_grid.hash_encode(points, table, resolutions, table_grad)
        return super().hash_encode(points, table, resolutions, table_grad=table_grad)

    def adam_rows(self, table: Tensor, gradient: Tensor, first: Tensor, second: Tensor, *, step: AdamStep) -> None:
        adam_rows(table, gradient, first, second, half=self._half.of(table), step=step)

    @torch.no_grad()
    def density(self, coordinates: Tensor, medium: Any) -> Tensor:
        if not isinstance(medium, HashGrid):
            return super().density(coordinates, medium)
        table = self._half.of(medium.table)
        code = hash_grid.encode(coordinates.contiguous(), table, medium.resolutions, widths=None, dtype=torch.float16)
        return networks.density(code, medium.layers)

    def _visible_in_grid(self, rays: Rays, along: March, grid: HashGrid, cell_depths: Tensor | None = None) -> Samples:
        with torch.no_grad():
            table = self._half.of(grid.table)
            return marching.visible_samples(
                rays, along, grid, table=table, capacity=self._capacity, cell_depths=cell_depths
            )

    def _radiance(self, samples: Samples, directions: Tensor, grid: HashGrid) -> tuple[Tensor, Tensor]:
        assert samples.encoded is not None
        return _Radiance.apply(
            samples.coordinates, directions, grid.table, self._half.of(grid.table), grid.table_grad, samples.encoded,
            samples.rays, samples.offsets, grid.resolutions, grid.view_degree, samples.widths, *grid.layers,
        )  # fmt: skip

    def _contracted(self, starts: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
        return compositing.contracted_distances(starts, ends)

    def _networks(self, encoded: Tensor, directions: Tensor, index: Tensor, grid: HashGrid) -> tuple[Tensor, Tensor]:
        return networks.radiance(encoded.half(), directions.contiguous(), index, grid.layers, degree=grid.view_degree)


class _Radiance(torch.autograd.Function):
    """Codes, densities and colours of samples as one autograd step: the gradient of codes is float16, and scaled."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, directions: Tensor, table: Tensor, half: Tensor, table_grad: Tensor | None,
        code: Tensor, index: Tensor, offsets: Tensor, resolutions: tuple[int, ...], degree: int, widths: Tensor | None,
        *layers: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        directions = directions.detach().contiguous()
        density, rgb = networks.radiance(code, directions, index, layers, degree=degree)
        ctx.save_for_backward(points, directions, code, index, offsets, density, *layers)
        ctx.table_shape, ctx.half, ctx.table_grad, ctx.widths = table.shape, half, table_grad, widths
        ctx.resolutions, ctx.degree = resolutions, degree
        return density, rgb

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        points, directions, code, index, offsets, density, *layers = ctx.saved_tensors
        by_density, by_rgb = (gradient.contiguous() for gradient in gradients)
        rays_learn = ctx.needs_input_grad[1]
        by_code, scale, by_direction, of_layers = networks.radiance_gradients(
            code, directions, index, tuple(layers), degree=ctx.degree, density=density, by_density=by_density,
            by_rgb=by_rgb, rays_learn=rays_learn,
        )  # fmt: skip
        of_points = of_table = None
        if ctx.needs_input_grad[0]:
            of_points = hash_grid.points_gradient(
                points, ctx.half, by_code, ctx.resolutions, scale=scale, widths=ctx.widths
            )
        if ctx.needs_input_grad[2]:
            of_table = torch.zeros(ctx.table_shape, device=points.device) if ctx.table_grad is None else ctx.table_grad
            hash_grid.add_table_gradient(of_table, points, by_code, ctx.resolutions, scale=scale, widths=ctx.widths)
        of_directions = rays.sum_along_rays(by_direction, offsets) if rays_learn else None
        of_table = of_table if ctx.table_grad is None else None
        return of_points, of_directions, of_table, *(None,) * 8, *of_layers
