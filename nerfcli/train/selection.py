"""Which components a scene needs: candidates against what is there, in paired short trainings, with their noise.

A change is kept only if it is better by more than the noise. Gain and noise are measured, not assumed: every candidate
is trained with the same seeds on the same pixels as the model that it would change, and what the gains differ by
between seeds and between photos is their error.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from nerfcli.train.components import Components, Value
from nerfcli.train.trials import Trial, Trials

# Of the budget, for all trials together.
SEARCH_SHARE = 0.15
# A search that has fewer steps for a trial than this tells nothing, and is left out.
FEWEST_STEPS = 40
SEEDS = 2
# A gain counts if it is above this many standard errors, and above what nobody sees.
STANDARD_ERRORS = 2.0
LEAST_GAIN_DB = 0.05


@dataclass(frozen=True)
class Decision:
    """What became of a candidate.

    Args:
        component, value: the change.
        gain_db: in PSNR of pixels that were not trained on, at equal steps; negative is a loss.
        error_db: its standard error.
        trend_db: how much of the gain the second half of the steps brought.
        cost: seconds of a step against those of a step without the change, minus 1.
        gain_at_equal_time_db: the gain without what the steps would have brought that it costs.
        kept: whether it is in the model.
        why: in words.
    """

    component: str
    value: Value
    gain_db: float
    error_db: float
    trend_db: float
    cost: float
    gain_at_equal_time_db: float
    kept: bool
    why: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    def in_words(self) -> str:
        """A line for people: "exposure=learned: +1.20 +- 0.08 dB, +3 % time: kept, gains ..."."""
        value = str(self.value).lower()
        return (
            f"{self.component}={value}: {self.gain_db:+.2f} +- {self.error_db:.2f} dB, {self.cost:+.0%} time: "
            f"{'kept' if self.kept else 'not kept'}, {self.why}"
        )


@dataclass(frozen=True)
class Selection:
    """The components that were chosen, how, and what it took."""

    components: Components
    decisions: tuple[Decision, ...]
    seconds: float

    def to_json(self) -> dict[str, Any]:
        return {
            "components": self.components.to_json(),
            "decisions": [decision.to_json() for decision in self.decisions],
            "seconds": self.seconds,
        }


def proposals(start: Components, *, has_alpha: bool, photos: int, fixed: Sequence[str]) -> list[tuple[str, Value]]:
    """Changes that may help a scene, the most promising ones first.

    Args:
        start: what is in the model already.
        has_alpha: whether the photos have alpha: then nothing is behind the object.
        photos: their number; one photo has no other to differ from.
        fixed: components that the user has decided on.
    """
    candidates: list[tuple[str, Value]] = []
    if photos > 1:
        candidates.append(("exposure", "learned"))
    if not has_alpha:
        candidates.append(("background", "sphere"))
    candidates.append(("view", 0))
    return [(name, value) for name, value in candidates if name not in fixed and getattr(start, name) != value]


def select(
    trials: Trials,
    start: Components,
    candidates: Sequence[tuple[str, Value]],
    *,
    seconds: float | None,
    steps: int | None,
) -> Selection:
    """Try every candidate alone against `start`, keep those that are better, and check them together.

    Args:
        trials: of the scene.
        start: what is in the model without any change.
        candidates: see `proposals`.
        seconds: for all trials together; None to go by `steps`.
        steps: of all trials together, where there is no limit of time.

    Returns:
        `start` and no decisions where there is too little to spend.
    """
    total = SEEDS * (len(candidates) + 2)  # of the model as it is, of each candidate, of those together that are kept
    began = time.perf_counter()
    if not candidates or (seconds is None and (steps or 0) < FEWEST_STEPS * total):
        return Selection(start, (), 0.0)

    def trials_of(components: Components, *, first: Sequence[Trial] = ()) -> list[Trial]:
        left = range(len(first), SEEDS)
        return [*first, *(trials.run(components, seed=seed, steps=length) for seed in left)]

    # The first trial goes by time, and tells how many steps the others are.
    own = None if seconds is not None else (steps or 0) // total
    first = trials.run(start, seed=0, steps=own, seconds=None if seconds is None else seconds / total)
    length = first.steps
    if length < FEWEST_STEPS:
        return Selection(start, (), time.perf_counter() - began)
    base = trials_of(start, first=[first])
    tried = []
    for name, value in candidates:
        if seconds is not None and time.perf_counter() - began > seconds:
            break
        tried.append((name, value, trials_of(replace(start, **{name: value}))))
    decisions = judge(base, tried)
    kept = [decision for decision in decisions if decision.kept]
    if len(kept) > 1:
        together = replace(start, **{decision.component: decision.value for decision in kept})
        gain = float(np.mean([_gain(*pair) for pair in zip(base, trials_of(together), strict=True)]))
        best = max(kept, key=lambda decision: decision.gain_db)
        if gain < best.gain_db:
            decisions = tuple(
                replace(decision, kept=False, why=f"no gain beside {best.component}")
                if decision.kept and decision is not best
                else decision
                for decision in decisions
            )
    changes = {decision.component: decision.value for decision in decisions if decision.kept}
    return Selection(replace(start, **changes), decisions, time.perf_counter() - began)


def judge(base: Sequence[Trial], tried: Sequence[tuple[str, Value, Sequence[Trial]]]) -> tuple[Decision, ...]:
    """What paired trials say of their candidates.

    gain = 10 log10(MSE of base / MSE of candidate), the mean over seeds. Its variance is that between seeds, pooled
    over all candidates as two seeds alone tell little, and that of the choice of photos (jackknife). A simpler model
    learns faster at first: a gain that becomes less by more than its error in the second half of the steps is taken for
    one that vanishes in a longer training.

    Args:
        base: trials without a change, one per seed.
        tried: candidates with theirs, in the same order of seeds.
    """
    gains = np.array([[_gain(one, other) for one, other in zip(base, trials, strict=True)] for _, _, trials in tried])
    if not len(gains):
        return ()
    seeds = len(base)
    # What twice as many steps bring to the model as it is.
    slope_db = max(0.0, float(np.mean([trial.psnr - trial.psnr_halfway for trial in base])))
    between_seeds = float(gains.var(axis=1, ddof=1).mean()) if seeds > 1 else math.nan
    decisions = []
    for (name, value, trials), own in zip(tried, gains, strict=True):
        gain = float(own.mean())
        photos = float(np.mean([_jackknife(one, other) for one, other in zip(base, trials, strict=True)]))
        error = math.sqrt(between_seeds / seeds + photos)
        halves = [other.psnr_halfway - one.psnr_halfway for one, other in zip(base, trials, strict=True)]
        trend = gain - float(np.mean(halves))
        cost = sum(trial.seconds for trial in trials) / sum(trial.seconds for trial in base) - 1.0
        at_equal_time = gain - slope_db * math.log2(1.0 + cost)
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


def _gain(base: Trial, changed: Trial) -> float:
    return changed.psnr - base.psnr


def _jackknife(base: Trial, changed: Trial) -> float:
    """Variance of the gain by the choice of photos: each left out in turn. Source: Efron and Stein 1981, eq. 1.4."""
    judged = base.counts > 0
    count = int(judged.sum())
    if count < 2:
        return 0.0
    left = [np.log10((t.errors.sum() - t.errors[judged]).clip(1e-12)) for t in (base, changed)]
    gains = 10.0 * (left[0] - left[1])
    return float((count - 1) / count * np.square(gains - gains.mean()).sum())
