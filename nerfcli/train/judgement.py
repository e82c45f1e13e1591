"""What paired short trainings say of a change: its gain, the gain's error, and whether it is kept."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from nerfcli.train.components import Value
from nerfcli.train.trials import Trial

# A gain counts if it is above this many standard errors, and above what nobody sees.
STANDARD_ERRORS = 2.0
LEAST_GAIN_DB = 0.05
# Photos in which there is next to nothing have hardly any error, and its logarithm is noise: this share of the mean
# error is added to that of every photo.
FLOOR = 0.1
ROUNDING_DB = 1e-6


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


def untried(component: str, value: Value, why: str) -> Decision:
    """A candidate that was not tried, and the reason."""
    return Decision(component, value, None, None, None, None, None, False, why)


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
    if trend < -error - ROUNDING_DB:
        return "gains at first only"
    if at_equal_time <= LEAST_GAIN_DB:
        return "gains less than the steps would that it costs"
    return None


def _gains(base: Trial, changed: Trial, *, halfway: bool = False) -> np.ndarray:
    """(judged photos,) dB that the change gains in each."""
    judged = base.counts > 0
    errors = [(trial.halfway if halfway else trial.errors)[judged] / base.counts[judged] for trial in (base, changed)]
    floor = FLOOR * errors[0].mean() + 1e-12
    return 10.0 * np.log10((errors[0] + floor) / (errors[1] + floor))


def _gains_by_steps(trial: Trial) -> np.ndarray:
    """(judged photos,) dB that the second half of its steps brought."""
    return _gains(replace(trial, errors=trial.halfway), trial)
