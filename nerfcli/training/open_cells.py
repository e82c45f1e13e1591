"""The grid cells that training rays sample, and the occupancy of the field that opens and closes them."""

import functools

import torch
from torch import Tensor

from nerfcli import distributed
from nerfcli.field.interface import Field
from nerfcli.render.trained_field import Marching
from nerfcli.training.schedule import FIRST_THRESHOLD

# Contracted radius 2 is infinity; cells at the grid's corners, beyond it, are mapped to this radius.
LARGEST_RADIUS = 1e6


def uncontract(points: Tensor) -> Tensor:
    """Return the inverse of `kernels.contract`.

    x = y for |y| <= 1, else y / |y| / (2 - |y|)

    Args:
        points: (..., 3); a norm of 2 or more is infinitely far and becomes 1e6.

    Returns:
        (..., 3). Relative error grows as radius * 1e-7 in float32: the far field is coarse by design.
    """
    norm = points.square().sum(-1, keepdim=True).clamp_min(1.0).sqrt()
    radius = 1.0 / (2.0 - norm).clamp_min(1.0 / LARGEST_RADIUS)
    return points / norm * radius


def training_points(coordinates: Tensor, contraction: str) -> Tensor:
    """Return the inverse of `kernels.grid_coordinates`: unit cube to training frame."""
    if contraction == "none":
        return (coordinates - 0.5) * 2.0
    return uncontract((coordinates - 0.5) * 4.0)


def step_depths(field: Field, coordinates: Tensor, marching: Marching, *, detail: float = 1.0) -> Tensor:
    """Return the optical depth of a step of a ray at points (N, 3) of the unit cube, (N,); without gradients.

    Args:
        marching: its distances are from the origin of the training frame, near which the cameras are.
        detail: level of detail of the field, see `Field.medium`.
    """
    medium = field.medium(detail)
    density = torch.cat([field.backend.density(chunk, medium) for chunk in coordinates.split(2**16)])
    radius = training_points(coordinates, field.settings.contraction).norm(dim=-1)
    steps = marching.growth * radius * radius.clamp_min(1.0)  # as in `Marching.edges`
    return density * steps.clamp_min(marching.shortest_step)


DECAY = 0.8


class Occupancy:
    """Content of each cell: a decaying maximum of the optical depth of one ray step.

    It is updated by evaluating the field at random points. Space behind surfaces is not removed, at no cost: rays stop
    before they reach it.
    Source: Müller et al. 2022, Instant NGP, arXiv:2201.05989, appendix C, with a faster decay for short trainings.
    """

    def __init__(self, side: int, device: torch.device):
        self.optical_depth = torch.full((side, side, side), torch.inf, device=device)

    def above(self, threshold: float) -> Tensor:
        """Return the cells, (side, side, side) bool indexed [z, y, x], above `least` or never evaluated.

        A cell with NaN counts as above, so that rays sample it and the loss detects the NaN.
        """
        return ~(self.optical_depth <= self.least(threshold))

    def least(self, threshold: float) -> Tensor:
        """Return the optical depth above which cells are open, (): the threshold, or the mean of all if that is less.

        In a short training, all of space may still be fog below any fixed threshold; cells that rays skip would not
        learn any more.
        """
        return self.optical_depth.nanmean().clamp_max(threshold)

    @torch.no_grad()
    def refresh(
        self, field: Field, marching: Marching, *, detail: float, cells: slice, generator: torch.Generator
    ) -> None:
        """Evaluate the field at one random point in each of the chosen cells.

        Args:
            marching, detail: see `step_depths`.
            cells: slice of the cells, numbered (z * side + y) * side + x; in this order their features are close in
                memory.
            generator: source of the random points, on the grid's device.
        """
        side, device = self.optical_depth.shape[0], self.optical_depth.device
        numbers = torch.arange(side**3, device=device)[cells]
        place = torch.stack([numbers % side, numbers // side % side, numbers // side**2], dim=-1)
        inside = torch.rand(len(numbers), 3, generator=generator, device=device)
        coordinates = (place + inside) / side
        depths = step_depths(field, coordinates, marching, detail=detail)
        chosen = self.optical_depth.view(-1)[cells]
        chosen.copy_(torch.maximum(torch.where(chosen.isinf(), 0.0, chosen * DECAY), depths))


OCCUPANCY_SIDE = 64
REFRESH_EVERY = 8
REFRESH_TURNS = 8
# Detailed fields also have a fine grid. At a refresh, the optical depth of a visited cell decays, unless the samples
# there were larger. Rays then sample all cells that the coarse grid leaves open, so that closed fine ones can reopen.
FINE_SIDE = 2 * OCCUPANCY_SIDE
UNVISITED = -1.0


class OpenCells:
    """The cells that rays sample, of a coarse grid and, for detailed fields, of a fine one.

    The coarse grid is filled from random points of the field, see `Occupancy`. Surfaces are much thinner than its
    cells. The fine grid holds the optical depths of the samples that the training takes anyway, and closes the cells in
    which these samples were empty; a coarse cell is open as long as they find something in one of its fine cells.
    """

    def __init__(self, field: Field, marching: Marching, device: torch.device):
        self._field, self._marching = field, marching
        self._occupancy = Occupancy(OCCUPANCY_SIDE, device)
        # Fine cells: the largest optical depth of the samples since the last refresh, and the value up to then.
        self.cell_depths: Tensor | None = None
        if field.settings.detailed:
            self.cell_depths = torch.full((FINE_SIDE, FINE_SIDE, FINE_SIDE), UNVISITED, device=device)
            self._depths = torch.full_like(self.cell_depths, torch.inf)
        self._open(FIRST_THRESHOLD)

    def at(self, step: int) -> Tensor:
        """Return the open cells (G, G, G) for one step: those of the fine grid, if there is one, in most steps."""
        return self.coarse if self.cell_depths is None or step % REFRESH_EVERY == 0 else self._fine

    @property
    def visited(self) -> Tensor:
        """The open cells of the coarse grid, (G, G, G) bool, in which a training ray has ever had a sample.

        The others still hold the initial fog, behind surfaces or beside all photos. Without a fine grid these are all
        open cells.
        """
        if self.cell_depths is None:
            return self.coarse
        parts = FINE_SIDE // OCCUPANCY_SIDE
        fine = self._depths.isfinite() | (self.cell_depths >= 0)
        blocks = fine.view(OCCUPANCY_SIDE, parts, OCCUPANCY_SIDE, parts, OCCUPANCY_SIDE, parts)
        return self.coarse & blocks.any(5).any(3).any(1)

    def refresh(self, step: int, *, threshold: float, detail: float, generator: torch.Generator) -> None:
        """Update the open cells from the field, every few steps.

        Args:
            threshold: optical depth per step below which cells are closed.
            detail: of the field, see `Field.medium`.
            generator: source of the random points of the coarse grid.
        """
        # The whole coarse grid once, after a warm-up in which everything is open; then a fraction of it at a time.
        if step == 0 or step % REFRESH_EVERY:
            return
        turn = step // REFRESH_EVERY
        self._occupancy.refresh(
            self._field,
            self._marching,
            detail=detail,
            cells=slice(None) if turn == 1 else slice(turn % REFRESH_TURNS, None, REFRESH_TURNS),
            generator=generator,
        )
        if self.cell_depths is not None:
            distributed.keep_largest(self.cell_depths)
            # The host waits for a GPU to count these; computing all cells instead takes a CPU 1.6 times as long.
            cell_depths, depths = self.cell_depths.view(-1), self._depths.view(-1)
            visited = (cell_depths >= 0).nonzero()[:, 0]
            before = depths[visited]
            depths[visited] = torch.where(before.isinf(), 0.0, before * DECAY).maximum(cell_depths[visited])
            cell_depths[visited] = UNVISITED
        self._open(threshold)

    def _open(self, threshold: float) -> None:
        self.coarse, least = self._occupancy.above(threshold), self._occupancy.least(threshold)
        parts = FINE_SIDE // OCCUPANCY_SIDE
        if self.cell_depths is not None:
            # Random points often miss a surface that takes a small part of its cell, such as the tip of a stem, until
            # the cell closes for good. The samples of the training hit it.
            fine = self._depths > least
            found = fine & (self._depths < torch.inf)
            for axis in range(3):  # five times as fast as the largest depth of each coarse cell
                found = functools.reduce(torch.logical_or, found.unflatten(axis, (-1, parts)).unbind(axis + 1))
            self.coarse |= found
            # Only the two outer axes are expanded by broadcasting: whole rows of fine cells are fast, pairs are not.
            rows = self.coarse.repeat_interleave(parts, dim=2)[:, None, :, None]
            fine.view(OCCUPANCY_SIDE, parts, OCCUPANCY_SIDE, parts, FINE_SIDE).logical_and_(rows)
            self._fine = fine

    def state(self) -> dict[str, Tensor]:
        """Return the state for `restore`."""
        tensors = {"optical_depth": self._occupancy.optical_depth, "occupied": self.coarse}
        if self.cell_depths is not None:
            tensors |= {"fine_depth": self._depths, "fine_visits": self.cell_depths, "fine_occupied": self._fine}
        return tensors

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._occupancy.optical_depth = tensors["optical_depth"]
        # Not recomputed: the threshold changes between two refreshes, the open cells do not.
        self.coarse = tensors["occupied"]
        if self.cell_depths is not None:
            self._depths, self.cell_depths = tensors["fine_depth"], tensors["fine_visits"]
            self._fine = tensors["fine_occupied"]
