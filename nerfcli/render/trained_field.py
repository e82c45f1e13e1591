"""A trained field as rays see it: its frame, its empty space, its background, the steps along rays."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.cameras.rigid import Similarity
from nerfcli.field.background import Background
from nerfcli.field.interface import Field
from nerfcli.kernels import distances_to_occupied


@dataclass(frozen=True)
class Marching:
    """Sampling of rays in steps that grow with distance, in units of the training frame.

    step(t) = max(shortest_step, growth * t * max(1, t)): a pixel covers more the farther away it is, and beyond the
    unit ball equal steps in 1 / t are about equal steps in contracted space.

    Args:
        near, far: 0 <= near < far.
        shortest_step: > 0.
        growth: step per distance at distance 1, >= 0; 0 gives equal steps.
    """

    near: float
    far: float
    shortest_step: float
    growth: float

    def edges(self) -> Tensor:
        """Return the distances that cut every ray.

        Returns:
            (S + 2,) float64, increasing, the first at `near`, the last but one at or beyond `far`; one more edge than
            the intervals need, so that a jittered cut always has a right neighbour.

        Raises:
            ValueError: the distances are not in order or the step is not positive.
        """
        near, far, shortest_step, growth = self.near, self.far, self.shortest_step, self.growth
        if not 0 <= near < far < math.inf or shortest_step <= 0 or growth < 0:
            raise ValueError(f"need 0 <= near < far and a positive step, got {near}, {far}, {shortest_step}, {growth}")
        edges = [near]
        while len(edges) < 2 or edges[-2] < far:
            distance = edges[-1]
            edges.append(distance + max(shortest_step, growth * distance * max(1.0, distance)))
        return torch.tensor(edges, dtype=torch.float64)

    def stretched(self, factor: float) -> "Marching":
        """Return the same span with steps `factor` (> 0) times as long."""
        return replace(self, shortest_step=factor * self.shortest_step, growth=factor * self.growth)


@dataclass(frozen=True)
class TrainedField:
    """A trained field with everything that tracing rays through it needs.

    Args:
        field: the radiance field, on points of the training frame.
        occupied: (G, G, G) bool over the field's unit cube.
        fine: the same over a finer grid, see `training.picture_cells`; None for models without.
        background: sRGB behind everything, for pictures without alpha.
        training_from_scene: normalisation of the scene to the training frame.
        unit: unit of length of the scene's frame, "arbitrary" or "metre".
    """

    field: Field
    occupied: Tensor
    marching: Marching
    background: Background
    training_from_scene: Similarity
    unit: str
    unit_source: str | None = None
    sha256: str | None = None
    fine: Tensor | None = None

    @property
    def open_cells(self) -> Tensor:
        """The cells that rays of pictures sample, of the finer grid if there is one."""
        return self.occupied if self.fine is None else self.fine

    @cached_property
    def distances(self) -> Tensor | None:
        """The distances to open cells, for `kernels.March`; None on a GPU, whose kernels do not use them."""
        return distances_to_occupied(self.open_cells) if self.device.type == "cpu" else None

    @property
    def contraction(self) -> str:
        """Contraction of space to the unit cube of the field."""
        return self.field.settings.contraction

    @property
    def device(self) -> torch.device:
        return self.occupied.device

    @property
    def thread_safe(self) -> bool:
        """Whether several threads may render it at the same time; only on a CPU."""
        return self.device.type == "cpu" and kernels.thread_safe()

    def stretched(self, factor: float) -> Self:
        """Return the same model with steps along rays `factor` times as long."""
        return replace(self, marching=self.marching.stretched(factor))
