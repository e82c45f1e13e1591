"""One training: the field, its occupancy and its optimiser, advanced step by step."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nerfcli import distributed
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.kinds import chosen_size, fresh_field
from nerfcli.kernels import March, Rays, Targets
from nerfcli.render.trained_field import Marching
from nerfcli.training.appearance import Appearance
from nerfcli.training.delayed import Delayed
from nerfcli.training.losses import colour_losses, emerging_losses
from nerfcli.training.open_cells import OpenCells
from nerfcli.training.optimiser import FieldOptimiser, PartsOptimiser
from nerfcli.training.point_depth import PointRays
from nerfcli.training.pool import PixelBatch, Pool
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import Schedule, StepPlan
from nerfcli.training.strides import RaySteps
from nerfcli.training.watch import UNWATCHED, NonFiniteError, Watch

# Rays of a step, at most. The optimiser takes longer with larger tables, for any number of rays: there is one more ray
# for this many rows of a level.
MOST_RAYS, ROWS_PER_RAY = 2**14, 2**5
# Optical depth at which training rays end: less than a thousandth of the light is left.
DEEPEST = 7.0
# Samples that absorb less of their ray's light than this have hardly any gradient: they are left out before their
# colours are computed, so that steps with the same number of samples have more rays.
LEAST_WEIGHT = 3e-3
# Weight of the opacity of rays that see the sky.
SKY_WEIGHT = 0.1
# Weight of the roughness of a learned background. Directions that no photo shows take the colours of their neighbours;
# without it, Adam makes large steps from the little light that leaks through surfaces, and their colours are arbitrary.
ROUGHNESS_WEIGHT = 1e-6
# With more rays in a step than this, rows decay less where photos have alpha, see `Fitting.row_decay`.
DECAY_RAYS = 4000


@dataclass(frozen=True)
class StepResult:
    """Result of one step: its loss (on a GPU, that of the previous step) and its numbers of samples and rays."""

    loss: float
    samples: int
    rays: int


class Fitting:
    """The state of a training. On a CPU, the same seed and thread count give the same numbers, step for step.

    Args:
        marching, contraction, parallax: of the extent; see `RaySteps` for the steps along rays.
        log_gains: (photos, 3) logarithms of the photos' initial exposures, NaN where unknown.
        log_focal: logarithm of the initial factor of focal lengths, if these are learned.
        cameras_from: the progress after which cameras learn, see `Schedule`.
        points: pixels whose distance is known.
        sky: (pixels,) bool, the pixels of the pool that show a sky to be learned; None if none are known.
        size: of the field; by default, `sizes.chosen_size` for the settings and the pool.
    """

    def __init__(
        self,
        pool: Pool,
        marching: Marching,
        *,
        contraction: str,
        parallax: float = 1.0,
        settings: TrainSettings,
        log_gains: Tensor | None = None,
        log_focal: float = 0.0,
        cameras_from: float = 0.0,
        points: PointRays | None = None,
        sky: Tensor | None = None,
        size: FieldSettings | None = None,
    ):
        device = pool.colours.device
        torch.manual_seed(settings.seed)
        self.pool = pool
        self.marching = marching
        self.settings = settings
        self.step = 0
        # The largest fraction of any budget so far: a training resumed with a larger budget begins at a smaller one.
        self.largest_fraction = 0.0
        self.components = settings.components
        if size is None:
            size = chosen_size(
                settings.field,
                hash_grid=HashFieldSettings(
                    contraction=contraction,
                    log2_rows=settings.chosen_log2_rows,
                    view_degree=self.components.view,
                    antialias=self.components.antialias,
                ),
                footprint=pool.footprint,
                memory_bytes=settings.field_memory_bytes,
            )
        self.field = fresh_field(size).to(device)
        gains = torch.full((len(pool.first_pixel), 3), torch.nan) if log_gains is None else log_gains
        self.points = points
        self.appearance = Appearance(self.components, pool, log_gains=gains, log_focal=log_focal)
        self.schedule = Schedule(
            settings,
            parallax,
            learns_cameras=self.appearance.cameras is not None,
            cameras_from=cameras_from,
            has_large_table=self.field.settings.detailed,
            closing_steps=self.field.closing_steps,
        )
        self.cells = OpenCells(self.field, device)
        if sky is not None:
            self.appearance.init_background_from_sky(sky)
        self.ray_steps = RaySteps(marching, self.field.settings, parallax=parallax, device=device)
        rows = self.field.rows()
        most_rays = MOST_RAYS if rows is None else max(MOST_RAYS, rows.shape[-2] // ROWS_PER_RAY)
        self._most_rays = most_rays if device.type == "cpu" else max(most_rays, settings.samples_per_step // 4)
        self.generator = torch.Generator(device=device).manual_seed(settings.seed)
        self.optimiser = FieldOptimiser(self.field)
        self.parts_optimiser = PartsOptimiser(self.appearance.groups())
        self.samples_per_ray = float(self.ray_steps.most)
        self.rate_factor, self.rollbacks = 1.0, 0
        self.in_step = False
        self.loss: float | None = None  # the last one that was read
        self._losses = Delayed()

    def advance(self, fraction: float, watch: Watch = UNWATCHED) -> StepResult:
        """Take one optimiser step.

        Args:
            fraction: of the budget that is used, in [0, 1], see `Schedule.at`.
            watch: observes the tensors of the step, and the state before and after it.

        Raises:
            NonFiniteError: the loss or a gradient of the weights is not finite; on a GPU, possibly that of the previous
                step. The state is then incomplete.
        """
        self.in_step = True
        watch.state(self.state)
        self.largest_fraction = max(self.largest_fraction, fraction)
        plan = self.schedule.at(fraction, step=self.step, furthest=self.largest_fraction)
        drawn = self.appearance.with_learning_rays(self.draw(plan), plan.cameras.rate)
        rays = len(drawn.origins)
        loss, losses, samples = self._loss(drawn, plan, watch=watch)
        self.optimiser.zero_grad()
        self.parts_optimiser.zero_grad()
        if samples > 0:
            loss.backward()
        samples = self._add_up_gradients(drawn, samples)
        losses = distributed.whole(losses, rays)
        value = self._finite_loss(loss, drawn, watch)
        rate = self.learning_rate(plan)
        self.step += 1
        self.optimiser.step(self.step, rate, decay=self.row_decay(rays))
        self.parts_optimiser.step(rate)
        if self.appearance.cameras is not None:
            self.appearance.cameras.step(drawn, losses, plan.cameras, factor=self.rate_factor)
        self.samples_per_ray += 0.2 * (samples / rays - self.samples_per_ray)
        watch.state(self.state)
        self.in_step = False
        return StepResult(loss=value, samples=samples, rays=rays)

    @property
    def plan(self) -> StepPlan:
        """The plan at the largest progress so far, for pictures of the field."""
        return self.schedule.at(self.largest_fraction, step=self.step, furthest=self.largest_fraction)

    def draw(self, plan: StepPlan) -> PixelBatch:
        """Return the pixels of the next step; refresh the open cells first if it is time."""
        settings = self.settings
        self.cells.refresh(
            self.step,
            threshold=plan.threshold,
            detail=plan.detail,
            marching=self.marching,
            generator=self.generator,
        )
        rays = min(self._most_rays, max(64, round(settings.samples_at(self.step) / max(1.0, self.samples_per_ray))))
        drawn = self.pool.draw(rays, self.generator)
        if self.points is None or plan.point_weight == 0.0:
            return drawn
        return self.points.added_to(drawn, self.generator)

    def smaller_steps(self) -> None:
        """Halve the learning rate from now on, because numbers became non-finite."""
        self.rate_factor /= 2
        self.rollbacks += 1

    def learning_rate(self, plan: StepPlan) -> float:
        """Return the learning rate of a step, halved by every call of `smaller_steps` so far."""
        return self.rate_factor * plan.learning_rate

    def row_decay(self, rays: int) -> float:
        """Return the weight decay of rows beside the mean loss of a step's rays.

        In photos that fill the frame, decay keeps space empty that few of them look into. Photos with alpha tell what
        is empty, and decay only blurs. There it shrinks as steps grow, like the gradient of a row that one ray touches:
        otherwise fields of long trainings get no sharper after a few minutes.
        """
        return self.field.row_decay * (min(1.0, DECAY_RAYS / rays) if self.pool.has_alpha else 1.0)

    def _loss(self, whole: PixelBatch, plan: StepPlan, *, watch: Watch) -> tuple[Tensor, Tensor, int]:
        """Return the loss that this process's rays contribute to that of the whole step, the colour loss of each of
        these rays, and their number of samples.
        """
        count, components, device = len(whole.origins), self.components, whole.origins.device
        drawn = PixelBatch(*(distributed.own(rows, count) for rows in whole))
        jitter = distributed.own(torch.rand(count, generator=self.generator, device=device), count)
        background = distributed.own(self.appearance.behind(count, self.generator), count)
        edges = self.ray_steps.edges(plan.stride)
        seen = self.field.backend.render_rays(
            Rays(drawn.origins, drawn.directions, jitter, self._cones(drawn)),
            self._march(edges, self.cells.at(self.step))._replace(least_weight=LEAST_WEIGHT),
            self.field.medium(plan.detail),
            Targets(self.ray_steps.nearest if components.near else None, bool(components.distortion), drawn.distances),
            background=background,
            table_grad=self.optimiser.table_grad,
            cell_depths=self.cells.cell_depths,
            trace=watch.rows,
        )
        rendered, measured = self.appearance.compared(seen.rgb, seen.transmittance, drawn, behind=background)
        losses = colour_losses(rendered, measured)
        loss = losses.sum() / count
        if components.distortion:
            loss = loss + components.distortion * (seen.distortion.sum() / count)
        if len(whole.distances):
            of_distances = emerging_losses(seen.depth_loss) if plan.are_emerging else seen.depth_loss
            losses_of_distances, weight = drawn.trust * of_distances, components.points * plan.point_weight
            loss = loss + weight * (losses_of_distances.sum() / len(whole.distances))
        if self.appearance.sky is not None:
            opacity = (1.0 - seen.transmittance) * self.appearance.sky[drawn.numbers]
            loss = loss + SKY_WEIGHT * opacity.sum() / count
        if self.appearance.background is not None:
            loss = loss + ROUGHNESS_WEIGHT * self.appearance.background.roughness() / distributed.count()
        if watch is not UNWATCHED:
            watch.rows("rendered colour", seen.rgb, torch.arange(len(drawn.origins), device=device))
        watch.values("loss", loss)
        return loss, losses.detach(), int(seen.samples)

    @torch.no_grad()
    def compare(self, drawn: PixelBatch) -> tuple[Tensor, Tensor]:
        """Return the model's and the photos' colours of pixels, both (N, 3) sRGB, alpha on white."""
        drawn = self.appearance.refine_cameras(drawn)
        behind = torch.full_like(drawn.origins, 1.0 if self.pool.has_alpha else 0.0)
        edges = self.ray_steps.edges(self.plan.stride)
        rendered, transmittance = self._seen(drawn, edges=edges, behind=behind)
        return self.appearance.compared(rendered, transmittance, drawn, behind=behind)

    @torch.no_grad()
    def light_from_beyond(self, drawn: PixelBatch, *, distance: float) -> Tensor:
        """Return the fraction of each pixel's light, (N,), that comes from beyond a distance in the current field."""
        drawn = self.appearance.refine_cameras(drawn)
        edges = self.ray_steps.edges(self.plan.stride)
        near = edges[: max(2, int(torch.searchsorted(edges, distance, right=True)))]
        return self._seen(drawn, edges=near, behind=torch.zeros_like(drawn.origins))[1]

    def _seen(self, drawn: PixelBatch, *, edges: Tensor, behind: Tensor) -> tuple[Tensor, Tensor]:
        """Return the colours (N, 3) of rays stepping from edge to edge, over `behind`, and their transmittance (N,)."""
        jitter = torch.full_like(drawn.origins[:, 0], 0.5)
        seen = self.field.backend.render_rays(
            Rays(drawn.origins, drawn.directions, jitter, self._cones(drawn)),
            self._march(edges, self.cells.coarse),
            self.field.medium(self.plan.detail),
            background=behind,
        )
        return seen.rgb, seen.transmittance

    def _march(self, edges: Tensor, occupied: Tensor) -> March:
        return March(edges, occupied, self.field.settings.contraction, DEEPEST)

    def _cones(self, drawn: PixelBatch) -> Tensor | None:
        """Return the pixel widths per unit of distance if the field is antialiased, else None."""
        return self.pool.cones[self.pool.photo_of(drawn.numbers)] if self.components.antialias else None

    def _add_up_gradients(self, drawn: PixelBatch, samples: int) -> int:
        """Add up the gradients and the samples of all processes, and return the number of samples."""
        samples = distributed.total(samples)
        if samples > 0:
            rays = (drawn.origins, drawn.directions)
            distributed.add_up_gradients((*self.optimiser.weights(), *self.appearance.parameters(), *rays))
            if self.optimiser.table_grad is not None:
                distributed.add_up(self.optimiser.table_grad)
        return samples

    def settle(self) -> None:
        """Read the loss of the last step if it is still pending on a GPU.

        Raises:
            NonFiniteError: as for `advance`.
        """
        self._take_loss(self._losses.take())

    def _take_loss(self, numbers: tuple[Tensor, ...] | None) -> None:
        if numbers is not None:
            value, summed = numbers[0].tolist()
            if not math.isfinite(summed):
                raise NonFiniteError
            self.loss = value

    def _finite_loss(self, loss: Tensor, drawn: PixelBatch, watch: Watch) -> float:
        """Return the loss if it and all gradients are finite; on a GPU usually that of the previous step."""
        rays = {"origins of rays": drawn.origins.grad, "directions of rays": drawn.directions.grad}
        of_rays = {name: gradient for name, gradient in rays.items() if gradient is not None}
        gradients = {**self.optimiser.gradients(), **self.appearance.gradients(), **of_rays}
        for name, gradient in gradients.items():
            watch.values(f"gradient of {name}", gradient)
        # Non-finite if any term is. One sum of all is faster on a GPU than many small ones.
        total = torch.cat([loss.detach().view(1), *(gradient.flatten() for gradient in gradients.values())]).sum()
        if self.optimiser.table_grad is not None:
            watch.values("gradient of rows", self.optimiser.table_grad)
        numbers = torch.stack([loss.detach(), total])
        distributed.add_up(numbers)
        self._take_loss(self._losses.exchange(numbers))
        if self.loss is None or watch is not UNWATCHED:
            self.settle()
        assert self.loss is not None
        return self.loss

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return everything that `restore` needs to continue bit for bit."""
        tensors = {
            **{f"field.{name}": tensor for name, tensor in self.field.state_dict().items()},
            "generator": self.generator.get_state(),
            **self.cells.state(),
            **self.optimiser.state(),
        }
        tensors.update({f"parts.{name}": value for name, value in self.appearance.state_dict().items()})
        tensors.update(self.parts_optimiser.state())
        return tensors, {
            "field": self.field.settings.to_json(),
            "step": self.step,
            "samples_per_ray": self.samples_per_ray,
            "rate_factor": self.rate_factor,
            "rollbacks": self.rollbacks,
            "furthest": self.largest_fraction,
        }

    def restore(self, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self._losses.forget()
        if self.appearance.cameras is not None:
            self.appearance.cameras.sent.forget()
        self.field.load_state_dict(
            {name.removeprefix("field."): value for name, value in tensors.items() if name.startswith("field.")}
        )
        self.generator.set_state(tensors["generator"].cpu())
        self.cells.restore(tensors)
        self.optimiser.restore(tensors)
        self.appearance.load_state_dict({name: tensors[f"parts.{name}"] for name in self.appearance.state_dict()})
        self.parts_optimiser.restore(tensors)
        self.step = description["step"]
        self.samples_per_ray = description["samples_per_ray"]
        self.rate_factor, self.rollbacks = description["rate_factor"], description["rollbacks"]
        self.largest_fraction = description.get("furthest", 1.0)  # earlier versions learned all detail from the start
        self.in_step = False
