"""Backend of the reference operations, on any device and in any precision."""

import torch
from torch import Tensor

from nerfcli.kernels import reference
from nerfcli.kernels.composition import Backend
from nerfcli.kernels.harmonics import spherical_harmonics
from nerfcli.kernels.interface import HashGrid, Rays, Samples


class ReferenceBackend(Backend):
    """Backend composed of `reference`.

    Args:
        device: of its tensors; on a GPU, sums are added in varying order, and results do not repeat to the bit.
    """

    name = "reference"
    operations = reference
    adam_rows = staticmethod(reference.adam_rows)
    project = staticmethod(reference.project)
    back_project = staticmethod(reference.back_project)
    denoise_total_variation = staticmethod(reference.denoise_total_variation)
    _visible_in_grid = staticmethod(reference.visible_samples)

    def __init__(self, device: torch.device):
        self.deterministic = device.type == "cpu"

    def hash_encode(
        self, points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, table_grad: Tensor | None = None
    ) -> Tensor:
        return encode_into(points, table, resolutions, widths=None, table_grad=table_grad)

    def _coordinates(self, rays: Rays, samples: Samples, contraction: str) -> Tensor:
        return reference.sample_coordinates(
            rays.origins,
            rays.directions,
            samples.starts,
            samples.ends,
            offsets=samples.offsets,
            contraction=contraction,
        )

    def _encoded(self, samples: Samples, grid: HashGrid, *, widths: Tensor | None, table_grad: Tensor | None) -> Tensor:
        return encode_into(samples.coordinates, grid.table, grid.resolutions, widths=widths, table_grad=table_grad)

    def _density_of(self, encoded: Tensor, grid: HashGrid) -> Tensor:
        return reference.density(encoded, grid.layers)

    def _networks(self, encoded: Tensor, directions: Tensor, index: Tensor, grid: HashGrid) -> tuple[Tensor, Tensor]:
        return reference.radiance(encoded, spherical_harmonics(directions, grid.view_degree), index, grid.layers)


def encode_into(
    points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, widths: Tensor | None, table_grad: Tensor | None
) -> Tensor:
    """Return `reference.hash_encode`; the gradient with respect to the table goes into the sink, if there is one."""
    if table_grad is None or not (table.requires_grad and torch.is_grad_enabled()):
        return reference.hash_encode(points, table, resolutions, widths)
    leaf = table.detach().to(table_grad.dtype).requires_grad_()  # gradients of a half-precision table are not rounded

    def add_to_sink(given: Tensor) -> None:
        if given.grad is not None:
            table_grad.add_(given.grad)

    leaf.register_post_accumulate_grad_hook(add_to_sink)
    return reference.hash_encode(points, leaf, resolutions, widths)
