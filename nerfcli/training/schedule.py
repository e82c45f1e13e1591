"""The schedule of a training: how its budget is used, and what its steps do at which progress.

Progress is the used fraction of the budget, in [0, 1]. Where a number of steps decides as well, it stands beside it.
Everything that depends on either reads it here. `nerfcli train SCENE --dry-run` shows it as a table.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import cos, pi

import numpy as np

from nerfcli.field.interface import FieldSettings
from nerfcli.training.runs.components import LEARNED_BACKGROUNDS, Components
from nerfcli.training.runs.settings import TrainSettings

# Before the first step, of the budget: stereo matching may take this fraction, and the selection of components this
# one. A training by steps must give the same result on all machines: its stereo takes what 60 s on one thread allow.
STEREO_FRACTION, SEARCH_FRACTION, STEREO_SECONDS = 0.06, 0.15, 60.0
# Of the selection: photos may be matched for this fraction, and the start that all trials continue takes this one.
MATCHING_FRACTION, START_FRACTION = 0.5, 0.2
# A start with fewer steps tells nothing, and one with more no more. No machine takes the fewest in less time than this,
# and a vain attempt would cost the training time.
FEWEST_STEPS, MOST_START_STEPS, LEAST_START_SECONDS = 120, 250, 0.3
# A removal of a component saves only a little time in the training: its trials have to end within this fraction of the
# selection's time, and may take this one: 2 % of the training.
REMOVAL_FRACTION, REMOVAL_COST = 0.65, 0.13
# The start of trials ends at this progress of a short training of its own, and trials continue from there to its end.
FORK_PROGRESS = 0.6
# The schedule is shown at these values of progress.
SHOWN = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0)
# The field is kept at these values of progress, and measured on held-out pixels when the training is over.
WAYPOINTS = (0.25, 0.5, 0.75, 1.0)
# Learning rate: the warm-up ends by this progress at the latest, however few steps that is.
WARMUP_ENDS = 0.1
# Detail: a field has all of it after this progress; those of long trainings, with large tables, after half of this many
# steps. A field whose cameras learn gets it later: cameras find their poses in a coarse field; a fine one learns to
# show each photo from its wrong pose.
DETAILED_PROGRESS, LARGE_TABLE_STEPS, DETAIL_DELAY = 0.5, 400, 0.125
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


# At least this fraction of a time budget is for steps, however long the preparation took.
LEAST_FOR_STEPS = 0.1


@dataclass(frozen=True)
class Budget:
    """Seconds and steps that may be used; None for no limit."""

    seconds: float | None
    steps: int | None

    @classmethod
    def of(cls, settings: TrainSettings) -> "Budget":
        """Return the budget of a training."""
        return cls(settings.budget_seconds, settings.steps)

    def progress(self, step: int, seconds: float, *, before: float = 0.0) -> float:
        """Return the used fraction: the larger of that of steps and of time, without that `before` the first step."""
        by_time = 0.0
        if self.seconds:
            by_time = (seconds - before) / max(self.seconds - before, LEAST_FOR_STEPS * self.seconds)
        by_steps = step / self.steps if self.steps else 0.0
        return min(1.0, max(by_time, by_steps))

    def of_stereo(self, threads: int) -> tuple[float, int]:
        """Return the seconds that stereo matching may take, and the threads that it is assumed to have."""
        return (STEREO_SECONDS, 1) if self.seconds is None else (STEREO_FRACTION * self.seconds, threads)

    def of_search(self, used: float = 0.0) -> "Budget":
        """Return the budget of trials; some of its seconds are used already."""
        steps = None if self.steps is None else round(SEARCH_FRACTION * self.steps)
        return Budget(None if self.seconds is None else max(1e-3, SEARCH_FRACTION * self.seconds - used), steps)

    def of_start(self) -> "Budget":
        """Return the budget of the start of trials with this budget."""
        steps = MOST_START_STEPS if self.steps is None else min(round(START_FRACTION * self.steps), MOST_START_STEPS)
        return Budget(None if self.seconds is None else START_FRACTION * self.seconds, steps)

    @property
    def allows_trials(self) -> bool:
        """Whether a start of trials would be long enough."""
        part = START_FRACTION * SEARCH_FRACTION
        has_time = self.seconds is None or part * self.seconds >= LEAST_START_SECONDS
        return has_time and (self.steps is None or round(part * self.steps) >= FEWEST_STEPS)

    def allows_matching(self, seconds: float) -> bool:
        """Return whether photos may be matched in this time before the first step."""
        return self.seconds is None or seconds <= MATCHING_FRACTION * SEARCH_FRACTION * self.seconds


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
        settings: learning rates, samples, and components.
        parallax: of the capture, see `Extent`; below 1 with a narrow baseline.
        cameras_from: the progress at which cameras start to learn, for a training that goes on from one with fixed
            cameras.
        field: kind and size.
    """

    settings: TrainSettings
    parallax: float
    cameras_from: float
    field: FieldSettings

    def at(self, progress: float, *, step: int, furthest: float) -> StepPlan:
        """Return the plan of a step.

        Args:
            progress: used fraction of the budget.
            step: number of steps before it.
            furthest: the largest progress of any budget so far: a training that is resumed with a larger budget begins
                at a smaller one, and keeps its detail and its closed cells.
        """
        components = self.settings.components
        closed = min(1.0, max(step / self.field.closing_steps, furthest / CLOSING_ENDS))
        # Photos do not improve on the distances of a sensor: these keep their weight.
        of_points = 1.0 if components.sensor else point_weight(progress, step, self.parallax)
        return StepPlan(
            step=step,
            samples=self.settings.samples_at(step),
            learning_rate=self.learning_rate(progress, step),
            detail=self.detail(furthest, step),
            stride=stride(progress, step),
            threshold=FIRST_THRESHOLD ** (1.0 - closed) * THRESHOLD**closed,
            weights=loss_weights(components, of_points),
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
        """Return the detail of the field, 1 or more for all; cameras that learn late do not delay it."""
        if self.cameras_from == 0.0 and self.settings.components.cameras != "fixed":
            furthest = (1.0 - DETAIL_DELAY) * furthest - DETAIL_DELAY
        elif self.cameras_from == 0.0 and self.field.detailed:
            furthest = min(1.0, max(furthest, step / LARGE_TABLE_STEPS))
        return furthest / DETAILED_PROGRESS

    def plans(self) -> list[tuple[float, StepPlan]]:
        """Return the plans of steps throughout a training, each with its progress."""
        steps = self.settings.expected_steps
        return [(progress, self.at(progress, step=round(progress * steps), furthest=progress)) for progress in SHOWN]


# What the table of a schedule does not show.
NOTES = (
    f"before the first step: stereo matching for up to {100 * STEREO_FRACTION:.0f} % of the budget, trials for up to "
    f"{100 * SEARCH_FRACTION:.0f} %",
    "the losses on points, sky and roughness apply only if these components are on; log marks a log-likelihood loss",
    "if cameras are refined, the finer levels start to learn later",
)


def table_of(plans: Sequence[tuple[float, StepPlan]]) -> tuple[list[str], list[list[str]]]:
    """Return plans as a table: the titles of its columns, values of the progress, and a row for each quantity."""

    def row(title: str, cell: Callable[[StepPlan], str]) -> list[str]:
        return [title, *(cell(plan) for _, plan in plans)]

    names = dict.fromkeys(name for _, plan in plans for name in plan.weights)
    rows = [
        row("steps before", lambda plan: f"{plan.step:,}"),
        row("samples of a step", lambda plan: f"{plan.samples:,.0f}"),
        row("learning rate", lambda plan: f"{plan.learning_rate:.4f}"),
        row("finer levels that learn", lambda plan: f"{100.0 * min(1.0, max(0.0, plan.detail)):.0f} %"),
        row("steps along rays", lambda plan: "shortest" if plan.stride == SHORTEST else f"{plan.stride} x"),
        row("closed cells", lambda plan: f"< {plan.threshold:.2g}"),
        *(row(f"weight of {name}", functools.partial(_weight, name)) for name in names),
        row("cameras move", lambda plan: f"{100.0 * plan.cameras.rate:.0f} %"),
        row("cameras are damped", lambda plan: f"{plan.cameras.damping:.2g}"),
        row("cameras are held", lambda plan: f"{plan.cameras.holding:.2g}"),
    ]
    return ["progress", *(f"{100.0 * progress:.0f} %" for progress, _ in plans)], rows


def _weight(name: str, plan: StepPlan) -> str:
    weight = f"{plan.weights.get(name, 0.0):.2g}"
    return f"{weight} log" if name == "points" and plan.are_emerging else weight


def stride(progress: float, step: int) -> int:
    """Return `StepPlan.stride`."""
    progress = min(progress, step / DETAILED_STEPS)
    return next((stride for until, stride in STRIDES if progress <= until), SHORTEST)


def loss_weights(components: Components, point_weight: float) -> dict[str, float]:
    """Return `StepPlan.weights`; that of known distances is `point_weight` times their component."""
    weights = {
        "colour": 1.0,
        "distortion": components.distortion,
        "points": components.distance_weight * point_weight,
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
