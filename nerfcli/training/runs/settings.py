"""Settings of a training."""

import dataclasses
import math
import statistics
from bisect import bisect
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from nerfcli.cameras.camera import Camera
from nerfcli.errors import UserError
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.kinds import KINDS
from nerfcli.kernels import CONTRACTIONS
from nerfcli.training.runs.components import Components

DOWNSCALES = (1, 2, 4, 8)
# `--downscale auto` takes the largest pictures whose longer side is at most this many pixels.
AUTO_LONGER_SIDE_PX = 800
# Target numbers of samples of the first step and at most. Small steps do not keep a GPU busy.
CPU_SAMPLES, GPU_SAMPLES = (2**13, 2**16), (2**16, 2**18)
# Number of steps in which the samples per step double. Small steps learn more per sample at first, so short trainings
# have many of them; later, large steps are better and cost less per sample.
DOUBLING_STEPS = 600
# Expected number of samples per second and CPU thread, for trainings with a time budget.
SAMPLES_PER_SECOND = 1e6
# Short trainings learn more with few rows, each of which is seen often; long ones need more rows for the detail in the
# photos. The number of rows doubles at each of these numbers of samples. With 2^19 rows, the file of a field has 68 MB
# and a step is an eighth slower than with 2^18.
FEWEST_LOG2_ROWS, DOUBLE_ROWS_FROM = 16, (37e6, 74e6, 400e6)
# A GPU has room for large tables.
GPU_LOG2_ROWS = 19


@dataclass(frozen=True)
class TrainSettings:
    """Settings of a training.

    Args:
        budget_seconds: training time, without loading and held-out checks; None for no limit.
        steps: total number of optimiser steps, including those before a resume; None for no limit.
        downscale: photos are averaged over squares of this many pixels; None for automatic.
        contraction: mapping of space to the unit cube of the field, see `kernels.contraction`; None for automatic:
            "none" for photos of an object with alpha or before a plain background, "l2" for others.
        seed: seed of all random numbers.
        device: a torch device name.
        first_samples_per_step, samples_per_step: target number of field samples of a step, at the start and at most;
            determines the number of rays. Small steps learn more per sample, large ones cost less per sample. None for
            the usual ones of the device, see `samples`.
        learning_rate, final_learning_rate: learning rate of Adam at the start and at the end of the budget.
        warmup_steps: steps over which the learning rate rises from 0.
        log2_rows: size of a hash grid, see `HashFieldSettings`; None for automatic, see `chosen_log2_rows`.
        components: components of the model and of its loss.
        field: kind of field, one of `kinds.KINDS`.
        field_memory_bytes: memory limit of the field's numbers; None for the default of the kind, see
            `kinds.chosen_size`.
        model: "default" uses the components as given, "auto" selects those that are not `fixed` for the scene, see
            `selection`.
        fixed: names of components that the user has chosen.

    Raises:
        UserError: no limit or a non-positive one, or another setting that is invalid or cannot be combined.
    """

    budget_seconds: float | None = 120.0
    steps: int | None = None
    downscale: int | None = None
    contraction: str | None = None
    seed: int = 0
    device: str = "cpu"
    threads: int = 1
    first_samples_per_step: int | None = None
    samples_per_step: int | None = None
    learning_rate: float = 1e-2
    final_learning_rate: float = 1e-3
    warmup_steps: int = 50
    log2_rows: int | None = None
    components: Components = dataclasses.field(default_factory=Components)
    field: str = HashFieldSettings.kind
    field_memory_bytes: int | None = None
    model: str = "default"
    fixed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.log2_rows is not None and not 4 <= self.log2_rows <= 24:
            raise UserError(f"invalid size of the field: log2-rows {self.log2_rows}", "it must be between 4 and 24")
        if self.budget_seconds is None and self.steps is None:
            raise UserError(
                "no stopping criterion: neither --budget nor --steps is given", "give --budget, --steps, or both"
            )
        if any(limit is not None and limit <= 0 for limit in (self.budget_seconds, self.steps)):
            raise UserError("the training budget must be positive", "for example --budget 2m or --steps 2000")
        if self.downscale not in (None, *DOWNSCALES):
            raise UserError(f"invalid downscale factor {self.downscale}", "choose auto, 1, 2, 4 or 8")
        if self.field not in KINDS:
            raise UserError(f"unknown type of field: {self.field!r}", f"choose {', '.join(KINDS)}")
        if self.components.antialias and self.field != HashFieldSettings.kind:
            message = f"--with antialias does not work with --field {self.field}: it needs the levels of a hash grid"
            raise UserError(message, "use --field hash, or remove --with antialias", 2)
        if self.components.stereo and not self.components.points and (self.model != "auto" or "points" in self.fixed):
            raise UserError(
                "--with stereo needs points: it adds to their pixels", "add --with points, or remove --with stereo", 2
            )
        if self.contraction not in (None, *CONTRACTIONS):
            raise UserError(f"unknown contraction {self.contraction!r}", f"choose auto, {', '.join(CONTRACTIONS)}")

    @property
    def samples(self) -> tuple[int, int]:
        """Target numbers of samples of the first step and at most: as given, or the usual ones of the device."""
        first, most = GPU_SAMPLES if self.on_gpu else CPU_SAMPLES
        most = self.samples_per_step or most
        return min(self.first_samples_per_step or first, most), most

    @property
    def may_have_occluders(self) -> bool:
        """Whether pixels may be left out where something hides the scene."""
        return self.components.occluders or (self.model == "auto" and "occluders" not in self.fixed)

    @property
    def on_gpu(self) -> bool:
        """Whether the device is a GPU."""
        return self.device.startswith("cuda")

    def samples_at(self, step: float) -> float:
        """Return the target number of samples of a step; the first is step 0."""
        first, most = self.samples
        return min(most, 2.0 ** min(step / DOUBLING_STEPS, 16) * first)  # finite for any step

    @property
    def expected_samples(self) -> float:
        """Approximate number of samples of the whole training, the lesser of those by steps and by time and threads."""
        by_steps, by_time = math.inf, math.inf
        first, most = self.samples
        if self.steps is not None:
            rising = min(self.steps, DOUBLING_STEPS * math.log2(most / first))
            rise = DOUBLING_STEPS / math.log(2) * (self.samples_at(rising) - self.samples_at(0))
            by_steps = rise + (self.steps - rising) * most
        if self.budget_seconds is not None:
            by_time = SAMPLES_PER_SECOND * self.threads * self.budget_seconds
        return min(by_steps, by_time)

    @property
    def expected_steps(self) -> float:
        """Number of steps with about `expected_samples`."""
        first, most = self.samples
        doubling = DOUBLING_STEPS / math.log(2.0)
        rising = DOUBLING_STEPS * math.log2(most / first)
        beyond = self.expected_samples - doubling * (self.samples_at(rising) - self.samples_at(0))
        if beyond >= 0.0:
            return rising + beyond / most
        return doubling * math.log1p(self.expected_samples / (doubling * self.samples_at(0)))

    @property
    def chosen_log2_rows(self) -> int:
        """Binary logarithm of the rows of each table: as given, or chosen by the device and the training's length."""
        if self.log2_rows is not None:
            return self.log2_rows
        if self.on_gpu:
            return GPU_LOG2_ROWS
        return FEWEST_LOG2_ROWS + bisect(DOUBLE_ROWS_FROM, self.expected_samples)

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "fixed": list(self.fixed)}

    def facts(self) -> dict[str, Any]:
        """Return the settings for the user: those of `to_json`, with the samples of a step that they stand for."""
        first, most = self.samples
        return {**self.to_json(), "first_samples_per_step": first, "samples_per_step": most}

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "TrainSettings":
        """Read the content that `to_json` returned."""
        components, fixed = Components(**content["components"]), tuple(content["fixed"])
        entries: dict[str, Any] = {**content, "components": components, "fixed": fixed}
        return cls(**entries)


def automatic_downscale(cameras: Sequence[Camera]) -> int:
    """Return the smallest downscale that brings the longer side to `AUTO_LONGER_SIDE_PX` or below; twice that for
    panoramas, which show more with as many pixels. Of photos of several sizes, it is that of the median.
    """
    return statistics.median_high(map(_fitting_downscale, cameras))


def _fitting_downscale(camera: Camera) -> int:
    most = 2 * AUTO_LONGER_SIDE_PX if camera.is_spherical else AUTO_LONGER_SIDE_PX
    fitting = (factor for factor in DOWNSCALES if max(camera.width, camera.height) / factor <= most)
    return next(fitting, DOWNSCALES[-1])
