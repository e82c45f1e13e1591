"""One training: the field, its occupancy and its optimiser, advanced step by step."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfcli import distributed
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.kinds import chosen_size, fresh_field
from nerfcli.training.appearance import Appearance
from nerfcli.training.extent import Extent, RaySteps
from nerfcli.training.losses import LOSSES
from nerfcli.training.open_cells import OpenCells
from nerfcli.training.optimiser import Delayed, FieldOptimiser, PartsOptimiser
from nerfcli.training.pool import PixelBatch, PixelPool, PointRays
from nerfcli.training.runs.components import Selection
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import Schedule, StepPlan
from nerfcli.training.step import UNWATCHED, Batch, NonFiniteError, StepLosses, Watch, step, update
from nerfcli.training.storage import IN_MEMORY, PhotoStorage

# Rays of a step, at most. The optimiser takes longer with larger tables, for any number of rays: there is one more ray
# for this many rows of a level.
MOST_RAYS, ROWS_PER_RAY = 2**14, 2**5


@dataclass(frozen=True)
class StepResult:
    """Result of one step: its weighted losses (on a GPU, those of the previous step), numbers of samples and rays."""

    losses: dict[str, float]
    samples: int
    rays: int

    @property
    def loss(self) -> float:
        """The sum of the losses."""
        return sum(self.losses.values())


@dataclass(frozen=True)
class TrainingInputs:
    """What a training begins from, see `preparation.prepare`. The settings' components decide what of it they use.

    Args:
        settings: with the components that were chosen.
        extent: of the field.
        pool: the training pixels and their rays.
        log_gains: (photos, 3) logarithms of the photos' initial exposures, NaN where unknown; None if all are.
        log_focal: logarithm of the initial factor of focal lengths, if these are learned.
        points: pixels whose distance is known; None if there are none.
        sky: (pixels,) bool, the pixels of the pool that look like a sky; None if none are known.
        factor: photos are averaged over squares of this side in pixels.
        storage: where arrays of the size of the photos are kept.
        selection: result of the automatic selection of components; None if there was none.
        log_exposure: mean log exposure of the training photos by EXIF, to which those in `log_gains` are relative; None
            if unknown or not used.
        occluders: for each photo of the pool the mask (height, width) bool of the pixels that are left out because
            something hides a surface there; None if the components keep them.
        attached: the masks of what is attached to the camera, by the names of photos, held-out ones too; empty if
            nothing is. The pool is without these pixels.
        seconds: seconds of the budget spent on evidence and trials, by name.
    """

    settings: TrainSettings
    extent: Extent
    pool: PixelPool
    log_gains: Tensor | None = None
    log_focal: float = 0.0
    points: PointRays | None = None
    sky: Tensor | None = None
    factor: int = 1
    storage: PhotoStorage = IN_MEMORY
    selection: Selection | None = None
    log_exposure: float | None = None
    occluders: list[np.ndarray] | None = None
    attached: Mapping[str, np.ndarray] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)


class Fitting:
    """The state of a training. On a CPU, the same seed and thread count give the same numbers, step for step.

    Args:
        cameras_from: the progress after which cameras learn, see `Schedule`.
        size: of the field; by default, `kinds.chosen_size` for the settings and the pool.
    """

    def __init__(self, inputs: TrainingInputs, *, cameras_from: float = 0.0, size: FieldSettings | None = None):
        pool, settings = inputs.pool, inputs.settings
        components, device = settings.components, pool.colours.device
        torch.manual_seed(settings.seed)
        self.pool, self.settings, self.components = pool, settings, components
        sky = inputs.sky if components.background == "sphere" else None
        self.extent = inputs.extent.before(components.background, sky_known=sky is not None)
        self.step = 0
        # The largest progress of any budget so far: a training resumed with a larger budget begins at a smaller one.
        self.furthest = 0.0
        if size is None:
            size = chosen_size(
                settings.field,
                hash_grid=HashFieldSettings(
                    contraction=self.extent.contraction,
                    log2_rows=settings.chosen_log2_rows,
                    view_degree=components.view,
                    antialias=components.antialias,
                ),
                footprint=pool.footprint,
                memory_bytes=settings.field_memory_bytes,
            )
        self.field = fresh_field(size).to(device)
        self.points = inputs.points if components.distance_weight else None
        gains = inputs.log_gains
        gains = torch.full((len(pool.first_pixel), 3), torch.nan) if gains is None else gains
        self.appearance = Appearance(components, pool, log_gains=gains, log_focal=inputs.log_focal)
        self.schedule = Schedule(settings, self.extent.parallax, cameras_from, self.field.settings)
        self.cells = OpenCells(self.field, self.extent.marching, device)
        if sky is not None:
            self.appearance.init_background_from_sky(sky)
        self.ray_steps = RaySteps(self.extent, self.field.settings, device)
        rows = self.field.rows()
        most_rays = MOST_RAYS if rows is None else max(MOST_RAYS, rows.shape[-2] // ROWS_PER_RAY)
        self._most_rays = most_rays if device.type == "cpu" else max(most_rays, settings.samples[1] // 4)
        self.generator = torch.Generator(device=device).manual_seed(settings.seed)
        self.optimiser = FieldOptimiser(self.field)
        self.parts_optimiser = PartsOptimiser(self.appearance.groups())
        self.samples_per_ray = float(self.ray_steps.most)
        self.rate_factor, self.rollbacks = 1.0, 0
        self.in_step = False
        self.losses: dict[str, float] = {}  # the last ones that were read
        self._sent = Delayed()

    def advance(self, progress: float, watch: Watch = UNWATCHED) -> StepResult:
        """Take one optimiser step.

        Args:
            progress: used fraction of the budget, in [0, 1], see `Schedule.at`.
            watch: observes the tensors of the step, and the state before and after it.

        Raises:
            NonFiniteError: the loss or a gradient of the weights is not finite; on a GPU, possibly that of the previous
                step. The state is then incomplete.
        """
        self.in_step = True
        watch.state(self.state)
        self.furthest = max(self.furthest, progress)
        plan = self.schedule.at(progress, step=self.step, furthest=self.furthest)
        whole = self._batch(self.draw(plan), plan)
        own = whole.part(lambda rows: distributed.own(rows, whole.rays))
        losses = self._of_all(step(self, own, plan, watch), whole)
        self._check(losses, whole, watch)
        update(self, whole, losses, plan, rate_factor=self.rate_factor)
        self.step += 1
        self.samples_per_ray += 0.2 * (losses.samples / whole.rays - self.samples_per_ray)
        watch.state(self.state)
        self.in_step = False
        return StepResult(self.losses, losses.samples, whole.rays)

    @property
    def plan(self) -> StepPlan:
        """The plan at the largest progress so far, for pictures of the field."""
        return self.schedule.at(self.furthest, step=self.step, furthest=self.furthest)

    def draw(self, plan: StepPlan) -> PixelBatch:
        """Return the pixels of the next step; refresh the open cells first if it is time."""
        self.cells.refresh(self.step, threshold=plan.threshold, detail=plan.detail, generator=self.generator)
        rays = min(self._most_rays, max(64, round(plan.samples / max(1.0, self.samples_per_ray))))
        drawn = self.pool.draw(rays, self.generator)
        if self.points is None or "points" not in plan.weights:
            return drawn
        return self.points.added_to(drawn, self.generator)

    def smaller_steps(self) -> None:
        """Halve the learning rate from now on, because numbers became non-finite."""
        self.rate_factor /= 2
        self.rollbacks += 1

    def _batch(self, drawn: PixelBatch, plan: StepPlan) -> Batch:
        """Return the rays of a step: those of the current cameras through the pixels drawn for it."""
        count = len(drawn.origins)
        return Batch(
            self.appearance.with_learning_rays(drawn, plan.cameras.rate),
            jitter=torch.rand(count, generator=self.generator, device=drawn.origins.device),
            behind=self.appearance.behind(count, self.generator),
            rays=count,
            points=len(drawn.distances),
        )

    def _of_all(self, losses: StepLosses, whole: Batch) -> StepLosses:
        """Add up what all processes have found, each from its rays: losses, gradients and the number of samples."""
        rays = whole.pixels.origins, whole.pixels.directions
        weighted, colours, samples = distributed.add_up_step(
            losses.weighted,
            losses.colours,
            losses.samples,
            rays=whole.rays,
            leaves=(*self.optimiser.weights(), *self.appearance.parameters(), *rays),
            table_grad=self.field.table_grad,
        )
        return StepLosses(weighted, colours, samples)

    def settle(self) -> None:
        """Read the loss of the last step if it is still pending on a GPU; raises as `advance` does."""
        self._take_losses(self._sent.take())

    def _check(self, losses: StepLosses, whole: Batch, watch: Watch) -> None:
        """Check that the loss and all gradients are finite; on a GPU usually those of the previous step."""
        rays = {"origins of rays": whole.pixels.origins.grad, "directions of rays": whole.pixels.directions.grad}
        of_rays = {name: gradient for name, gradient in rays.items() if gradient is not None}
        gradients = {**self.optimiser.gradients(), **self.appearance.gradients(), **of_rays}
        for name, gradient in gradients.items():
            watch.values(f"gradient of {name}", gradient)
        # Non-finite if any term is. One sum of all is faster on a GPU than many small ones.
        loss = losses.sum()
        total = torch.cat([loss.view(1), *(gradient.flatten() for gradient in gradients.values())]).sum()
        if self.field.table_grad is not None:
            watch.values("gradient of rows", self.field.table_grad)
        absent = torch.zeros_like(loss)
        weighted = [losses.weighted.get(name, absent) for name in LOSSES]
        self._take_losses(self._sent.exchange(torch.stack([total, *weighted])))
        if not self.losses or watch is not UNWATCHED:
            self.settle()

    def _take_losses(self, numbers: tuple[Tensor, ...] | None) -> None:
        if numbers is not None:
            total, *losses = numbers[0].tolist()
            if not math.isfinite(total):
                raise NonFiniteError
            self.losses = dict(zip(LOSSES, losses, strict=True))

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
            "furthest": self.furthest,
        }

    def restore(self, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self._sent.forget()
        if self.appearance.cameras is not None:
            self.appearance.cameras.sent.forget()
        self.field.load_state_dict(
            {name.removeprefix("field."): value for name, value in tensors.items() if name.startswith("field.")}
        )
        random = tensors["generator"].cpu()
        if random.shape == self.generator.get_state().shape:  # else the checkpoint is from another type of device
            self.generator.set_state(random)
        self.cells.restore(tensors)
        self.optimiser.restore(tensors)
        self.appearance.load_state_dict({name: tensors[f"parts.{name}"] for name in self.appearance.state_dict()})
        self.parts_optimiser.restore(tensors)
        self.step = description["step"]
        self.samples_per_ray = description["samples_per_ray"]
        self.rate_factor, self.rollbacks = description["rate_factor"], description["rollbacks"]
        self.furthest = description["furthest"]
        self.in_step = False
