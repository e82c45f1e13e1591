"""The schedule of a training: what its steps do at which progress; the step, rays, cells and cameras read it.

Progress is the used fraction of the budget, in [0, 1]. Where a number of steps decides as well, it stands beside it.
Elsewhere are the levels that a detail opens (`HashField`), and the samples of a step by its number (`TrainSettings`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, pi

import numpy as np

from nerfcli.training.runs.components import LEARNED_BACKGROUNDS, Components
from nerfcli.training.runs.settings import TrainSettings

# Learning rate: the warm-up ends by this progress at the latest, however few steps that is.
WARMUP_ENDS = 0.1
# Detail: after this many steps, fields of long trainings, with large tables, have the detail that other fields have at
# the end. A field whose cameras learn gets its detail later: cameras find their poses in a coarse field; a fine one
# learns to show each photo from its wrong pose.
LARGE_TABLE_STEPS, DETAIL_DELAY = 400, 0.125
# Steps along rays: until this progress, they are this many times as long as those of the capture, and then the
# shortest: the initial fog has no detail. Short trainings do not reach the detail and learn more from more rays: their
# progress is that of this many steps.
STRIDES, SHORTEST = ((0.05, 8), (0.15, 4), (0.4, 2), (0.5, 1)), 0
DETAILED_STEPS = 2500
# Open cells: rays skip cells whose optical depth per step is below a threshold: hardly any at first, when all of space
# is thin fog and surfaces are not known; then more and more, so that surfaces have to become compact. The last
# threshold is reached by this progress at the latest, however few steps that is.
FIRST_THRESHOLD, THRESHOLD, CLOSING_ENDS = 3e-4, 1e-2, 0.3
# Known distances: until this progress they are a log likelihood, which keeps thin surfaces. If it lasts until the end,
# it puts matter in the wrong place where few photos look.
EMERGING_ENDS = 0.3
# With a narrow baseline, known distances are less accurate than what the field has learned after this many steps.
NARROW_STEPS = 800
# Weights of the opacity of rays that see the sky, and of the roughness of a learned background.
SKY_WEIGHT, ROUGHNESS_WEIGHT = 0.1, 1e-6
# Cameras: until the first progress there is fog, from which cameras learn nothing; until the second, the rate rises.
# From the third to the fourth it falls to the last rate: the steps' noise averages out and the field can settle.
CAMERAS_START, CAMERAS_FULL, CAMERAS_FALL, CAMERAS_END, LAST_CAMERA_RATE = 0.1, 0.15, 0.5, 0.98, 0.03
# Rotations and translations look much alike, and an early field confuses them: poorly determined changes are damped
# strongly at first, and less between these values of progress.
DAMPING_PROGRESS, DAMPINGS = (0.2, 0.8), (1.0, 0.1)
# Cameras are held from the first value on, see `NewtonSteps.change`; before, it is not clear which errors they have.
HOLDING_PROGRESS, HOLDINGS = (0.2, 0.5), (1e-3, 0.05)


@dataclass(frozen=True)
class CameraPlan:
    """How cameras learn in a step: the fraction of a full step, 0 for none, and `NewtonSteps.change`'s two numbers."""

    rate: float
    damping: float
    holding: float


@dataclass(frozen=True)
class StepPlan:
    """What a step does at its progress.

    Args:
        step: number of steps before it.
        samples: target number of samples.
        learning_rate: of the field.
        detail: of the field, see `Field.medium`.
        stride: length of the steps along rays, as a multiple of those of the capture; `SHORTEST` for the shortest.
        threshold: optical depth per step below which cells are closed.
        weights: of the losses that count, by their names in `losses.LOSSES`; no pixels at known distances are drawn
            without a weight for "points".
        are_emerging: whether known distances are a log likelihood, see `emerging_losses`.
        cameras: how cameras learn.
    """

    step: int
    samples: float
    learning_rate: float
    detail: float
    stride: int
    threshold: float
    weights: Mapping[str, float]
    are_emerging: bool
    cameras: CameraPlan


@dataclass(frozen=True)
class Schedule:
    """The schedule of one training.

    Args:
        settings: first and final learning rate, and steps of the warm-up.
        parallax: of the capture, see `Extent`; below 1 with a narrow baseline.
        learns_cameras: whether cameras learn.
        cameras_from: the progress from which they do, for a training that goes on from one with fixed cameras.
        has_large_table: whether the field is one of long trainings.
        closing_steps: the steps after which open cells have the last threshold.
    """

    settings: TrainSettings
    parallax: float
    learns_cameras: bool
    cameras_from: float
    has_large_table: bool
    closing_steps: int

    def at(self, progress: float, *, step: int, furthest: float) -> StepPlan:
        """Return the plan of a step.

        Args:
            progress: used fraction of the budget.
            step: number of steps before it.
            furthest: the largest progress of any budget so far: a training that is resumed with a larger budget begins
                at a smaller one, and keeps its detail and its closed cells.
        """
        closed = min(1.0, max(step / self.closing_steps, furthest / CLOSING_ENDS))
        return StepPlan(
            step=step,
            samples=self.settings.samples_at(step),
            learning_rate=self.learning_rate(progress, step),
            detail=self.detail(furthest, step),
            stride=stride(progress, step),
            threshold=FIRST_THRESHOLD ** (1.0 - closed) * THRESHOLD**closed,
            weights=loss_weights(self.settings.components, point_weight(progress, step, self.parallax)),
            are_emerging=progress < EMERGING_ENDS,
            cameras=camera_plan(max(0.0, progress - self.cameras_from) / (1.0 - self.cameras_from)),
        )

    def learning_rate(self, progress: float, step: int) -> float:
        """Return the learning rate: linear warm-up, then half a cosine from the first to the final rate."""
        settings = self.settings
        left = 0.5 * (1.0 + cos(pi * min(1.0, progress)))
        rate = settings.final_learning_rate + left * (settings.learning_rate - settings.final_learning_rate)
        return min(1.0, max((step + 1) / settings.warmup_steps, progress / WARMUP_ENDS)) * rate

    def detail(self, furthest: float, step: int) -> float:
        """Return the progress whose detail the field has; cameras that learn late do not delay it."""
        if self.cameras_from > 0.0:
            return furthest
        if self.learns_cameras:
            return (1.0 - DETAIL_DELAY) * furthest - DETAIL_DELAY
        return min(1.0, max(furthest, step / LARGE_TABLE_STEPS)) if self.has_large_table else furthest


def stride(progress: float, step: int) -> int:
    """Return `StepPlan.stride`."""
    progress = min(progress, step / DETAILED_STEPS)
    return next((stride for until, stride in STRIDES if progress <= until), SHORTEST)


def loss_weights(components: Components, point_weight: float) -> dict[str, float]:
    """Return `StepPlan.weights`.

    Args:
        point_weight: of known distances, as a multiple of their component.
    """
    weights = {
        "colour": 1.0,
        "distortion": components.distortion,
        "points": components.points * point_weight,
        "sky": SKY_WEIGHT if components.background == "sphere" else 0.0,
        "roughness": ROUGHNESS_WEIGHT if components.background in LEARNED_BACKGROUNDS else 0.0,
    }
    return {name: weight for name, weight in weights.items() if weight}


def point_weight(progress: float, step: int, parallax: float) -> float:
    """Return the weight of known distances: linear from 1 to 0, with a narrow baseline also times min(1, 800 / step).

    Once there are surfaces, photos tell more; but without points, haze before them comes back where few photos look.
    """
    part = NARROW_STEPS / max(step, NARROW_STEPS) if parallax < 1.0 else 1.0
    return part * max(0.0, 1.0 - progress)


def camera_plan(progress: float) -> CameraPlan:
    """Return how cameras learn: the rate rises linearly, is constant, then decays exponentially."""
    if not CAMERAS_START < progress < CAMERAS_END:
        rate = 0.0
    elif progress < CAMERAS_FULL:
        rate = (progress - CAMERAS_START) / (CAMERAS_FULL - CAMERAS_START)
    else:
        rate = _between(progress, (CAMERAS_FALL, CAMERAS_END), (1.0, LAST_CAMERA_RATE))
    return CameraPlan(
        rate=rate,
        damping=_between(progress, DAMPING_PROGRESS, DAMPINGS),
        holding=_between(progress, HOLDING_PROGRESS, HOLDINGS) if progress > HOLDING_PROGRESS[0] else 0.0,
    )


def _between(progress: float, ends: tuple[float, float], values: tuple[float, float]) -> float:
    """Return the first value up to the first end, the second from the second on, exponential in between."""
    return float(np.exp(np.interp(progress, ends, np.log(values))))
