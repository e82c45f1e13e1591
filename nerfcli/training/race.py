"""Compare candidates within a budget of time or steps: the best one first, then the others in addition to it."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import Any

import numpy as np
from torch import Tensor

from nerfcli.training.runs.components import Change, Components, Decision, untried
from nerfcli.training.schedule import REMOVAL_COST, REMOVAL_FRACTION, Budget
from nerfcli.training.trials import Trial, Trials, TrialStart

# A gain counts if it exceeds `LEAST_GAIN_DB`, which nobody sees, by this many standard errors.
STANDARD_ERRORS = 2.0
# The same for a gain that is likely, as well; with one seed, `STANDARD_ERRORS`.
LIKELY_ERRORS = 1.0
# The same for a gain with one seed only, and its standard deviation between seeds.
CLEAR_ERRORS, SEED_DB = 5.0, 0.1
LEAST_GAIN_DB = 0.05
# Loss that is accepted for a simpler model.
MOST_LOSS_DB = 0.1
# Loss in a trial that is accepted for components that rest on measurements of the photos: in a trial, a field is
# still fog, which does not show what known distances gain by the end of the training.
MOST_LOSS_OF_EVIDENCE_DB = 1.0
# Photos that show next to nothing have hardly any error, and its logarithm is noise: this fraction of the mean error is
# added to that of every photo.
FLOOR = 0.1


class Support(Enum):
    """How much other evidence than a trial supports a change."""

    NONE = "none"
    LIKELY = "likely"
    SURE = "sure"


def judge(
    base: Sequence[Trial],
    change: Change,
    tried: Sequence[Trial],
    *,
    by_time: bool,
    support: Support = Support.NONE,
    seen: str = "",
) -> Decision:
    """Judge an added component: its gain must exceed the noise, or, with sure support, it must not lose.

    gain = mean over photos and seeds of 10 log10(MSE of base / MSE of candidate). Its variance is that of the mean over
    photos plus that of the mean over seeds; with a single seed, the latter is SEED_DB squared, and the gain must exceed
    more standard errors. A gain that falls by more than its error in the second half of the steps is assumed to vanish
    in a longer training.

    Args:
        base: trials without the change, one per seed.
        change: the change that was tried.
        tried: trials with the change, in the same order of seeds.
        by_time: whether the gain must also exceed that of more steps in the same time; with a budget of steps, the
            answer must not depend on the speed of the machine.
        support: a likely change needs fewer standard errors; of a sure one, a trial is too short for most of the gain.
        seen: what supports it, for the user.
    """
    gains = np.array([_gains(one, other) for one, other in zip(base, tried, strict=True)])
    seeds, photos = gains.shape
    gain = float(gains.mean())
    between_seeds = float(gains.mean(1).var(ddof=1)) / seeds if seeds > 1 else SEED_DB**2
    between_photos = float(gains.mean(0).var(ddof=1)) / photos if photos > 1 else 0.0
    error = math.sqrt(between_seeds + between_photos)
    halves = [_gains(one, other, halfway=True).mean() for one, other in zip(base, tried, strict=True)]
    trend = gain - float(np.mean(halves))
    cost = sum(trial.seconds for trial in tried) / sum(trial.seconds for trial in base) - 1.0
    # Gain of the unchanged model from twice as many steps.
    slope_db = max(0.0, float(np.mean([_gains_by_steps(trial).mean() for trial in base])))
    at_equal_time = gain - slope_db * math.log2(1.0 + cost) if by_time else gain
    if support is Support.SURE:
        against = "" if gain > -error else LOSES
    else:
        few, many = (LIKELY_ERRORS, STANDARD_ERRORS) if support is Support.LIKELY else (STANDARD_ERRORS, CLEAR_ERRORS)
        errors = few if seeds > 1 else many
        against = _against(gain, error, errors=errors, trend=trend, at_equal_time=at_equal_time)
    return Decision(*change, gain, error, trend, cost, at_equal_time, not against, against, seen)


def judge_evidence(base: Trial, decision: Decision, tried: Trial, *, by_time: bool) -> Decision:
    """Judge a component that rests on measurements of the photos, such as known distances.

    It must not lose more than `MOST_LOSS_OF_EVIDENCE_DB`, or than the error of the gain if that is larger.
    """
    change = (decision.component, decision.value)
    measured = judge([base], change, [tried], by_time=by_time, support=Support.SURE, seen=decision.seen)
    assert measured.gain_db is not None
    if measured.kept or measured.gain_db <= -MOST_LOSS_OF_EVIDENCE_DB:
        return measured
    return replace(measured, kept=True, why="a trial is too short for its gain")


def judge_removal(base: Sequence[Trial], change: Change, tried: Sequence[Trial], *, by_time: bool) -> Decision:
    """Judge the removal of a component: hardly anything may be lost, noise and trend included.

    What the model has learned with the component is lost at once; a model that does not need it recovers within the
    trial. Arguments as for `judge`.
    """
    measured = judge(base, change, tried, by_time=by_time)
    gain, error, trend = measured.gain_db or 0.0, measured.error_db or 0.0, measured.trend_db or 0.0
    if gain + min(0.0, trend) - STANDARD_ERRORS * error > -MOST_LOSS_DB:
        return replace(measured, kept=True, why=f"the loss without it is below {MOST_LOSS_DB:g} dB")
    why = "it is needed" if gain < -STANDARD_ERRORS * error else "it may be needed"
    return replace(measured, kept=False, why=why)


def _against(gain: float, error: float, *, errors: float, trend: float, at_equal_time: float) -> str:
    """Return the reason to reject a candidate; "" if there is none."""
    if gain < -STANDARD_ERRORS * error:
        return LOSES
    if not gain > LEAST_GAIN_DB + errors * error:
        return "no gain above the noise"
    if trend < -error - 1e-6:  # not for rounding
        return "the gain vanishes during the trial"
    if at_equal_time <= LEAST_GAIN_DB:
        return "gains less than spending the same time on more steps"
    return ""


def _gains(base: Trial, changed: Trial, *, halfway: bool = False) -> np.ndarray:
    """Return the gain of the change in each judged photo, (judged photos,) in dB."""
    judged = base.counts > 0
    errors = [(trial.halfway if halfway else trial.errors)[judged] / base.counts[judged] for trial in (base, changed)]
    floor = FLOOR * errors[0].mean() + 1e-12
    return 10.0 * np.log10((errors[0] + floor) / (errors[1] + floor))


def _gains_by_steps(trial: Trial) -> np.ndarray:
    """Return the gain from the second half of a trial's steps, (judged photos,) in dB."""
    return _gains(replace(trial, errors=trial.halfway), trial)


# Steps of a trial relative to those of the training that it continues.
STEPS_OF_START = 0.5
SEEDS = 2
LOSES, NO_TIME, ONCE = "loses", "no time left", "not clear with one seed, and no time left for a second one"
COSTS_MORE = "the trial would take longer than it could save"


class Purse:
    """What is left of the budget of all trials together: seconds, or steps where it has none."""

    def __init__(self, budget: Budget):
        self._seconds, self._steps = budget.seconds, budget.steps
        self._began, self._gone = time.perf_counter(), 0

    @property
    def is_time(self) -> bool:
        """Whether the budget is in seconds."""
        return self._seconds is not None

    @property
    def spent(self) -> float:
        """Seconds spent so far."""
        return time.perf_counter() - self._began

    def can_afford(self, trials: int, *, of_steps: int, seconds_each: float, fraction_of_time: float = 1.0) -> bool:
        """Return whether the budget still allows some trials; only a fraction of a time budget may be used."""
        if self._seconds is not None:
            return self.spent + trials * seconds_each <= fraction_of_time * self._seconds
        return self._gone + trials * of_steps <= (self._steps or 0)

    def is_cheap(self, trials: int, *, of_steps: int, seconds_each: float) -> bool:
        """Return whether some trials cost no more than the fraction reserved for removals."""
        if self._seconds is not None:
            return trials * seconds_each <= REMOVAL_COST * self._seconds
        return trials * of_steps <= REMOVAL_COST * (self._steps or 0)

    def charge(self, steps: int) -> None:
        """Count completed steps."""
        self._gone += steps


class Race:
    """Compare candidates with each other, all from the same start.

    Args:
        trials, start: the trials, and the training that they continue.
        requested: the components of the model to improve.
    """

    def __init__(self, trials: Trials, start: TrialStart, purse: Purse, requested: Components):
        self._trials, self._start, self._purse, self._requested = trials, start, purse, requested
        self._length = max(1, round(STEPS_OF_START * start.steps))
        self._seconds_each = start.seconds * self._length / start.steps
        self.kept: list[Change] = []
        self.decisions: dict[Change, Decision] = {}
        # Trials of the components kept so far, one per seed; and first trials of changes that may gain in addition.
        self._base: list[Trial] = []
        self._once: dict[Change, Trial] = {}
        self._additions: Mapping[Change, tuple[str, Support]] = {}

    @property
    def log_gains(self) -> Tensor | None:
        """Exposures found by the winning model."""
        return self._base[0].log_gains if self._base else None

    def run(self, additions: Mapping[Change, tuple[str, Support]], removals: Sequence[Change]) -> None:
        """Fill `decisions` and `kept`.

        Try all additions with one seed, then the best of them with the other seeds unless it is clear already. If it is
        kept, try the rest again in addition to it, and so on. Removals come last, as an addition may replace what is
        removed.

        Args:
            additions: changes to the requested model, with what was seen and how much that supports them.
            removals: components to leave out of it.
        """
        self._additions = additions
        self.decisions = {change: untried(change, seen, why=NO_TIME) for change, (seen, _) in additions.items()}
        self.decisions |= {change: untried(change, "", why=NO_TIME) for change in removals}
        if additions and self._can_run(2):
            self._base = [self._trial([], seed=0)]
            self._try_once(list(additions))
        while self._once:
            best = self._best()
            if self._is_confirmed(best):
                for other in [other for other in self._once if other[0] == best[0]]:
                    self._drop(other, f"{best[0]}={best[1]} is better")
                self._try_once(list(self._once))
        for change in removals:
            trials = 2 * SEEDS - len(self._base)  # all seeds, for a sure answer
            if not self._can_run(trials, fraction_of_time=REMOVAL_FRACTION):
                continue
            if not self._purse.is_cheap(trials, of_steps=self._length, seconds_each=self._seconds_each):
                self.decisions[change] = untried(change, "", why=COSTS_MORE)
                continue
            self._base = self._base or [self._trial([], seed=0)]
            self._once[change] = self._trial([change], seed=0)
            self._is_confirmed(change)

    def _try_once(self, changes: Sequence[Change]) -> None:
        """Try each change with the first seed, in addition to what is kept; `_once` then has those that may gain.

        Once a change gains, time for its trials with the other seeds is reserved before further changes are tried.
        """
        reserved = 0
        for change in changes:
            self._once.pop(change, None)
            if not self._can_run(1 + reserved):
                if self.kept:
                    self._drop(change, ONCE)
                continue
            trial = self._trial([change], seed=0)
            decision = self._judged(change, [trial])
            self.decisions[change] = replace(decision, kept=False)
            if self._additions[change][1] is Support.SURE or (decision.gain_db or 0.0) > LEAST_GAIN_DB:
                self._once[change] = trial
                reserved = 0 if decision.kept else SEEDS - len(self._base) + SEEDS - 1

    def _best(self) -> Change:
        """Return the change with the largest gain.

        Among values of that component whose gains differ by no more than the noise of seeds, return the one proposed
        first, which is the simplest.
        """
        gains = {change: self.decisions[change].gain_db or 0.0 for change in self._once}
        best = max(gains, key=lambda change: gains[change])
        return next(change for change in gains if change[0] == best[0] and gains[change] >= gains[best] - SEED_DB)

    def _is_confirmed(self, change: Change) -> bool:
        """Decide on a change: keep it if its gain is clear with one seed, or is confirmed with the other seeds."""
        own = [self._once.pop(change)]
        decision = self._judged(change, own)
        if not decision.kept and (decision.gain_db or 0.0) > -MOST_LOSS_DB:
            if not self._can_run(SEEDS - len(self._base) + SEEDS - 1):
                self.decisions[change] = replace(decision, why=ONCE)
                return False
            self._base += [self._trial([], seed=seed) for seed in range(len(self._base), SEEDS)]
            own += [self._trial([change], seed=seed) for seed in range(1, SEEDS)]
            decision = self._judged(change, own)
        self.decisions[change] = decision
        if decision.kept:
            self.kept.append(change)
            self._base = own
        return decision.kept

    def _drop(self, change: Change, why: str) -> None:
        self._once.pop(change, None)
        self.decisions[change] = replace(self.decisions[change], kept=False, why=why)

    def _judged(self, change: Change, own: Sequence[Trial]) -> Decision:
        base, by_time = self._base[: len(own)], self._purse.is_time
        if change in self._additions:
            seen, support = self._additions[change]
            decision = judge(base, change, own, by_time=by_time, support=support, seen=seen)
        else:
            decision = judge_removal(base, change, own, by_time=by_time)
        if not self.kept:
            return decision
        others = f"in addition to {', '.join(name for name, _ in self.kept)}"
        return replace(decision, why=f"{decision.why}, {others}" if decision.why else others)

    def _can_run(self, trials: int, *, fraction_of_time: float = 1.0) -> bool:
        return self._purse.can_afford(
            trials, of_steps=self._length, seconds_each=self._seconds_each, fraction_of_time=fraction_of_time
        )

    def _trial(self, changes: Sequence[Change], *, seed: int) -> Trial:
        before = self._purse.spent
        values: dict[str, Any] = dict([*self.kept, *changes])
        components = replace(self._requested, **values)
        trial = self._trials.go_on(self._start, components, seed=seed, steps=self._length)
        self._purse.charge(self._length)
        self._seconds_each = max(self._seconds_each, self._purse.spent - before)
        return trial
