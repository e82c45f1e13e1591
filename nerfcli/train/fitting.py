"""One training: the field, its occupancy and its optimiser, advanced step by step."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.errors import NON_FINITE, UserError
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.render.model import Marching
from nerfcli.render.occupancy import Occupancy
from nerfcli.train.losses import colour_loss, over_background
from nerfcli.train.photos import PixelPool
from nerfcli.train.settings import TrainSettings

OCCUPANCY_SIDE = 64
REFRESH_EVERY = 8
REFRESH_SHARE = 1 / 8
MOST_RAYS = 2**14


@dataclass(frozen=True)
class StepResult:
    """What one step did: its loss, and how many samples and rays it took."""

    loss: float
    samples: int
    rays: int


class Fitting:
    """The state of a training. Same seed, threads and device give the same numbers, step for step."""

    def __init__(self, pool: PixelPool, marching: Marching, *, unbounded: bool, settings: TrainSettings):
        device = pool.colours.device
        torch.manual_seed(settings.seed)
        self.pool = pool
        self.marching = marching
        self.settings = settings
        self.field = HashField(HashFieldSettings(unbounded=unbounded)).to(device)
        self.occupancy = Occupancy(OCCUPANCY_SIDE, device)
        self.occupied = self.occupancy.occupied
        self.edges = marching.edges().to(device, torch.float32)
        self.generator = torch.Generator(device=device).manual_seed(settings.seed)
        self.optimiser = torch.optim.Adam(
            self.field.parameters(), lr=settings.learning_rate, betas=(0.9, 0.99), eps=1e-15, fused=True
        )
        self.step = 0
        self.samples_per_ray = float(len(self.edges) - 2)

    def advance(self, share: float) -> StepResult:
        """One optimiser step.

        Args:
            share: how much of the budget is used, in [0, 1]; it drives the learning rate.

        Raises:
            UserError: a loss or a gradient is not finite; the message names the tensor and the step.
        """
        settings = self.settings
        if self.step % REFRESH_EVERY == 0:
            self._refresh_occupancy()
        rays = min(MOST_RAYS, max(64, round(settings.samples_per_step / max(1.0, self.samples_per_ray))))
        origins, directions, colours = self.pool.draw(rays, self.generator)
        loss, samples = self._loss(origins, directions, colours)
        self.optimiser.zero_grad(set_to_none=True)
        if samples > 0:
            loss.backward()
        self._check_finite(loss)
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate(share)
        self.optimiser.step()
        self.step += 1
        self.samples_per_ray += 0.2 * (samples / rays - self.samples_per_ray)
        return StepResult(loss=loss.item(), samples=samples, rays=rays)

    def learning_rate(self, share: float) -> float:
        """Linear warm-up, then an exponential from the first to the final rate over the budget."""
        settings = self.settings
        decay = math.log(settings.final_learning_rate / settings.learning_rate)
        warmup = min(1.0, (self.step + 1) / settings.warmup_steps)
        return settings.learning_rate * warmup * math.exp(decay * min(1.0, share))

    def _loss(self, origins: Tensor, directions: Tensor, colours: Tensor) -> tuple[Tensor, int]:
        """Loss over some rays, and the number of samples it took."""
        device = origins.device
        jitter = torch.rand(len(origins), generator=self.generator, device=device)
        # What the field lets through is shown a random colour: only opacity explains a photo then.
        background = torch.rand(len(origins), 3, generator=self.generator, device=device)
        starts, ends, offsets = kernels.march(
            origins,
            directions,
            self.edges,
            jitter=jitter,
            occupied=self.occupied,
            unbounded=self.field.settings.unbounded,
        )
        rays = kernels.ray_indices(offsets)
        points = origins[rays] + directions[rays] * ((starts + ends) / 2)[:, None]
        density, rgb = self.field(points, directions[rays])
        rendered, _, _ = kernels.composite(density, rgb, ends - starts, offsets=offsets, background=background)
        return colour_loss(rendered, over_background(colours, background)), len(points)

    def _refresh_occupancy(self) -> None:
        # The whole grid once, after a warm-up in which everything is open; then a share at a time.
        if self.step == 0:
            return
        self.occupancy.refresh(
            self.field,
            share=1.0 if self.step == REFRESH_EVERY else REFRESH_SHARE,
            shortest_step=self.marching.shortest_step,
            growth=self.marching.growth,
            generator=self.generator,
        )
        self.occupied = self.occupancy.occupied

    def _check_finite(self, loss: Tensor) -> None:
        suspects = {"loss": loss, **{f"gradient of {n}": p.grad for n, p in self.field.named_parameters()}}
        for name, tensor in suspects.items():
            # A sum is non-finite if any term is, and costs one pass without a temporary.
            if tensor is not None and not math.isfinite(tensor.sum().item()):
                raise UserError(
                    f"{name} is not finite at step {self.step}",
                    "the last checkpoint is kept; try another --seed, and please report the scene",
                    NON_FINITE,
                )

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that `restore` needs to go on bit for bit, besides the field's own weights."""
        tensors = {"generator": self.generator.get_state(), "optical_depth": self.occupancy.optical_depth}
        for index, entry in self.optimiser.state_dict()["state"].items():
            tensors.update({f"adam.{index}.{name}": value for name, value in entry.items()})
        return tensors, {"step": self.step, "samples_per_ray": self.samples_per_ray}

    def restore(self, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
        """Take up what `state` gave; the field's weights are loaded by the caller."""
        self.generator.set_state(tensors["generator"].cpu())
        self.occupancy.optical_depth = tensors["optical_depth"]
        self.occupied = self.occupancy.occupied
        entries: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith("adam."):
                _, index, name = key.split(".")
                entries.setdefault(int(index), {})[name] = value
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": entries})
        self.step = description["step"]
        self.samples_per_ray = description["samples_per_ray"]
