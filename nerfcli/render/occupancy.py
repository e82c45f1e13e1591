"""Which cells of space hold anything: a coarse grid over the field's unit cube that lets rays skip the rest."""

import torch
from torch import Tensor

from nerfcli.field.contraction import training_points
from nerfcli.field.hash_field import HashField

# A cell counts as occupied when one step through it takes away more than this share of the light.
OCCUPIED_OPTICAL_DEPTH = 0.01
DECAY = 0.8


class Occupancy:
    """Optical depth of one ray step at each cell, as a decaying maximum over random points inside the cell.

    A cell is occupied where that exceeds min(0.01, its mean over the grid): the mean keeps cells open at the start,
    when all of space is thin fog.
    Source: Müller et al. 2022, Instant NGP, arXiv:2201.05989, appendix C, with a faster decay for short trainings.
    """

    def __init__(self, side: int, device: torch.device):
        self.optical_depth = torch.full((side, side, side), torch.inf, device=device)

    @property
    def occupied(self) -> Tensor:
        """(side, side, side) bool, indexed [z, y, x]; cells never looked at are occupied."""
        known = self.optical_depth[self.optical_depth.isfinite()]
        mean = known.mean() if len(known) else self.optical_depth.new_tensor(0.0)
        return self.optical_depth > mean.clamp_max(OCCUPIED_OPTICAL_DEPTH)

    @torch.no_grad()
    def refresh(
        self,
        field: HashField,
        *,
        share: float,
        shortest_step: float,
        growth: float,
        generator: torch.Generator,
    ) -> None:
        """Ask the field at one random point in each of a random `share` of the cells.

        Args:
            field: the field being trained.
            share: in (0, 1].
            shortest_step, growth: the step schedule of `sampling.step_edges`; distance is taken from the origin of
                the training frame, near which the cameras are.
            generator: source of the random choice, on the grid's device.
        """
        side, device = self.optical_depth.shape[0], self.optical_depth.device
        cells = torch.randperm(side**3, generator=generator, device=device)[: max(1, round(share * side**3))]
        place = torch.stack([cells % side, cells // side % side, cells // side**2], dim=-1)
        inside = torch.rand(len(cells), 3, generator=generator, device=device)
        coordinates = (place + inside) / side
        density = torch.cat([field.density(chunk) for chunk in coordinates.split(2**16)])
        radius = training_points(coordinates, field.settings.unbounded).norm(dim=-1)
        step = (growth * radius).clamp_min(shortest_step)
        flat = self.optical_depth.view(-1)
        old = flat[cells]
        flat[cells] = torch.maximum(torch.where(old.isinf(), 0.0, old * DECAY), density * step)
