"""The cells that training rays look into."""

import torch
from torch import Tensor

from nerfcli.field.interface import Field
from nerfcli.fit.ranks import Alone
from nerfcli.render.model import Marching
from nerfcli.render.occupancy import Occupancy

OCCUPANCY_SIDE = 64
REFRESH_EVERY = 8
REFRESH_TURNS = 8
# Rays pass over cells where a step takes away less light than this: hardly any at first, when all of space is thin fog
# and nothing tells yet where the surfaces are; then ever more, so that surfaces have to become compact.
FIRST_THRESHOLD, THRESHOLD = 3e-4, 1e-2
# The cells are closed by this share of the budget at the latest, however few the steps.
CLOSING_SHARE = 0.3
# Detailed fields also have a fine grid. At a refresh, a cell in which samples were thinner than before keeps this part
# of its optical depth. Every few steps, rays look into all cells that the coarse grid leaves open, so that closed fine
# cells can open again.
FINE_SIDE = 128
DECAY = 0.8
LOOK_AROUND_EVERY = 8
UNVISITED = -1.0


class OpenCells:
    """The cells that rays look into, of a coarse grid and, for detailed fields, of a fine one.

    Random points of the field fill the coarse grid, see `Occupancy`. Surfaces are much thinner than its cells. The fine
    grid holds the optical depths of the samples that the training takes anyway, and closes the cells that these found
    empty.

    Args:
        field: the field being trained.
        covered: the coarse cells that may be filled, see `coverage.covered_cells`; None for all.
    """

    def __init__(self, field: Field, device: torch.device, *, covered: Tensor | None):
        self._field, self._covered = field, covered
        self._occupancy = Occupancy(OCCUPANCY_SIDE, device)
        # Fine cells: the largest optical depth of the samples since the last refresh, and what was known before.
        self.visits: Tensor | None = None
        if field.settings.detailed:
            self.visits = torch.full((FINE_SIDE, FINE_SIDE, FINE_SIDE), UNVISITED, device=device)
            self._depths = torch.full_like(self.visits, torch.inf)
        self._open(FIRST_THRESHOLD)

    def at(self, step: int) -> Tensor:
        """Return the open cells (G, G, G) of one step, of the fine grid in most steps."""
        return self.coarse if self.visits is None or step % LOOK_AROUND_EVERY == 0 else self._fine

    def refresh(
        self,
        step: int,
        *,
        share: float,
        detail: float,
        marching: Marching,
        generator: torch.Generator,
        ranks: Alone,
    ) -> None:
        """Look at what fills space, every few steps.

        Args:
            share: how much of the budget is used, in [0, 1].
            detail: of the field, see `Field.medium`.
            generator: source of the random points of the coarse grid.
            ranks: whose samples count.
        """
        # The whole coarse grid once, after a warm-up in which everything is open; then a share at a time.
        if step == 0 or step % REFRESH_EVERY:
            return
        turn = step // REFRESH_EVERY
        self._occupancy.refresh(
            self._field,
            detail=detail,
            cells=slice(None) if turn == 1 else slice(turn % REFRESH_TURNS, None, REFRESH_TURNS),
            shortest_step=marching.shortest_step,
            growth=marching.growth,
            generator=generator,
        )
        if self.visits is not None:
            ranks.keep_largest(self.visits)
            # The host waits for a GPU to count these; to compute all cells instead takes a CPU 1.6 times as long.
            visits, depths = self.visits.view(-1), self._depths.view(-1)
            visited = (visits >= 0).nonzero()[:, 0]
            before = depths[visited]
            depths[visited] = torch.where(before.isinf(), 0.0, before * DECAY).maximum(visits[visited])
            visits[visited] = UNVISITED
        closed = min(1.0, max(step / self._field.closing_steps, share / CLOSING_SHARE))
        self._open(FIRST_THRESHOLD ** (1.0 - closed) * THRESHOLD**closed)

    def _open(self, threshold: float) -> None:
        self.coarse = self._occupancy.above(threshold)
        if self._covered is not None:
            self.coarse &= self._covered
        if self.visits is not None:
            fine = self._depths > self._occupancy.least(threshold)
            parts = FINE_SIDE // OCCUPANCY_SIDE
            # Only the two outer axes are spread out by strides: whole rows of fine cells are fast, pairs are not.
            rows = self.coarse.repeat_interleave(parts, dim=2)[:, None, :, None]
            fine.view(OCCUPANCY_SIDE, parts, OCCUPANCY_SIDE, parts, FINE_SIDE).logical_and_(rows)
            self._fine = fine

    def state(self) -> dict[str, Tensor]:
        """Return the state for `restore`."""
        tensors = {**self._occupancy.state(), "occupied": self.coarse}
        if self.visits is not None:
            tensors |= {"fine_depth": self._depths, "fine_visits": self.visits, "fine_occupied": self._fine}
        return tensors

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take up what `state` gave."""
        self._occupancy.restore(tensors)
        # Not opened anew: the threshold moves between two refreshes, the open cells do not.
        self.coarse = tensors["occupied"]
        if self.visits is not None and "fine_depth" in tensors:  # checkpoints used to have no fine cells
            self._depths, self.visits = tensors["fine_depth"], tensors["fine_visits"]
            self._fine = tensors["fine_occupied"]
