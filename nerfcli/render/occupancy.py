"""Occupancy grid: a coarse grid over the field's unit cube that lets rays skip empty space."""

import torch
from torch import Tensor

from nerfcli.field.contraction import training_points
from nerfcli.field.interface import Field

DECAY = 0.8


class Occupancy:
    """Content of each cell: a decaying maximum of the optical depth of one ray step.

    It is updated by evaluating the field at random points. Space behind surfaces is not removed, at no cost: rays stop
    before they reach it.
    Source: Müller et al. 2022, Instant NGP, arXiv:2201.05989, appendix C, with a faster decay for short trainings.
    """

    def __init__(self, side: int, device: torch.device):
        self.optical_depth = torch.full((side, side, side), torch.inf, device=device)

    def above(self, optical_depth: float) -> Tensor:
        """Return the cells, (side, side, side) bool indexed [z, y, x], above `least` or never evaluated.

        A cell with NaN counts as above, so that rays sample it and the loss detects the NaN.
        """
        return ~(self.optical_depth <= self.least(optical_depth))

    def least(self, optical_depth: float) -> Tensor:
        """Return the threshold, (): this optical depth, or the mean over all cells if that is less.

        In a short training, all of space may still be fog below any fixed threshold; cells that rays skip would not
        learn any more.
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
        """Evaluate the field at one random point in each of the chosen cells.

        Args:
            detail: level of detail of the field, see `Field.medium`.
            cells: slice of the cells, numbered (z * side + y) * side + x; in this order their features are close in
                memory.
            shortest_step, growth: the step schedule of `Marching`; distances are from the origin of the
                training frame, near which the cameras are.
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
        step = (growth * radius * radius.clamp_min(1.0)).clamp_min(shortest_step)  # as in `Marching.edges`
        chosen = self.optical_depth.view(-1)[cells]
        chosen.copy_(torch.maximum(torch.where(chosen.isinf(), 0.0, chosen * DECAY), density * step))

    def state(self) -> dict[str, Tensor]:
        """Return the state for `restore`."""
        return {"optical_depth": self.optical_depth}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state that `state` returned."""
        self.optical_depth = tensors["optical_depth"]
