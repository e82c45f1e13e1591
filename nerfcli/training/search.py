"""Try candidates within a budget of time or steps, one after the other, each in addition to what is kept so far."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from nerfcli.training.runs.components import Change, Components, Decision, untried
from nerfcli.training.schedule import REMOVAL_COST, REMOVAL_FRACTION, Budget
from nerfcli.training.trials import Trial, Trials, TrialStart

# Standard deviation of a gain between seeds, where there is only one.
SEED_DB = 0.1
# Photos that show next to nothing have hardly any error, and its logarithm is noise: this fraction of the mean error is
# added to that of every photo.
FLOOR = 0.1
# Steps of a trial relative to those of the training that it continues.
STEPS_OF_START = 0.5
SEEDS = 2
NO_TIME, ONCE = "no time left", "not clear with one seed, and no time left for a second one"
COSTS_MORE = "the trial would take longer than it could save"


@dataclass(frozen=True)
class Rule:
    """The gain of a change counts if it exceeds the least one by some standard errors.

    Args:
        least_db: the least gain.
        errors, errors_of_one: how many standard errors, with several seeds and with one.
    """

    least_db: float
    errors: float
    errors_of_one: float


# Nobody sees less than 0.05 dB.
ADDITION = Rule(0.05, 2.0, 5.0)
# What diagnostics suggest, as well as the trial.
LIKELY = Rule(0.05, 1.0, 2.0)
# What corrects an error known from other evidence must not lose: a trial is too short for most of its gain.
SURE = Rule(0.0, -1.0, -1.0)
# A component is left out if hardly anything is lost. What the model has learned with it is lost at once; a model that
# does not need it recovers within the trial.
REMOVAL = Rule(-0.1, 2.0, 2.0)


@dataclass(frozen=True)
class Candidate:
    """A change to try, what was seen that speaks for it, and the rule for its gain."""

    change: Change
    seen: str
    rule: Rule


def judge(base: Sequence[Trial], candidate: Candidate, tried: Sequence[Trial], *, by_time: bool) -> Decision:
    """Judge a change by its rule.

    gain = mean over photos and seeds of 10 log10(MSE of base / MSE of candidate). Its variance is that of the mean over
    photos plus that of the mean over seeds; with a single seed, the latter is SEED_DB squared. The gain of a component
    that falls by more than its error in the second half of the steps is assumed to vanish in a longer training; the
    loss by a removal, to grow as it does there.

    Args:
        base: trials without the change, one per seed.
        by_time: whether the gain must also exceed that of more steps in the same time; with a budget of steps, the
            answer must not depend on the speed of the machine.
    """
    rule = candidate.rule
    gains = np.array([_gains(one, other) for one, other in zip(base, tried, strict=True)])
    seeds, photos = gains.shape
    gain = float(gains.mean())
    between_seeds = float(gains.mean(1).var(ddof=1)) / seeds if seeds > 1 else SEED_DB**2
    between_photos = float(gains.mean(0).var(ddof=1)) / photos if photos > 1 else 0.0
    error = math.sqrt(between_seeds + between_photos)
    halves = [_gains(one, other, halfway=True).mean() for one, other in zip(base, tried, strict=True)]
    trend = gain - float(np.mean(halves))
    cost = sum(trial.seconds for trial in tried) / sum(trial.seconds for trial in base) - 1.0
    # Gain of the unchanged model from twice as many steps: from the second half of its own.
    halves_of_base = [_gains(replace(trial, errors=trial.halfway), trial).mean() for trial in base]
    slope_db = max(0.0, float(np.mean(halves_of_base)))
    at_equal_time = gain - slope_db * math.log2(1.0 + cost) if by_time else gain
    least = rule.least_db + (rule.errors if seeds > 1 else rule.errors_of_one) * error
    in_the_end = gain + min(0.0, trend) if rule is REMOVAL else gain
    is_loss = gain < -2.0 * error or rule is SURE
    against = ""
    if in_the_end <= least and rule is REMOVAL:
        against = "it is needed" if is_loss else "it may be needed"
    elif in_the_end <= least:
        against = "loses" if is_loss else "no gain above the noise"
    elif rule in (ADDITION, LIKELY) and trend < -error - 1e-6:  # not for rounding
        against = "the gain vanishes during the trial"
    elif rule in (ADDITION, LIKELY) and at_equal_time <= rule.least_db:
        against = "gains less than spending the same time on more steps"
    seen = candidate.seen
    return Decision(*candidate.change, gain, error, trend, cost, at_equal_time, not against, against, seen)


def _gains(base: Trial, changed: Trial, *, halfway: bool = False) -> np.ndarray:
    """Return the gain of the change in each judged photo, (judged photos,) in dB."""
    judged = base.counts > 0
    errors = [(trial.halfway if halfway else trial.errors)[judged] / base.counts[judged] for trial in (base, changed)]
    floor = FLOOR * errors[0].mean() + 1e-12
    return 10.0 * np.log10((errors[0] + floor) / (errors[1] + floor))


class Search:
    """Trials of candidates, all from the same start.

    Args:
        trials, start: the trials, and the training that they continue.
        requested: the components of the model to improve.
        budget: of the start and all trials together.
        began: `time.perf_counter` when the start began.
    """

    def __init__(self, trials: Trials, start: TrialStart, requested: Components, *, budget: Budget, began: float):
        self._trials, self._start, self._requested = trials, start, requested
        self._budget, self._began, self._steps = budget, began, start.trial.steps
        self._length = max(1, round(STEPS_OF_START * self._steps))
        self._seconds_each = start.seconds * self._length / self._steps
        self.decisions: dict[Change, Decision] = {}
        # Trials of the components kept so far, one per seed.
        self._base: list[Trial] = []

    @property
    def kept(self) -> dict[str, Any]:
        """The components that are kept, with their values."""
        return {decision.component: decision.value for decision in self.decisions.values() if decision.kept}

    @property
    def log_gains(self) -> Tensor | None:
        """Exposures found by the model with all of these."""
        return self._base[0].log_gains if self._base else None

    def run(self, candidates: Sequence[Candidate]) -> None:
        """Fill `decisions`: a candidate that is kept is in the model that the next one has to improve."""
        for candidate in candidates:
            others = ", ".join(name for name in self.kept if name != candidate.change[0])
            decision = self._tried(candidate)
            if others and decision.gain_db is not None:
                why = f"{decision.why}, " if decision.why else ""
                decision = replace(decision, why=f"{why}in addition to {others}")
            if decision.kept:  # in the place of another value
                better = f"{decision.component}={decision.value} is better"
                self.decisions |= {
                    change: replace(earlier, kept=False, why=better)
                    for change, earlier in self.decisions.items()
                    if earlier.kept and change[0] == decision.component
                }
            self.decisions[candidate.change] = decision

    def _tried(self, candidate: Candidate) -> Decision:
        """Try a candidate with one seed, and with the others unless that is clear."""
        decision = untried(candidate.change, candidate.seen, why=NO_TIME)
        if candidate.rule is REMOVAL:
            trials = 2 * SEEDS - len(self._base)
            if not self._can_run(trials, of_time=REMOVAL_FRACTION):
                return decision
            if not self._is_cheap(trials):
                return replace(decision, why=COSTS_MORE)
        own: list[Trial] = []
        for seed in range(SEEDS):
            has_base = len(self._base) > seed
            if not self._can_run(1 if has_base else 2):
                return replace(decision, why=ONCE) if own else decision
            if not has_base:
                self._base.append(self._trial({}, seed=seed))
            own.append(self._trial(dict([candidate.change]), seed=seed))
            decision = judge(self._base[: len(own)], candidate, own, by_time=self._budget.seconds is not None)
            if decision.kept or (decision.gain_db or 0.0) <= candidate.rule.least_db:
                break
        if decision.kept:
            self._base = own
        return decision

    def _can_run(self, trials: int, *, of_time: float = 1.0) -> bool:
        """Return whether the budget still allows some trials; only a fraction of a time budget may be used."""
        seconds = time.perf_counter() - self._began + trials * self._seconds_each
        has_time = self._budget.seconds is None or seconds <= of_time * self._budget.seconds
        return has_time and (self._budget.steps is None or self._steps + trials * self._length <= self._budget.steps)

    def _is_cheap(self, trials: int) -> bool:
        """Return whether some trials cost no more than the fraction that is for removals."""
        seconds, steps = self._budget.seconds, self._budget.steps
        has_time = seconds is None or trials * self._seconds_each <= REMOVAL_COST * seconds
        return has_time and (steps is None or trials * self._length <= REMOVAL_COST * steps)

    def _trial(self, changes: dict[str, Any], *, seed: int) -> Trial:
        began = time.perf_counter()
        components = replace(self._requested, **{**self.kept, **changes})
        trial = self._trials.go_on(self._start, components, seed=seed, steps=self._length)
        self._steps += self._length
        self._seconds_each = max(self._seconds_each, time.perf_counter() - began)
        return trial
