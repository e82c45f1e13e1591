"""Occupancy grid: a coarse grid over the field's unit cube that lets rays skip empty space."""

import torch
from torch import Tensor

from nerfcli.field.contraction import training_points
from nerfcli.field.interface import Field

DECAY = 0.8


class Occupancy:
    """Content of each cell: a decaying maximum of the optical depth of one ray step.

    It comes from asking the field at random points. What lies behind surfaces stays as it is, and costs nothing: rays
    stop before they get there.
    Source: Müller et al. 2022, Instant NGP, arXiv:2201.05989, appendix C, with a faster decay for short trainings.
    """

    def __init__(self, side: int, device: torch.device):
        self.optical_depth = torch.full((side, side, side), torch.inf, device=device)

    def above(self, optical_depth: float) -> Tensor:
        """(side, side, side) bool, indexed [z, y, x]: cells that hold more than `least`, and those never looked at.

        A cell with NaN counts as holding more: rays look into it, and the loss finds the NaN.
        """
        return ~(self.optical_depth <= self.least(optical_depth))

    def least(self, optical_depth: float) -> Tensor:
        """Return () this optical depth, or the mean of all cells where that is less.

        In a short training, all of space may still be fog that is thinner than any threshold; where no ray looks,
        nothing is learned any more.
        """
        return self.optical_depth.nanmean().clamp_max(optical_depth)

    @torch.no_grad()
    def refresh(
        self,
        field: Field,
        *,
        detail: float,
        cells: slice,
        shortest_step: float,
        growth: float,
        generator: torch.Generator,
    ) -> None:
        """Evaluate the field at one random point in each of some cells.

        Args:
            field: the field being trained.
            detail: of the field, see `Field.medium`.
            cells: which of the cells, numbered (z * side + y) * side + x; in this order their features are near in
                memory.
            shortest_step, growth: the step schedule of `sampling.step_edges`; distance is taken from the origin of
                the training frame, near which the cameras are.
            generator: source of the random points, on the grid's device.
        """
        side, device = self.optical_depth.shape[0], self.optical_depth.device
        numbers = torch.arange(side**3, device=device)[cells]
        place = torch.stack([numbers % side, numbers // side % side, numbers // side**2], dim=-1)
        inside = torch.rand(len(numbers), 3, generator=generator, device=device)
        coordinates = (place + inside) / side
        medium = field.medium(detail)
        density = torch.cat([field.backend.density(chunk, medium) for chunk in coordinates.split(2**16)])
        radius = training_points(coordinates, field.settings.contraction).norm(dim=-1)
        step = (growth * radius * radius.clamp_min(1.0)).clamp_min(shortest_step)  # as `sampling.step_length`
        chosen = self.optical_depth.view(-1)[cells]
        chosen.copy_(torch.maximum(torch.where(chosen.isinf(), 0.0, chosen * DECAY), density * step))

    def state(self) -> dict[str, Tensor]:
        """Return the state for `restore`."""
        return {"optical_depth": self.optical_depth}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take up what `state` gave."""
        self.optical_depth = tensors["optical_depth"]
