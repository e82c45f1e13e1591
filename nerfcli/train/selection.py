"""Which components a scene needs: each against the plainest model, in paired short trainings, with their noise.

A change is kept only if it is better by more than the noise. Gain and noise are measured, not assumed: every candidate
goes on from the same start with the same seeds and pixels as the model that it would change, and what the gains differ
by between seeds and between photos is their error. What is kept first is in the model that the next one has to better:
two components that mend the same fault are not both needed.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from nerfcli.train.components import MOST_DEGREES, Components, Value
from nerfcli.train.signs import Signs
from nerfcli.train.trials import Start, Trial, Trials

# Of the budget, for all trials together.
SEARCH_SHARE = 0.15
# Of the search, for the training that the trials go on from; and the steps of a trial against those of that one.
START_SHARE, STEPS_OF_START = 0.25, 0.5
# A search whose first training is shorter than this tells nothing, and is left out.
FEWEST_STEPS = 80
SEEDS = 2
# A gain counts if it is above this many standard errors, and above what nobody sees.
STANDARD_ERRORS = 2.0
LEAST_GAIN_DB = 0.05
# Photos in which there is next to nothing have hardly any error, and its logarithm is noise: this share of the mean
# error is added to that of every photo.
FLOOR = 0.1
# Photos whose brightness differs by less than this, in logarithms of light, are as well without exposures.
LEAST_EXPOSURE_SPREAD = 0.03

NO_TIME, ONCE = "not tried, no time was left", "gains once, but no time was left to try it again"

Change = tuple[str, Value]


@dataclass(frozen=True)
class Decision:
    """What became of a candidate.

    Args:
        component, value: the change.
        gain_db: in PSNR of pixels that were not trained on, at equal steps, the mean over photos; negative is a loss.
            None where it was not tried, as for all numbers that follow.
        error_db: its standard error.
        trend_db: how much of the gain the second half of the steps brought.
        cost: seconds of a step against those of a step without the change, minus 1.
        gain_at_equal_time_db: the gain without what the steps would have brought that it costs.
        kept: whether it is in the model.
        why: in words.
    """

    component: str
    value: Value
    gain_db: float | None
    error_db: float | None
    trend_db: float | None
    cost: float | None
    gain_at_equal_time_db: float | None
    kept: bool
    why: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    def in_words(self) -> str:
        """A line for people: "exposure=learned: +1.20 +- 0.08 dB, +3 % time: kept, gains ..."."""
        named = f"{self.component}={str(self.value).lower()}"
        if self.gain_db is None or self.error_db is None or self.cost is None:
            return f"{named}: {self.why}"
        measured = f"{self.gain_db:+.2f} +- {self.error_db:.2f} dB, {self.cost:+.0%} time"
        return f"{named}: {measured}: {'kept' if self.kept else 'not kept'}, {self.why}"


@dataclass(frozen=True)
class Selection:
    """The components that were chosen, how, and what it took.

    Args:
        components: those of the model.
        decisions: one per candidate; none where there was too little to spend.
        seconds: of the search.
        log_gains: (photos, 3) of the exposures that the trials found; None where exposures are not learned.
    """

    components: Components
    decisions: tuple[Decision, ...]
    seconds: float
    log_gains: Tensor | None = None

    def to_json(self) -> dict[str, Any]:
        return {
            "components": self.components.to_json(),
            "decisions": [decision.to_json() for decision in self.decisions],
            "seconds": self.seconds,
        }


def plainest(asked: Components, *, field: str, fixed: Sequence[str]) -> Components:
    """The model that has to be bettered: colours do not depend on the direction, unless the user wants them to.

    Only a hash grid can be given harmonics when it is half trained; other fields keep what they have.
    """
    return asked if "view" in fixed or field != "hash" else replace(asked, view=0)


def proposals(
    start: Components, signs: Signs, *, field: str, has_alpha: bool, has_exif: bool, fixed: Sequence[str]
) -> tuple[list[Change], list[Decision]]:
    """Changes that may help a scene, and those that nothing speaks for.

    Args:
        start: what is in the model already.
        signs: of its first training.
        field: the kind.
        has_alpha: whether the photos have alpha: then nothing is behind the object.
        has_exif: whether EXIF tells different exposures.
        fixed: components that the user has decided on.
    """
    candidates: list[Change] = []
    declined: list[Decision] = []
    if has_exif:
        candidates.append(("exposure", "exif"))
    if signs.exposure_spread > LEAST_EXPOSURE_SPREAD:
        candidates.append(("exposure", "learned"))
    else:
        told = f"not tried, photos differ in brightness by {math.expm1(signs.exposure_spread):.1%} only"
        declined.append(_untried("exposure", "learned", told))
    if field == "hash":
        candidates.append(("view", MOST_DEGREES))
    if not has_alpha:
        candidates.append(("background", "sphere"))
    open_ones = [(name, value) for name, value in candidates if name not in fixed and getattr(start, name) != value]
    return open_ones, [decision for decision in declined if decision.component not in fixed]


class _Purse:
    """What there is to spend: seconds, or steps, all trials together."""

    def __init__(self, seconds: float | None, steps: int | None):
        self._seconds, self._steps = seconds, steps
        self._began, self._gone = time.perf_counter(), 0

    @property
    def is_time(self) -> bool:
        """Whether seconds are what is spent."""
        return self._seconds is not None

    @property
    def spent(self) -> float:
        """Seconds so far."""
        return time.perf_counter() - self._began

    def takes(self, trials: int, *, of_steps: int, seconds_each: float) -> bool:
        """Whether there is enough left for some trials."""
        if self._seconds is not None:
            return self.spent + trials * seconds_each <= self._seconds
        return self._gone + trials * of_steps <= (self._steps or 0)

    def take(self, steps: int) -> None:
        """Count steps that were gone."""
        self._gone += steps


def select(
    trials: Trials,
    asked: Components,
    *,
    field: str,
    has_alpha: bool,
    has_exif: bool,
    fixed: Sequence[str],
    seconds: float | None,
    steps: int | None,
) -> Selection:
    """Find the components that a scene needs.

    First all candidates with one seed; then the best of them with a second one, and if it is kept, the others that gain
    once more, beside it; and so on.

    Args:
        trials: of the scene.
        asked: what is in the model where nothing is found out.
        field, has_alpha, has_exif, fixed: see `proposals`.
        seconds: for all trials together; None to go by `steps`.
        steps: of all trials together, where there is no limit of time.

    Returns:
        `asked` and no decisions where there is too little to spend.
    """
    purse = _Purse(seconds, steps)
    first_steps = None if seconds is not None else round(START_SHARE * (steps or 0))
    if first_steps is not None and first_steps < FEWEST_STEPS:
        return Selection(asked, (), 0.0)
    plain = plainest(asked, field=field, fixed=fixed)
    start = trials.begin(plain, steps=first_steps, seconds=None if seconds is None else START_SHARE * seconds)
    purse.take(start.steps)
    if start.steps < FEWEST_STEPS:
        return Selection(asked, (), purse.spent)
    candidates, declined = proposals(
        plain, start.signs, field=field, has_alpha=has_alpha, has_exif=has_exif, fixed=fixed
    )
    race = _Race(trials, start, purse, plain)
    decisions, kept = race.decide(candidates)
    chosen = plain
    untried = {decision.component for decision in decisions if decision.gain_db is None}
    for name in untried - {name for name, _ in kept}:
        chosen = replace(chosen, **{name: getattr(asked, name)})
    chosen = replace(chosen, **dict(kept))
    gains = race.log_gains if chosen.exposure == "learned" else None
    return Selection(chosen, (*decisions, *declined), purse.spent, gains)


class _Race:
    """Candidates against one another, all from the same start."""

    def __init__(self, trials: Trials, start: Start, purse: _Purse, plain: Components):
        self._trials, self._start, self._purse, self._plain = trials, start, purse, plain
        self._length = max(1, round(STEPS_OF_START * start.steps))
        self._seconds_each = start.seconds * self._length / start.steps
        self.log_gains: Tensor | None = None

    def decide(self, candidates: Sequence[Change]) -> tuple[list[Decision], list[Change]]:
        """What becomes of each, and the changes that are kept."""
        decisions = {change: _untried(*change, NO_TIME) for change in candidates}
        if not candidates or not self._can_run(2):
            return list(decisions.values()), []
        kept: list[Change] = []
        base = [self._run(self._plain, seed=0)]
        first: dict[Change, Trial] = {}
        for change in candidates:
            if self._can_run(1):
                first[change] = self._run(self._with(change), seed=0)
                (decisions[change],) = self._judged(base, change, [first[change]])
        while left := [change for change in first if _may_gain(decisions[change])]:
            change = max(left, key=lambda change: decisions[change].gain_db or 0.0)
            beside = " beside " + ", ".join(name for name, _ in kept) if kept else ""
            if self._can_run(SEEDS - len(base) + SEEDS - 1):
                base += [self._run(self._with(*kept), seed=seed) for seed in range(len(base), SEEDS)]
                own = [first.pop(change), *(self._run(self._with(*kept, change), seed=s) for s in range(1, SEEDS))]
                (decision,) = self._judged(base, change, own)
                decisions[change] = replace(decision, why=decision.why + beside)
            else:
                decisions[change] = replace(decisions[change], kept=False, why=f"{ONCE}{beside}")
                del first[change]
                continue
            if not decision.kept:
                continue
            kept, base = [*kept, change], own
            for other in [other for other in first if other[0] == change[0]]:
                decisions[other] = replace(decisions[other], kept=False, why=f"{change[0]}={change[1]} is better")
                del first[other]
            for other in [other for other in first if _may_gain(decisions[other])]:
                if not self._can_run(1):
                    decisions[other] = replace(decisions[other], kept=False, why=f"{ONCE} beside {change[0]}")
                    del first[other]
                    continue
                first[other] = self._run(self._with(*kept, other), seed=0)
                (decision,) = self._judged(base[:1], other, [first[other]])
                told = f"{decision.why} beside {', '.join(name for name, _ in kept)}"
                decisions[other] = replace(decision, why=told)
        self.log_gains = base[0].log_gains
        # Once is not enough to keep anything.
        settled = [replace(d, kept=d.kept and decision_change(d) in kept) for d in decisions.values()]
        return settled, kept

    def _judged(self, base: Sequence[Trial], change: Change, own: Sequence[Trial]) -> tuple[Decision, ...]:
        return judge(base, [(*change, own)], by_time=self._purse.is_time)

    def _with(self, *changes: Change) -> Components:
        return replace(self._plain, **dict(changes))

    def _can_run(self, trials: int) -> bool:
        return self._purse.takes(trials, of_steps=self._length, seconds_each=self._seconds_each)

    def _run(self, components: Components, *, seed: int) -> Trial:
        before = self._purse.spent
        trial = self._trials.go_on(self._start, components, seed=seed, steps=self._length)
        self._purse.take(self._length)
        self._seconds_each = max(self._seconds_each, self._purse.spent - before)
        return trial


def decision_change(decision: Decision) -> Change:
    """The change that a decision is about."""
    return decision.component, decision.value


def _may_gain(decision: Decision) -> bool:
    return decision.gain_db is not None and decision.gain_db > LEAST_GAIN_DB


def judge(
    base: Sequence[Trial], tried: Sequence[tuple[str, Value, Sequence[Trial]]], *, by_time: bool
) -> tuple[Decision, ...]:
    """What paired trials say of their candidates.

    gain = mean over photos and seeds of 10 log10(MSE of base / MSE of candidate). Its variance is that of the mean over
    photos, and that between seeds, pooled over all candidates as two seeds alone tell little. A gain that becomes less
    by more than its error in the second half of the steps is taken for one that vanishes in a longer training.

    Args:
        base: trials without a change, one per seed.
        tried: candidates with theirs, in the same order of seeds.
        by_time: whether a candidate has to gain what its time would bring, too; where steps are what counts, the answer
            must not depend on how fast the machine is.
    """
    if not tried:
        return ()
    per_photo = np.array([[_gains(one, other) for one, other in zip(base, own, strict=True)] for _, _, own in tried])
    seeds, photos = per_photo.shape[1:]
    # What twice as many steps bring to the model as it is.
    slope_db = max(0.0, float(np.mean([_gains_by_steps(trial).mean() for trial in base])))
    between_seeds = float(per_photo.mean(-1).var(axis=1, ddof=1).mean()) if seeds > 1 else 0.0
    decisions = []
    for (name, value, own), gains in zip(tried, per_photo, strict=True):
        gain = float(gains.mean())
        between_photos = float(gains.mean(0).var(ddof=1)) / photos if photos > 1 else 0.0
        error = math.sqrt(between_seeds / seeds + between_photos)
        halves = [_gains(one, other, halfway=True).mean() for one, other in zip(base, own, strict=True)]
        trend = gain - float(np.mean(halves))
        cost = sum(trial.seconds for trial in own) / sum(trial.seconds for trial in base) - 1.0
        at_equal_time = gain - slope_db * math.log2(1.0 + cost) if by_time else gain
        why = _against(gain, error, trend=trend, at_equal_time=at_equal_time)
        kept = why is None
        told = f"gains more than {LEAST_GAIN_DB:g} dB and {STANDARD_ERRORS:g} standard errors" if why is None else why
        decisions.append(Decision(name, value, gain, error, trend, cost, at_equal_time, kept, told))
    return tuple(decisions)


def _against(gain: float, error: float, *, trend: float, at_equal_time: float) -> str | None:
    """What speaks against a candidate; None where nothing does."""
    if gain < -STANDARD_ERRORS * error:
        return "loses"
    if not gain > LEAST_GAIN_DB + STANDARD_ERRORS * error:
        return "no gain above the noise"
    if trend < -error:
        return "gains at first only"
    if at_equal_time <= LEAST_GAIN_DB:
        return "gains less than the steps would that it costs"
    return None


def _untried(component: str, value: Value, why: str) -> Decision:
    return Decision(component, value, None, None, None, None, None, False, why)


def _gains(base: Trial, changed: Trial, *, halfway: bool = False) -> np.ndarray:
    """(judged photos,) dB that the change gains in each."""
    judged = base.counts > 0
    errors = [(trial.halfway if halfway else trial.errors)[judged] / base.counts[judged] for trial in (base, changed)]
    floor = FLOOR * errors[0].mean() + 1e-12
    return 10.0 * np.log10((errors[0] + floor) / (errors[1] + floor))


def _gains_by_steps(trial: Trial) -> np.ndarray:
    """(judged photos,) dB that the second half of its steps brought."""
    return _gains(replace(trial, errors=trial.halfway), trial)
