"""The backend in plain torch: ray operations composed of per-sample kernels, which faster backends replace.

Letters as in `interface`.

On a GPU, `render_rays` of a hash grid makes the host wait once, for the number of samples.
"""

import math
from types import ModuleType
from typing import Any, ClassVar

import torch
from torch import Tensor

from nerfcli.kernels import reference
from nerfcli.kernels.contraction import sample_widths
from nerfcli.kernels.harmonics import spherical_harmonics
from nerfcli.kernels.interface import (
    UNSEEN,
    HashGrid,
    Intervals,
    March,
    Medium,
    PixelTable,
    Rays,
    RaysSeen,
    RaySums,
    Samples,
    Targets,
    Trace,
    TraceOptions,
)


class Backend:
    """The hot operations: here those of `reference`, on any device and in any precision.

    `name` is its name in descriptions of the machine and in messages; `deterministic` says whether the same inputs
    always give the same bits; `operations` are the single operations on packed samples, as `reference` defines them.
    Subclasses differ in these, and in how they sample and evaluate a hash grid.
    """

    name: str = "reference"
    operations: ClassVar[ModuleType] = reference
    adam_rows = staticmethod(reference.adam_rows)
    project = staticmethod(reference.project)
    back_project = staticmethod(reference.back_project)
    denoise_total_variation = staticmethod(reference.denoise_total_variation)

    def __init__(self, device: torch.device):
        self.deterministic = device.type == "cpu"

    def pixel_rays(self, chosen: Tensor, pixels: PixelTable) -> tuple[Tensor, Tensor, Tensor]:
        """Return origins (N, 3), directions (N, 3) and colours (N, C) in [0, 1] of chosen pixels (N,) int64."""
        return self.operations.pixel_rays(chosen, pixels)

    def render_rays(
        self,
        rays: Rays,
        march: March,
        medium: HashGrid | Medium,
        targets: Targets = Targets(),
        *,
        background: Tensor,
        cell_depths: Tensor | None = None,
        trace: Trace | None = None,
    ) -> RaySums:
        """Render rays for training, with gradients.

        Args:
            background: (R, 3) sRGB, without gradient.
            cell_depths: (C, C, C) over the unit cube; raised to the optical depth of the samples, including those
                left out for their weight, see `keep_largest`.

        Differentiable in origins, directions, the table and the layers.
        """
        samples = self._visible(rays.detached(), march, medium, cell_depths)
        starts, ends, offsets, index = samples.starts, samples.ends, samples.offsets, samples.rays
        if torch.is_grad_enabled() and (rays.origins.requires_grad or rays.directions.requires_grad):
            lines = rays.origins, rays.directions
            coordinates = _Coordinates.apply(*lines, samples, march.contraction, self.operations)
            samples = samples._replace(coordinates=coordinates)
        if isinstance(medium, HashGrid):
            if medium.antialias and rays.cones is not None:
                widths = sample_widths(rays.detached(), starts, ends, index=index, contraction=march.contraction)
                samples = samples._replace(widths=widths)
            density, rgb = self._radiance(samples, rays.directions, medium)
        else:
            density, rgb = medium.radiance(samples.coordinates, rays.directions, index)
        if targets.near is not None and density.requires_grad:
            reference.scale_gradients(density, rgb, distance=starts, near=targets.near)
        colour, transmittance, weights = self.operations.composite(
            density, rgb, ends - starts, offsets=offsets, background=background
        )
        apart = off = transmittance[:0]
        if targets.distortion:
            near, far = self._contracted(starts, ends)
            apart = self.operations.distortion(weights, near, far, offsets)
        if targets.distances is not None and len(targets.distances):
            off = reference.depth_loss(
                weights, transmittance, (starts + ends) / 2, rays=index, distances=targets.distances
            )
        if trace is not None:
            trace("coordinates of samples", samples.coordinates, index)
            if samples.encoded is not None:
                trace("code of samples", samples.encoded, index)
            trace("density of samples", density, index)
            trace("colour of samples", rgb, index)
            trace("weights of samples along rays", weights, index)
        return RaySums(colour, transmittance, apart, off, torch.tensor(len(starts)))

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
        """Render rays for pictures, without gradients, on a background (R, 3) or (3,) sRGB."""
        samples = self._visible(rays.detached(), march, medium, None)
        starts, ends, density, offsets = samples.starts, samples.ends, samples.density, samples.offsets
        index, lengths = samples.rays, ends - starts
        weights, _ = self.operations.interval_weights(density, lengths, offsets)
        unseen = weights <= (options.negligible / offsets.diff().clamp_min(1).to(weights))[index]
        seen = (~unseen).nonzero()[:, 0]
        rgb = torch.full((len(density), 3), UNSEEN, dtype=density.dtype, device=density.device)
        if isinstance(medium, HashGrid):
            assert samples.encoded is not None
            rgb[seen] = self._networks(samples.encoded[seen], rays.directions, index[seen], medium)[1]
        else:
            rgb[seen] = medium.radiance(samples.coordinates[seen], rays.directions, index[seen])[1]
        colour, transmittance, _ = self.operations.composite(
            density, rgb, lengths, offsets=offsets, background=background.expand(len(rays.origins), 3)
        )
        light = self.operations.ray_termination(density, starts, ends, offsets=offsets, fractions=options.fractions)
        stopped = transmittance <= math.exp(-march.max_optical_depth) * (1 + 1e-5)  # rounding must not hide a stop
        behind = torch.maximum(background, 1.0 - background).amax(-1)  # largest difference from the background's colour
        left_out = UNSEEN * torch.zeros_like(transmittance).index_add(0, index, torch.where(unseen, weights, 0.0))
        error = left_out + torch.where(stopped, transmittance * behind, 0.0)
        return RaysSeen(colour, light, error, Intervals(density, starts, ends, offsets))

    @torch.no_grad()
    def density(self, coordinates: Tensor, medium: HashGrid | Medium) -> Tensor:
        """Return the density (N,) at coordinates (N, 3) of the unit cube, without gradients."""
        if not isinstance(medium, HashGrid):
            return medium.density(coordinates)
        return self.operations.density(self.hash_encode(coordinates, medium.table, medium.resolutions), medium.layers)

    def hash_encode(
        self, points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, table_grad: Tensor | None = None
    ) -> Tensor:
        """Interpolate tables at points (N, 3) of the unit cube, giving (N, L * F), for media made of tables.

        Differentiable in points and in the table, whose gradient is added to `table_grad` if that is given.
        """
        return _encode_into(points, table, resolutions, widths=None, table_grad=table_grad)

    def _visible_in_grid(self, rays: Rays, along: March, grid: HashGrid, cell_depths: Tensor | None) -> Samples:
        """See `reference.visible_samples`."""
        return self.operations.visible_samples(rays, along, grid, cell_depths)

    def _encoded(self, samples: Samples, grid: HashGrid) -> Tensor:
        """Return the encoded features of samples again, with gradients."""
        points, widths, table_grad = samples.coordinates, samples.widths, grid.table_grad
        return _encode_into(points, grid.table, grid.resolutions, widths=widths, table_grad=table_grad)

    def _networks(self, encoded: Tensor, directions: Tensor, index: Tensor, grid: HashGrid) -> tuple[Tensor, Tensor]:
        """Return densities and colours of encoded features, seen along directions (R, 3) of rays `index` (N,)."""
        harmonics = spherical_harmonics(directions, grid.view_degree)
        return self.operations.radiance(encoded, harmonics, index, grid.layers)

    def _contracted(self, starts: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
        """Return `reference.contracted_distance` of the ends of intervals."""
        return reference.contracted_distance(starts), reference.contracted_distance(ends)

    def _radiance(self, samples: Samples, directions: Tensor, grid: HashGrid) -> tuple[Tensor, Tensor]:
        """Return densities and colours of samples along directions (R, 3) of rays, with gradients."""
        return self._networks(self._encoded(samples, grid), directions, samples.rays, grid)

    def _visible(self, rays: Rays, march: March, medium: HashGrid | Medium, cell_depths: Tensor | None) -> Samples:
        if isinstance(medium, HashGrid):
            return self._visible_in_grid(rays, march, medium, cell_depths)
        with torch.no_grad():  # samples behind surfaces are computed, then left out
            starts, ends, coordinates, offsets = self.operations.occupied_samples(rays, march)
            density = torch.cat([medium.density(chunk) for chunk in coordinates.split(2**16)])
            reached = self.operations.optical_depth_before(density, ends - starts, offsets) < march.max_optical_depth
            kept = torch.nn.functional.pad(reached.cumsum(0), (1, 0))[offsets]
            if cell_depths is not None:
                self.operations.keep_largest(cell_depths, coordinates[reached], (density * (ends - starts))[reached])
            rays_of_samples = self.operations.ray_indices(kept)
            return Samples(
                starts[reached], ends[reached], density[reached], None, coordinates[reached], kept, rays_of_samples
            )


class _Coordinates(torch.autograd.Function):
    """The coordinates of samples, which marching has computed, as a function of their rays."""

    @staticmethod
    def forward(
        ctx: Any, origins: Tensor, directions: Tensor, samples: Samples, contraction: str, operations: ModuleType
    ) -> Tensor:
        ctx.save_for_backward(origins, directions, samples.starts, samples.ends, samples.offsets)
        ctx.operations, ctx.contraction = operations, contraction
        return samples.coordinates.view_as(samples.coordinates)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *lines, offsets = ctx.saved_tensors
        by_rays = ctx.operations.ray_gradients(
            *lines, offsets=offsets, contraction=ctx.contraction, gradient=gradients[0]
        )
        return *by_rays, None, None, None


def _encode_into(
    points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, widths: Tensor | None, table_grad: Tensor | None
) -> Tensor:
    """Return `reference.hash_encode`; the gradient by the table is added to `table_grad` if that is given."""
    if table_grad is None or not (table.requires_grad and torch.is_grad_enabled()):
        return reference.hash_encode(points, table, resolutions, widths)
    leaf = table.detach().to(table_grad.dtype).requires_grad_()  # gradients of a half-precision table are not rounded

    def add_to_sink(given: Tensor) -> None:
        if given.grad is not None:
            table_grad.add_(given.grad)

    leaf.register_post_accumulate_grad_hook(add_to_sink)
    return reference.hash_encode(points, leaf, resolutions, widths)
