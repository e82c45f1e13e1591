"""Compare candidates within a budget of time or steps: the best one first, then the others in addition to it."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from torch import Tensor

from nerfcli.training.runs.components import Change, Components
from nerfcli.training.runs.decisions import Decision, untried
from nerfcli.training.selection.judgement import (
    LEAST_GAIN_DB,
    MOST_LOSS_DB,
    SEED_DB,
    Rule,
    judge_one,
    judge_removal,
    judge_supported,
)
from nerfcli.training.selection.trials import Trial, Trials, TrialStart

# Steps of a trial relative to those of the training that it continues.
STEPS_OF_START = 0.5
SEEDS = 2
# A removal saves only a little time in the training: its trials have to end within this fraction of a time budget.
REMOVAL_FRACTION = 0.65
# They may take this fraction of the budget: 2 % of a training whose search has 15 %.
REMOVAL_COST = 0.13
NO_TIME, ONCE = "not tried, no time left", "not clear with one seed, and no time left for a second one"
COSTS_MORE = "not tried, the trial would take longer than it could save"


class SearchBudget:
    """Budget of all trials together: seconds, or steps."""

    def __init__(self, seconds: float | None, steps: int | None):
        self._seconds, self._steps = seconds, steps
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

    def __init__(self, trials: Trials, start: TrialStart, budget: SearchBudget, requested: Components):
        self._trials, self._start, self._budget, self._requested = trials, start, budget, requested
        self._length = max(1, round(STEPS_OF_START * start.steps))
        self._seconds_each = start.seconds * self._length / start.steps
        self.kept: list[Change] = []
        self.decisions: dict[Change, Decision] = {}
        # Trials of the components kept so far, one per seed; and first trials of changes that may gain in addition.
        self._base: list[Trial] = []
        self._once: dict[Change, Trial] = {}
        self._rules: Mapping[Change, Rule] = {}

    @property
    def log_gains(self) -> Tensor | None:
        """Exposures found by the winning model."""
        return self._base[0].log_gains if self._base else None

    def run(
        self,
        additions: Sequence[Change],
        removals: Sequence[Change],
        rules: Mapping[Change, Rule] = MappingProxyType({}),
    ) -> None:
        """Fill `decisions` and `kept`.

        Try all additions with one seed, then the best of them with the other seeds unless it is clear already. If it is
        kept, try the rest again in addition to it, and so on. Removals come last, as an addition may replace what is
        removed.

        Args:
            additions, removals: changes to the requested model.
            rules: for additions that other evidence supports; the others use `judge_one`.
        """
        self.decisions = {change: untried(*change, NO_TIME) for change in (*additions, *removals)}
        self._rules = rules
        if additions and self._can_run(2):
            self._base = [self._trial([], seed=0)]
            self._try_once(additions)
        while self._once:
            best = self._best()
            if self._is_confirmed(best, self._rule(best)):
                for other in [other for other in self._once if other[0] == best[0]]:
                    self._drop(other, f"{best[0]}={best[1]} is better")
                self._try_once(list(self._once))
        for change in removals:
            trials = 2 * SEEDS - len(self._base)  # all seeds, for a sure answer
            if not self._can_run(trials, fraction_of_time=REMOVAL_FRACTION):
                continue
            if not self._budget.is_cheap(trials, of_steps=self._length, seconds_each=self._seconds_each):
                self.decisions[change] = untried(*change, COSTS_MORE)
                continue
            self._base = self._base or [self._trial([], seed=0)]
            self._once[change] = self._trial([change], seed=0)
            self._is_confirmed(change, judge_removal)

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
            decision = self._judged(self._rule(change), change, [trial])
            self.decisions[change] = replace(decision, kept=False)
            if self._rule(change) is judge_supported or (decision.gain_db or 0.0) > LEAST_GAIN_DB:
                self._once[change] = trial
                reserved = 0 if decision.kept else SEEDS - len(self._base) + SEEDS - 1

    def _rule(self, addition: Change) -> Rule:
        return self._rules.get(addition, judge_one)

    def _best(self) -> Change:
        """Return the change with the largest gain.

        Among values of that component whose gains differ by no more than the noise of seeds, return the one proposed
        first, which is the simplest.
        """
        gains = {change: self.decisions[change].gain_db or 0.0 for change in self._once}
        best = max(gains, key=lambda change: gains[change])
        return next(change for change in gains if change[0] == best[0] and gains[change] >= gains[best] - SEED_DB)

    def _is_confirmed(self, change: Change, rule: Rule) -> bool:
        """Decide on a change: keep it if its gain is clear with one seed, or is confirmed with the other seeds."""
        own = [self._once.pop(change)]
        decision = self._judged(rule, change, own)
        if not decision.kept and (decision.gain_db or 0.0) > -MOST_LOSS_DB:
            if not self._can_run(SEEDS - len(self._base) + SEEDS - 1):
                self.decisions[change] = replace(decision, why=ONCE)
                return False
            self._base += [self._trial([], seed=seed) for seed in range(len(self._base), SEEDS)]
            own += [self._trial([change], seed=seed) for seed in range(1, SEEDS)]
            decision = self._judged(rule, change, own)
        self.decisions[change] = decision
        if decision.kept:
            self.kept.append(change)
            self._base = own
        return decision.kept

    def _drop(self, change: Change, why: str) -> None:
        self._once.pop(change, None)
        self.decisions[change] = replace(self.decisions[change], kept=False, why=why)

    def _judged(self, rule: Rule, change: Change, own: Sequence[Trial]) -> Decision:
        decision = rule(self._base[: len(own)], change, own, by_time=self._budget.is_time)
        others = ", ".join(name for name, _ in self.kept)
        return replace(decision, why=f"{decision.why}, in addition to {others}") if others else decision

    def _can_run(self, trials: int, *, fraction_of_time: float = 1.0) -> bool:
        return self._budget.can_afford(
            trials, of_steps=self._length, seconds_each=self._seconds_each, fraction_of_time=fraction_of_time
        )

    def _trial(self, changes: Sequence[Change], *, seed: int) -> Trial:
        before = self._budget.spent
        values: dict[str, Any] = dict([*self.kept, *changes])
        components = replace(self._requested, **values)
        trial = self._trials.go_on(self._start, components, seed=seed, steps=self._length)
        self._budget.charge(self._length)
        self._seconds_each = max(self._seconds_each, self._budget.spent - before)
        return trial
