"""Backend of the reference operations, on any device and in any precision."""

from typing import ClassVar

import torch
from torch import Tensor

from nerfcli.kernels import reference
from nerfcli.kernels.composition import ComposedBackend, SampleOperations
from nerfcli.kernels.harmonics import spherical_harmonics
from nerfcli.kernels.interface import HashGrid, March, Rays, Samples


class ReferenceBackend(ComposedBackend):
    """Backend composed of `reference`.

    Args:
        device: of its tensors; on a GPU, sums are added in varying order, and results do not repeat to the bit.
    """

    name = "reference"
    parts: ClassVar[SampleOperations] = reference

    def __init__(self, device: torch.device):
        self.deterministic = device.type == "cpu"

    def refuses(self, device: torch.device, dtype: torch.dtype) -> str | None:
        return None

    def hash_encode(
        self, points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, sink: Tensor | None = None
    ) -> Tensor:
        return encode_into(points, table, resolutions, widths=None, sink=sink)

    def adam_rows(
        self,
        table: Tensor,
        gradient: Tensor,
        first: Tensor,
        second: Tensor,
        *,
        step: int,
        rate: float,
        betas: tuple[float, float],
        eps: float,
        decay: float = 0.0,
    ) -> None:
        reference.adam_rows(table, gradient, first, second, step=step, rate=rate, betas=betas, eps=eps, decay=decay)

    def project(
        self, volume: Tensor, origins: Tensor, directions: Tensor, *, first: tuple[float, float, float], size: float
    ) -> Tensor:
        return reference.project(volume, origins, directions, first=first, size=size)

    def back_project(
        self,
        values: Tensor,
        origins: Tensor,
        directions: Tensor,
        *,
        shape: tuple[int, int, int],
        first: tuple[float, float, float],
        size: float,
    ) -> Tensor:
        return reference.back_project(values, origins, directions, shape=shape, first=first, size=size)

    def denoise_total_variation(self, target: Tensor, threshold: Tensor, dual: Tensor, *, iterations: int) -> Tensor:
        return reference.denoise_total_variation(target, threshold, dual, iterations=iterations)

    def _visible_in_grid(self, rays: Rays, march: March, grid: HashGrid, visits: Tensor | None) -> Samples:
        return reference.visible_samples(rays, march, grid, visits)

    def _coordinates(self, rays: Rays, samples: Samples, contraction: str) -> Tensor:
        return reference.sample_coordinates(
            rays.origins,
            rays.directions,
            samples.starts,
            samples.ends,
            offsets=samples.offsets,
            contraction=contraction,
        )

    def _encoded(self, samples: Samples, grid: HashGrid, *, widths: Tensor | None, sink: Tensor | None) -> Tensor:
        return encode_into(samples.coordinates, grid.table, grid.resolutions, widths=widths, sink=sink)

    def _density_of(self, encoded: Tensor, grid: HashGrid) -> Tensor:
        return reference.density(encoded, grid.layers)

    def _networks(self, encoded: Tensor, directions: Tensor, index: Tensor, grid: HashGrid) -> tuple[Tensor, Tensor]:
        return reference.radiance(encoded, spherical_harmonics(directions, grid.view_degree), index, grid.layers)


def encode_into(
    points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, widths: Tensor | None, sink: Tensor | None
) -> Tensor:
    """Return `reference.hash_encode`; the gradient with respect to the table goes into the sink, if there is one."""
    if sink is None or not (table.requires_grad and torch.is_grad_enabled()):
        return reference.hash_encode(points, table, resolutions, widths)
    leaf = table.detach().to(sink.dtype).requires_grad_()  # gradients of a half-precision table are not rounded

    def add_to_sink(given: Tensor) -> None:
        if given.grad is not None:
            sink.add_(given.grad)

    leaf.register_post_accumulate_grad_hook(add_to_sink)
    return reference.hash_encode(points, leaf, resolutions, widths)
