"""Judge a component from paired short trainings: its gain, the error of the gain, and whether it is kept."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from nerfcli.training.runs.components import Change
from nerfcli.training.runs.decisions import Decision
from nerfcli.training.selection.trials import Trial

# A gain counts if it exceeds `LEAST_GAIN_DB`, which nobody sees, by this many standard errors.
STANDARD_ERRORS = 2.0
# The same for a gain that diagnostics suggest, as well as the trial.
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


class Rule(Protocol):
    """Judges the trials of a change; see `judge_one`."""

    def __call__(self, base: Sequence[Trial], change: Change, tried: Sequence[Trial], *, by_time: bool) -> Decision: ...


def judge_one(
    base: Sequence[Trial],
    change: Change,
    tried: Sequence[Trial],
    *,
    by_time: bool,
    standard_errors: float = STANDARD_ERRORS,
    clear_errors: float = CLEAR_ERRORS,
) -> Decision:
    """Judge an added component: its gain must exceed the noise.

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
        standard_errors, clear_errors: how many of them the gain has to exceed, with several seeds and with one.
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
    errors = standard_errors if seeds > 1 else clear_errors
    against = _against(gain, error, errors=errors, trend=trend, at_equal_time=at_equal_time)
    why = against or f"gains more than {LEAST_GAIN_DB:g} dB and {errors:g} standard errors"
    return Decision(*change, gain, error, trend, cost, at_equal_time, against is None, why)


def judge_likely(base: Sequence[Trial], change: Change, tried: Sequence[Trial], *, by_time: bool) -> Decision:
    """Judge an added component that diagnostics suggest: one standard error is enough, or two with a single seed.

    Arguments as for `judge_one`.
    """
    return judge_one(base, change, tried, by_time=by_time, standard_errors=LIKELY_ERRORS, clear_errors=STANDARD_ERRORS)


def judge_supported(base: Sequence[Trial], change: Change, tried: Sequence[Trial], *, by_time: bool) -> Decision:
    """Judge a component that corrects an error known from other evidence: it must not lose.

    A trial is too short for most of its gain. Arguments as for `judge_one`.
    """
    return _unless_it_loses(judge_one(base, change, tried, by_time=by_time), most_db=0.0)


def judge_evidence(base: Sequence[Trial], change: Change, tried: Sequence[Trial], *, by_time: bool) -> Decision:
    """Judge components that rest on measurements of the photos, such as known distances.

    They must not lose more than `MOST_LOSS_OF_EVIDENCE_DB`, or than the error of the gain if that is larger. Arguments
    as for `judge_one`.
    """
    return _unless_it_loses(judge_one(base, change, tried, by_time=by_time), most_db=MOST_LOSS_OF_EVIDENCE_DB)


def judge_removal(base: Sequence[Trial], change: Change, tried: Sequence[Trial], *, by_time: bool) -> Decision:
    """Judge the removal of a component: hardly anything may be lost, noise and trend included.

    What the model has learned with the component is lost at once; a model that does not need it recovers within the
    trial. Arguments as for `judge_one`.
    """
    measured = judge_one(base, change, tried, by_time=by_time)
    gain, error, trend = measured.gain_db or 0.0, measured.error_db or 0.0, measured.trend_db or 0.0
    worst = gain + min(0.0, trend) - STANDARD_ERRORS * error
    if worst > -MOST_LOSS_DB:
        return replace(measured, kept=True, why=f"not needed: the loss without it is below {MOST_LOSS_DB:g} dB")
    why = "needed: PSNR drops without it" if gain < -STANDARD_ERRORS * error else "may be needed"
    return replace(measured, kept=False, why=why)


def _unless_it_loses(measured: Decision, *, most_db: float) -> Decision:
    """Keep a component unless it loses more than this and more than the error of its gain."""
    gain, error = measured.gain_db or 0.0, measured.error_db or 0.0
    if gain > -max(error, most_db):
        why = "does not lose" if gain > -error else f"loses less than {most_db:g} dB"
        return replace(measured, kept=True, why=f"measured before training, and {why}")
    return replace(measured, kept=False, why="loses, although measured before training")


def _against(gain: float, error: float, *, errors: float, trend: float, at_equal_time: float) -> str | None:
    """Return the reason to reject a candidate; None if there is none."""
    if gain < -STANDARD_ERRORS * error:
        return "loses"
    if not gain > LEAST_GAIN_DB + errors * error:
        return "no gain above the noise"
    if trend < -error - 1e-6:  # not for rounding
        return "the gain vanishes during the trial"
    if at_equal_time <= LEAST_GAIN_DB:
        return "gains less than spending the same time on more steps"
    return None


def _gains(base: Trial, changed: Trial, *, halfway: bool = False) -> np.ndarray:
    """Return the gain of the change in each judged photo, (judged photos,) in dB."""
    judged = base.counts > 0
    errors = [(trial.halfway if halfway else trial.errors)[judged] / base.counts[judged] for trial in (base, changed)]
    floor = FLOOR * errors[0].mean() + 1e-12
    return 10.0 * np.log10((errors[0] + floor) / (errors[1] + floor))


def _gains_by_steps(trial: Trial) -> np.ndarray:
    """Return the gain from the second half of a trial's steps, (judged photos,) in dB."""
    return _gains(replace(trial, errors=trial.halfway), trial)
