"""One step of a training: render a batch of rays by its plan, weigh what they show, and learn from it.

Nothing here knows of other processes, the clock, checkpoints or the console: `Fitting.advance` puts the parts together.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from nerfcli.field.interface import Field
from nerfcli.kernels import March, Rays, RaySums, Targets
from nerfcli.training.appearance import Appearance
from nerfcli.training.extent import RaySteps
from nerfcli.training.losses import LOSSES, Shown, colour_losses, emerging_losses
from nerfcli.training.open_cells import OpenCells
from nerfcli.training.optimiser import FieldOptimiser, PartsOptimiser
from nerfcli.training.pool import PixelBatch, PixelPool
from nerfcli.training.runs.components import Components
from nerfcli.training.schedule import StepPlan

# Optical depth at which training rays end: less than a thousandth of the light is left.
DEEPEST = 7.0
# Samples that absorb less of their ray's light than this have hardly any gradient: they are left out before their
# colours are computed, so that steps with the same number of samples have more rays.
LEAST_WEIGHT = 3e-3
# With more rays in a step than this, rows decay less where photos have alpha, see `row_decay`.
DECAY_RAYS = 4000


class Watch:
    """Observer that receives the tensors of a step in the order of computation; this one ignores them."""

    def state(self, give: Callable[[], tuple[dict[str, Tensor], Any]]) -> None:
        """Look at the state between two steps, which `give` collects."""

    def values(self, name: str, tensor: Tensor) -> None:
        """Look at a tensor."""

    def rows(self, name: str, tensor: Tensor, rays: Tensor) -> None:
        """Look at a tensor whose rows belong to rays (N,), and at the gradient that will come to it."""


UNWATCHED = Watch()


class NonFiniteError(Exception):
    """A step met a number that is not finite. `Sentinel` handles it, or the trials end; the user never sees it."""


class State(Protocol):
    """What a step reads and changes; see `fitting.Fitting`."""

    components: Components
    pool: PixelPool
    field: Field
    appearance: Appearance
    cells: OpenCells
    ray_steps: RaySteps
    optimiser: FieldOptimiser
    parts_optimiser: PartsOptimiser


@dataclass(frozen=True)
class Batch:
    """The rays of a step, or a part of them.

    Args:
        pixels: with the rays of the current cameras, which collect gradients where cameras learn.
        jitter: (R,) in [0, 1), where each ray's first step ends.
        behind: (R, 3) colours that the rays are composited on.
        rays, points: number of rays of the whole step, and of those with a known distance.
    """

    pixels: PixelBatch
    jitter: Tensor
    behind: Tensor
    rays: int
    points: int

    def part(self, own: Callable[[Tensor], Tensor]) -> "Batch":
        """Return a part of these rays; `own` returns its rows of a tensor."""
        pixels = PixelBatch(*map(own, self.pixels))
        return replace(self, pixels=pixels, jitter=own(self.jitter), behind=own(self.behind))


@dataclass(frozen=True)
class StepLosses:
    """What the rays of a batch contribute to the loss of a step.

    Args:
        weighted: the losses, each times its weight, () by name.
        colours: (R,) the loss of each ray's colour.
    """

    weighted: dict[str, Tensor]
    colours: Tensor
    samples: int

    def sum(self) -> Tensor:
        """Return what a step minimises, ()."""
        return functools.reduce(torch.add, self.weighted.values())


def step(state: State, batch: Batch, plan: StepPlan, watch: Watch = UNWATCHED) -> StepLosses:
    """Render the rays of a batch, and return their losses; the gradients are in the state afterwards.

    Those of rows are added to `Field.table_grad`, all others are the `grad` of their tensors.
    """
    state.optimiser.zero_grad()
    state.parts_optimiser.zero_grad()
    losses = losses_of(state, batch, plan, watch)
    if losses.samples > 0:
        losses.sum().backward()
    return replace(losses, weighted={name: loss.detach() for name, loss in losses.weighted.items()})


def losses_of(state: State, batch: Batch, plan: StepPlan, watch: Watch) -> StepLosses:
    """Render the rays of a batch, and return their losses."""
    pixels, components = batch.pixels, state.components
    nearest = state.ray_steps.nearest if components.near else None
    seen = state.field.backend.render_rays(
        Rays(pixels.origins, pixels.directions, batch.jitter, _cones(state, pixels)),
        _march(state, state.ray_steps.edges(plan.stride), state.cells.at(plan.step))._replace(
            least_weight=LEAST_WEIGHT
        ),
        state.field.medium(plan.detail),
        Targets(nearest, "distortion" in plan.weights, pixels.distances),
        background=batch.behind,
        cell_depths=state.cells.cell_depths,
        trace=watch.rows,
    )
    if watch is not UNWATCHED:
        watch.rows("rendered colour", seen.rgb, torch.arange(len(pixels.origins), device=seen.rgb.device))
    shown = _shown(state, batch, seen, plan)
    weighted = {name: weight * LOSSES[name](shown) for name, weight in plan.weights.items()}
    for name, loss in weighted.items():
        watch.values(f"loss of {name}", loss)
    return StepLosses(weighted, shown.colours.detach(), int(seen.samples))


def _shown(state: State, batch: Batch, seen: RaySums, plan: StepPlan) -> Shown:
    """Return what rendered rays show, for the losses."""
    appearance, pixels = state.appearance, batch.pixels
    rendered, measured = appearance.compared(seen.rgb, seen.transmittance, pixels, behind=batch.behind)
    distances = emerging_losses(seen.depth_loss) if plan.are_emerging and batch.points else seen.depth_loss
    return Shown(
        colours=colour_losses(rendered, measured),
        transmittance=seen.transmittance,
        distortion=seen.distortion,
        distances=pixels.trust * distances if batch.points else distances,
        sky=None if appearance.sky is None else appearance.sky[pixels.numbers],
        roughness=None if appearance.background is None else appearance.background.roughness(),
        rays=batch.rays,
        points=batch.points,
    )


def update(state: State, batch: Batch, losses: StepLosses, plan: StepPlan, *, rate_factor: float) -> None:
    """Take the optimisers' steps against the gradients of a step."""
    rate = rate_factor * plan.learning_rate
    state.optimiser.step(plan.step + 1, rate, decay=row_decay(state, batch.rays))
    state.parts_optimiser.step(rate)
    if state.appearance.cameras is not None:
        state.appearance.cameras.step(batch.pixels, losses.colours, plan.cameras, factor=rate_factor)


def row_decay(state: State, rays: int) -> float:
    """Return the weight decay of rows beside the mean loss of a step's rays.

    In photos that fill the frame, decay keeps space empty that few of them look into. Photos with alpha tell what is
    empty, and decay only blurs. There it shrinks as steps grow, like the gradient of a row that one ray touches:
    otherwise fields of long trainings get no sharper after a few minutes.
    """
    return state.field.row_decay * (min(1.0, DECAY_RAYS / rays) if state.pool.has_alpha else 1.0)


@torch.no_grad()
def compare(state: State, pixels: PixelBatch, plan: StepPlan) -> tuple[Tensor, Tensor]:
    """Return the model's and the photos' colours of pixels, both (N, 3) sRGB, alpha on white."""
    pixels = state.appearance.refine_cameras(pixels)
    behind = torch.full_like(pixels.origins, 1.0 if state.pool.has_alpha else 0.0)
    seen = _seen(state, pixels, plan, edges=state.ray_steps.edges(plan.stride), behind=behind)
    return state.appearance.compared(seen.rgb, seen.transmittance, pixels, behind=behind)


@torch.no_grad()
def light_from_beyond(state: State, pixels: PixelBatch, plan: StepPlan, *, distance: float) -> Tensor:
    """Return the fraction of each pixel's light, (N,), that comes from beyond a distance in the current field."""
    pixels = state.appearance.refine_cameras(pixels)
    edges = state.ray_steps.edges(plan.stride)
    near = edges[: max(2, int(torch.searchsorted(edges, distance, right=True)))]
    return _seen(state, pixels, plan, edges=near, behind=torch.zeros_like(pixels.origins)).transmittance


def _seen(state: State, pixels: PixelBatch, plan: StepPlan, *, edges: Tensor, behind: Tensor) -> RaySums:
    """Return what rays show that step from edge to edge, over the colours `behind` (N, 3)."""
    jitter = torch.full_like(pixels.origins[:, 0], 0.5)
    return state.field.backend.render_rays(
        Rays(pixels.origins, pixels.directions, jitter, _cones(state, pixels)),
        _march(state, edges, state.cells.coarse),
        state.field.medium(plan.detail),
        background=behind,
    )


def _march(state: State, edges: Tensor, occupied: Tensor) -> March:
    return March(edges, occupied, state.field.settings.contraction, DEEPEST)


def _cones(state: State, pixels: PixelBatch) -> Tensor | None:
    """Return the pixel widths per unit of distance if the field is antialiased, else None."""
    return state.pool.cones[state.pool.photo_of(pixels.numbers)] if state.components.antialias else None
