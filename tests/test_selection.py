"""Which components are kept: the rule on trials whose gain and noise are known."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from present import present

from nerfcli.matching.camera_check import CameraCheck
from nerfcli.training.evidence import may_use_points
from nerfcli.training.runs.components import Components, Decision, Selection
from nerfcli.training.schedule import MOST_START_STEPS, Budget
from nerfcli.training.search import (
    ADDITION,
    COSTS_MORE,
    FLOOR,
    NO_TIME,
    ONCE,
    REMOVAL,
    SEED_DB,
    SURE,
    Candidate,
    Rule,
    Search,
    judge,
)
from nerfcli.training.selection import Facts, proposals, select, with_evidence, with_known_cameras
from nerfcli.training.trials import Diagnostics, Trial, TrialStart

PHOTOS = 20
FITTED = Facts("hash", has_alpha=False, has_exif=False, cameras_known="they are exact")


def trial(psnr: float, *, halfway: float | None = None, seconds: float = 1.0, noise_db: float = 0.0) -> Trial:
    """Return a trial in which photos have the PSNR plus or minus `noise_db` in turn, which cancels in the mean."""
    counts = np.full(PHOTOS, 300)
    away = noise_db * np.array([1.0, -1.0] * (PHOTOS // 2))

    def errors(dB: float) -> np.ndarray:
        return counts * 10.0 ** (-(dB + away) / 10.0)

    return Trial(errors(psnr), errors(psnr - 1.0 if halfway is None else halfway), counts, seconds, 100)


def judged(base: list[Trial], tried: list[Trial], rule: Rule = ADDITION, *, by_time: bool = True) -> Decision:
    return judge(base, Candidate(("view", 0), "", rule), tried, by_time=by_time)


def reported(gain_db: float) -> float:
    """Return the reported gain if all photos gain alike: `FLOOR` times the mean error is added to both errors."""
    return 10.0 * math.log10((1.0 + FLOOR) / (10.0 ** (-gain_db / 10.0) + FLOOR))


def test_a_gain_is_reported_unchanged_and_kept():
    decision = judged([trial(20.0), trial(21.0)], [trial(20.4), trial(21.6)])
    assert decision.gain_db == pytest.approx((reported(0.4) + reported(0.6)) / 2, abs=1e-9)
    # Two seeds that differ by d have a variance of d^2 / 2, their mean one of d^2 / 4; all photos gain the same.
    assert decision.error_db == pytest.approx((reported(0.6) - reported(0.4)) / 2, abs=1e-9)
    assert decision.kept
    assert decision.cost == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ([trial(19.0), trial(20.0)], "loses"),
        ([trial(20.0), trial(21.0)], "no gain above the noise"),
        ([trial(20.9), trial(21.1)], "no gain above the noise"),
        ([trial(20.4, halfway=20.2), trial(21.4, halfway=21.2)], "the gain vanishes during the trial"),
        ([trial(20.4, seconds=2.0), trial(21.4, seconds=2.0)], "gains less than spending the same time on more steps"),
    ],
)
def test_the_reason_is_given_for_what_is_not_kept(changed, why):
    decision = judged([trial(20.0), trial(21.0)], changed)
    assert (decision.kept, decision.why) == (False, why)


def test_a_gain_that_rests_on_a_few_photos_is_not_clear():
    """One photo of twenty gains 10 dB, all others nothing: the error of their mean is as large as the mean."""
    base = [trial(20.0), trial(20.0)]
    errors = base[0].errors.copy()
    errors[3] *= 0.1
    lucky = Trial(errors, base[0].halfway, base[0].counts, 1.0, 100)
    decision = judged(base, [lucky, lucky])
    assert present(decision.gain_db) > 3 * ADDITION.least_db
    assert decision.error_db == pytest.approx(decision.gain_db, rel=1e-9)
    assert not decision.kept


@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_gains_that_differ_as_much_as_they_are_large_are_not_kept(first, second):
    """Two gains of mean m and distance d have an error of d / 2; kept if m exceeds the least gain by two errors."""
    decision = judged([trial(20.0), trial(20.0)], [trial(20.0 + first), trial(20.0 + second)])
    expected = (reported(first) + reported(second)) / 2 > ADDITION.least_db + abs(reported(first) - reported(second))
    assert decision.kept == expected


@pytest.mark.parametrize(
    ("changed", "kept", "why"),
    [
        ([trial(20.0), trial(21.0)], True, ""),
        ([trial(20.3), trial(21.3)], True, ""),
        ([trial(19.88), trial(20.88)], False, "it is needed"),
        ([trial(19.8), trial(21.2)], False, "it may be needed"),
        # 0.6 dB better halfway and 0.2 dB better at the end: extrapolated to twice the steps, 0.2 dB worse.
        ([trial(20.2, halfway=19.6), trial(21.2, halfway=20.6)], False, "it may be needed"),
    ],
)
def test_what_is_left_out_must_surely_not_be_missed(changed, kept, why):
    decision = judged([trial(20.0), trial(21.0)], changed, REMOVAL, by_time=False)
    assert (decision.kept, decision.why) == (kept, why)


def test_one_seed_is_enough_only_where_the_gain_is_clear():
    """All photos gain alike, so the error is `SEED_DB`: the gain must exceed the least by `errors_of_one` of it."""
    least = ADDITION.least_db + ADDITION.errors_of_one * SEED_DB
    for gain, kept in ((1.1 * least, False), (1.5 * least, True)):
        decision = judged([trial(20.0)], [trial(20.0 + gain)])
        assert decision.gain_db == pytest.approx(reported(gain), abs=1e-9)
        assert decision.error_db == pytest.approx(SEED_DB, abs=1e-9)
        assert decision.kept == kept == (reported(gain) > least)


def test_the_margins_in_numbers():
    """0.05 dB is invisible, and 0.1 dB the most that a simpler model may lose; a step that costs a third more has to
    gain what a third more steps would: 0.4 of the 0.9 dB that twice as many bring."""
    base = [trial(20.0), trial(21.0)]

    def both(dB: float, seconds: float = 1.0) -> list[Trial]:
        return [trial(20.0 + dB, seconds=seconds), trial(21.0 + dB, seconds=seconds)]

    assert [judged(base, both(dB)).kept for dB in (0.04, 0.06)] == [False, True]
    assert [judged(base, both(dB), REMOVAL, by_time=False).kept for dB in (-0.13, -0.08)] == [False, True]
    assert [judged(base, both(0.4, seconds)).kept for seconds in (1.31, 1.2)] == [False, True]
    assert judged(base, both(0.4, 2.0), by_time=False).kept  # where steps are what is spent


def test_a_photo_without_pixels_to_judge_by_counts_nothing():
    def without_first(one: Trial) -> Trial:
        none = np.arange(PHOTOS) > 0
        return Trial(one.errors * none, one.halfway * none, one.counts * none, one.seconds, one.steps)

    base, tried = ([without_first(trial(20.0 + dB)), without_first(trial(21.0 + dB))] for dB in (0.0, 0.5))
    assert judged(base, tried).gain_db == pytest.approx(reported(0.5), abs=1e-9)


SKY = (15.0, 24.0)


def signs(spread: float, far: float = 0.05, sky: tuple[float, float] = SKY) -> Diagnostics:
    return Diagnostics(torch.zeros(PHOTOS, 3), spread, far, sky)


def changes_of(candidates: list[Candidate]) -> list[tuple[str, object]]:
    return [candidate.change for candidate in candidates]


def test_proposals_leave_alone_what_the_user_decided_and_what_nothing_speaks_for():
    def names(facts: Facts, spread: float = 0.3, far: float = 0.05) -> set[str]:
        return {name for name, _ in changes_of(proposals(Components(), signs(spread, far), facts)[0]) if name != "view"}

    assert names(FITTED) == {"exposure", "background"}
    assert names(replace(FITTED, fixed=("view", "exposure"))) == {"background"}
    assert names(replace(FITTED, has_alpha=True)) == {"exposure"}
    assert names(FITTED, spread=0.01) == {"background"}
    assert names(FITTED, far=0.009) == {"exposure"}
    (near,) = proposals(Components(), signs(0.3, 0.004), replace(FITTED, fixed=("cameras",)))[1]
    assert near.in_words() == "background=sphere: not tried, only 0.4 % of the pixels see mostly distant things"
    for sky in ((15.0, 16.1), (23.0, 22.9), (math.inf, math.inf)):
        assert ("background", "sphere") in changes_of(proposals(Components(), signs(0.3, 0.05, sky), FITTED)[0])
    tried, declined = proposals(Components(), signs(0.3, 0.05, (15.0, 15.9)), FITTED)
    assert ("background", "sphere") not in changes_of(tried)
    (reported,) = (one.in_words() for one in declined if one.component == "background")
    said = "but viewing direction does not explain their colours: 15.9 dB with it, 15.0 dB with one colour"
    assert reported.endswith(said)
    (declined,) = proposals(Components(), signs(0.01), replace(FITTED, fixed=("cameras",)))[1]
    assert (declined.component, declined.kept, declined.gain_db) == ("exposure", False, None)
    assert declined.in_words() == "exposure=learned: not tried, photos differ by only 0.014 stops"
    assert ("exposure", "exif") in changes_of(proposals(Components(), signs(0.0), replace(FITTED, has_exif=True))[0])


def test_what_is_left_out_is_nothing_that_the_user_or_the_field_decided():
    def removed(start: Components, facts: Facts) -> list[str]:
        return [one.change[0] for one in proposals(start, signs(0.0, 0.0), facts)[0] if one.rule is REMOVAL]

    assert removed(Components(), FITTED) == ["view"]
    assert removed(Components(view=0), FITTED) == []
    assert removed(Components(), replace(FITTED, fixed=("view",))) == []
    assert removed(Components(), replace(FITTED, field="voxels")) == []


class Scripted:
    """Trials that answer at once, with gains in dB that a function gives for components."""

    def __init__(self, gain: Callable[[Components], float], *, spread: float = 0.1, far: float = 0.05):
        self.gain, self.spread, self.far = gain, spread, far
        self.requested: list[tuple[Components, int, int]] = []
        self.begun: list[Components] = []

    def begin(self, components: Components, budget: Budget, *, fewest: int = 0) -> TrialStart | None:
        self.begun.append(components)
        if (steps := present(budget.steps)) < fewest:
            return None
        done = replace(trial(20.0 + self.gain(components)), steps=steps)
        return TrialStart({}, {}, 1.0, done, signs(self.spread, self.far))

    def go_on(self, start: TrialStart, components: Components, *, seed: int, steps: int) -> Trial:
        self.requested.append((components, seed, steps))
        return trial(20.0 + seed + self.gain(components))


def chosen_by(scripted: Scripted, *, steps: int = 4000, facts: Facts = FITTED):
    return select(scripted, Components(), facts, Budget(None, steps))  # type: ignore[arg-type]


def test_what_gains_is_in_the_model_what_does_not_is_not_and_seeds_are_paired():
    scripted = Scripted(lambda c: 0.5 * (c.background == "sphere") - 0.2 * (c.exposure == "learned"))
    chosen = chosen_by(scripted)
    assert chosen.components == Components(view=0, background="sphere")
    assert {d.component for d in chosen.decisions if d.kept} == {"view", "background"}
    assert {d.component for d in chosen.decisions if not d.kept} == {"exposure", "cameras"}
    assert {seed for _, seed, _ in scripted.requested} == {0, 1}
    assert {steps for _, _, steps in scripted.requested} == {125}  # half of the longest start
    assert Selection.from_json(chosen.to_json()).decisions == chosen.decisions


POINTED = replace(FITTED, points=7)


def test_points_that_photos_share_are_in_the_model_from_the_start():
    scripted = Scripted(lambda c: -2.0 * (c.points > 0))  # a trial is too short for what they gain
    chosen = chosen_by(scripted, facts=POINTED)
    assert [model.points for model in scripted.begun] == [0.1]
    assert {model.points for model, _, _ in scripted.requested} == {chosen.components.points} == {0.1}
    assert chosen.decisions[0].in_words() == "points: kept, 7 pixels see a 3D point at a known distance"


def test_points_are_taken_where_there_is_no_time_for_a_start():
    scripted = Scripted(lambda c: 0.0)
    assert chosen_by(scripted, steps=100, facts=POINTED).components == Components(points=0.1)
    assert scripted.requested == []


@pytest.mark.parametrize("facts", [replace(POINTED, fixed=("points",)), replace(POINTED, has_alpha=True), FITTED])
def test_points_are_not_tried_where_the_user_decides_alpha_is_given_or_there_are_none(facts):
    scripted = Scripted(lambda c: 0.0)
    assert chosen_by(scripted, facts=facts).components.points == 0.0
    assert len(scripted.begun) == 1


@pytest.mark.parametrize(("far", "kept"), [(0.05, False), (0.15, True)])
def test_a_sky_that_signs_speak_for_is_kept_at_a_smaller_gain(far, kept):
    """Gains of 0.13 and 0.45 dB with two seeds: one to two standard errors above the least gain that counts."""
    scripted = Scripted(lambda c: 0.0, spread=0.0, far=far)
    scripted.go_on = lambda start, components, *, seed, steps: trial(  # type: ignore[method-assign]
        20.0 + seed + (0.13 if seed == 0 else 0.45) * (components.background == "sphere")
    )
    chosen = chosen_by(scripted, facts=replace(FITTED, fixed=("view",)))
    (sphere,) = (decision for decision in chosen.decisions if decision.component == "background")
    assert 1.0 < (present(sphere.gain_db) - 0.05) / present(sphere.error_db) < 2.0
    assert sphere.kept is kept


Gain = Callable[[Components], float]
# The gains of components, the components that are then chosen, and why a component, or a value of one, is kept or not.
SEARCHES: dict[str, tuple[Gain, Components, tuple[str, str] | None]] = {
    "what is needed stays": (lambda c: -0.5 * (c.view == 0), Components(), ("view", "it is needed")),
    # View dependence alone explains drifting exposures and would be kept; with learned exposures it is not needed.
    "what another does better is left out": (
        lambda c: 0.6 if c.exposure == "learned" else 0.5 * (c.view > 0),
        Components(view=0, exposure="learned"),
        None,
    ),
    "the better of two components that fix the same fault is kept": (
        lambda c: 0.6 if c.exposure == "learned" else 0.5 * (c.background == "sphere"),
        Components(view=0, exposure="learned"),
        ("background", "no gain above the noise, in addition to exposure"),
    ),
    "two that gain beside each other are both kept": (
        lambda c: 0.6 * (c.exposure == "learned") + 0.5 * (c.background == "sphere"),
        Components(view=0, exposure="learned", background="sphere"),
        None,
    ),
}


@pytest.mark.parametrize("case", SEARCHES)
def test_what_is_in_the_model_is_what_gains_beside_the_rest(case):
    gain, expected, why = SEARCHES[case]
    chosen = chosen_by(Scripted(gain))
    assert chosen.components == expected
    assert why is None or [d.why for d in chosen.decisions if d.component == why[0]] == [why[1]]


@pytest.mark.parametrize(("learned", "kept"), [(0.7, "exif"), (1.5, "learned")])
def test_of_two_values_of_a_component_the_second_is_kept_if_it_gains_beside_the_first(learned, kept):
    gains = {"none": 0.0, "exif": 0.9, "learned": learned}
    chosen = chosen_by(Scripted(lambda c: gains[c.exposure]), facts=replace(FITTED, has_alpha=True, has_exif=True))
    assert chosen.components.exposure == kept
    decided = {d.value: d.kept for d in chosen.decisions if d.component == "exposure"}
    assert decided == {value: value == kept for value in ("exif", "learned")}


def test_what_there_was_no_time_for_stays_as_it_is():
    """A fifth of the steps is for the start, a tenth for each trial: two without a change, two with exposures, and two
    with a sky beside them leave two, and removing view would take more."""
    scripted = Scripted(lambda c: 0.4 * (c.exposure == "learned") + 0.4 * (c.background == "sphere"))
    chosen = chosen_by(scripted, steps=1000)
    assert len(scripted.requested) <= 8
    assert chosen.components == Components(exposure="learned", background="sphere")
    assert {d.component: d.why for d in chosen.decisions}["view"] in (NO_TIME, COSTS_MORE)


def test_too_few_steps_are_not_spent():
    scripted = Scripted(lambda c: 1.0)
    chosen = chosen_by(scripted, steps=100)
    assert (chosen.components, chosen.decisions, scripted.requested) == (Components(), (), [])


def test_a_training_ends_even_if_its_preparation_took_all_of_its_budget():
    budget = Budget(10.0, None)
    assert [budget.progress(0, 12.0, before=12.0), budget.progress(9, 13.0, before=12.0)] == [0.0, 1.0]
    assert budget.progress(5, 6.0, before=2.0) == 0.5


def test_short_trainings_are_not_searched_for():
    assert not Budget(9.0, None).allows_trials
    assert Budget(60.0, None).allows_trials
    assert not Budget(None, 3000).allows_trials
    assert Budget(None, 5000).allows_trials
    assert not Budget(600.0, 300).allows_trials  # the shorter of both
    assert not Budget(9.0, 5000).allows_trials
    assert Budget(600.0, 5000).of_search().of_start() == Budget(18.0, 150)


def test_a_decision_says_in_words_what_was_and_what_was_not_tried():
    tried = Decision("view", 3, 0.5, 0.1, 0.2, -0.02, 0.5, True, "gains")
    assert tried.in_words() == "view=3: kept, +0.50 ± 0.10 dB, 2 % less time; gains"


def test_cameras_are_tried_where_photos_disagree_or_give_no_evidence():
    """Known cameras are not tried; for unknown ones, matched features may say that they fit, or that they do not."""

    def tried(facts: Facts) -> list[object]:
        return [value for name, value in changes_of(proposals(Components(), signs(0.0), facts)[0]) if name == "cameras"]

    unknown = replace(FITTED, cameras_known=None)
    assert tried(FITTED) == []
    assert tried(unknown) == ["poses"]
    reported = [d.value for d in proposals(Components(), signs(0.0), unknown)[1] if d.component == "cameras"]
    assert reported == ["focal"]
    assert tried(replace(unknown, fixed=("cameras",))) == []
    assert tried(replace(unknown, cameras=CameraCheck(0.001, 0.001, (0.3, 0.3), 900))) == []
    assert tried(replace(unknown, cameras=CameraCheck(0.02, 0.01, (2.3, 2.2), 900))) == ["poses"]


@pytest.mark.parametrize(
    ("check", "kept"),
    [
        (CameraCheck(-0.019, 0.0006, (0.26, 0.14), 900), True),
        (CameraCheck(-0.019, 0.005, (0.26, 0.14), 900), False),  # not sure
        (CameraCheck(0.045, 0.006, (0.22, 0.26), 900), False),  # sure, but nothing fits better
        (CameraCheck(0.002, 0.0001, (0.26, 0.14), 900), False),  # next to nothing
        (CameraCheck(0.08, 0.007, (1.15, 1.1), 900), False),  # poses are wrong, too
        (CameraCheck(0.0, math.inf, (1.1, 1.1), 900), False),  # no length within reach is best
    ],
)
def test_a_focal_length_that_matched_features_are_sure_of_is_taken(check, kept):
    facts = replace(FITTED, cameras_known=None, cameras=check)
    components, log_focal, (decision,) = with_known_cameras(Components(), facts)
    assert components == Components(cameras="focal" if kept else "fixed")
    assert log_focal == (check.log_focal if kept else 0.0)
    assert decision.kept == kept
    changed = f"{100 * abs(math.expm1(check.log_focal)):.2f} % (±"
    said = changed if math.isfinite(check.error) else "miss by 1.10 px, and by more at other"
    assert said in decision.in_words()
    assert with_known_cameras(Components(), replace(facts, fixed=("cameras",))) == (Components(), 0.0, [])
    assert with_known_cameras(Components(), FITTED) == (Components(), 0.0, [])
    for requested in (Components(cameras="focal"), Components(cameras="all")):
        components, log_focal, decisions = with_known_cameras(requested, replace(facts, fixed=("cameras",)))
        assert components == requested  # the request is kept, and starts where features say
        assert log_focal == (check.log_focal if kept else 0.0)
        assert [one.in_words().startswith(f"cameras={requested.cameras}: kept, ") for one in decisions] == [True] * kept


@pytest.mark.parametrize("error", [0.007, math.inf])
def test_poses_with_which_features_surely_miss_are_refined_without_a_trial(error):
    facts = replace(FITTED, cameras_known=None, cameras=CameraCheck(0.02, error, (2.3, 1.3), 900))
    components, log_focal, (focal, poses) = with_known_cameras(Components(), facts)
    assert (components, log_focal) == (Components(cameras="poses"), 0.0)
    assert (focal.value, focal.kept, poses.value, poses.kept) == ("focal", False, "poses", True)
    said = "cameras=poses: kept, 900 matched features miss by at least 1.30 px at any focal length"
    assert poses.in_words() == said
    assert "cameras" not in dict(changes_of(proposals(components, signs(0.0), facts)[0]))
    assert with_known_cameras(Components(), replace(facts, fixed=("cameras",)))[0] == Components()
    between = replace(facts, cameras=CameraCheck(0.02, error, (2.3, 1.19), 900))
    assert with_known_cameras(Components(), between)[0] == Components()


def test_poses_that_are_decided_on_learn_in_no_trial():
    scripted = Scripted(lambda c: 0.5 * (c.exposure == "learned"))
    facts = replace(FITTED, cameras_known=None, cameras=CameraCheck(0.0, math.inf, (2.3, 2.3), 900))
    chosen = select(scripted, Components(cameras="poses"), facts, Budget(None, 4000))  # type: ignore[arg-type]
    assert chosen.components == Components(cameras="poses", exposure="learned", view=0)
    assert {model.cameras for model in (*scripted.begun, *(model for model, _, _ in scripted.requested))} == {"fixed"}


def test_what_is_clear_is_not_tried_again_and_what_is_surely_missed_neither():
    """A gain of 2 dB takes one trial with it and one without; a loss of 0.5 dB without view takes one trial."""
    scripted = Scripted(lambda c: 2.0 * (c.background == "sphere") - 0.5 * (c.view == 0), spread=0.0)
    chosen = chosen_by(scripted)
    assert chosen.components == Components(background="sphere")
    assert [seed for _, seed, _ in scripted.requested] == [0, 0, 0]


def test_what_gains_once_is_not_kept_where_no_time_is_left_to_try_it_again():
    """A fifth of the steps is for the start and a tenth for each trial: with one trial without a change and one with
    poses, none is left for the second seed."""
    facts = replace(FITTED, cameras_known=None, has_alpha=True)
    scripted = Scripted(lambda c: 0.3 * (c.cameras == "poses"), spread=0.0)
    chosen = select(scripted, Components(), facts, Budget(None, 500))  # type: ignore[arg-type]
    assert chosen.decisions == ()  # no start
    start = present(scripted.begin(Components(), Budget(None, 250)))
    search = Search(scripted, start, Components(), budget=Budget(None, 600), began=0.0)  # type: ignore[arg-type]
    search.run([Candidate(("cameras", "poses"), "seen", ADDITION), Candidate(("view", 1), "", ADDITION)])
    assert [(one.kept, one.why) for one in search.decisions.values()] == [(False, ONCE), (False, NO_TIME)]
    assert len(scripted.requested) == 2


@pytest.mark.parametrize(("spread", "seeds"), [(0.1, 2), (0.12, 1)])
def test_exposures_that_signs_speak_for_are_clear_with_one_seed(spread, seeds):
    """0.4 dB: four standard errors with one seed. Where photos differ much in brightness, two are enough."""
    scripted = Scripted(lambda c: 0.4 * (c.exposure == "learned"), spread=spread, far=0.0)
    chosen = chosen_by(scripted, facts=replace(FITTED, fixed=("view",)))
    assert chosen.components == Components(exposure="learned")
    assert len(scripted.requested) == 2 * seeds


@pytest.mark.parametrize(("steps", "tried"), [(4000, True), (2000, False)])
def test_leaving_something_out_is_tried_where_that_costs_little(steps, tried):
    """Four trials of half a start of 250 steps have to be within 13 % of the search."""
    scripted = Scripted(lambda c: 0.0, spread=0.0, far=0.0)
    chosen = chosen_by(scripted, steps=steps)
    assert chosen.components.view == (0 if tried else 3)
    assert bool(scripted.requested) is tried
    (view,) = (decision for decision in chosen.decisions if decision.component == "view")
    assert (view.why == COSTS_MORE) is not tried


def test_a_long_search_does_not_make_a_long_start():
    scripted = Scripted(lambda c: 0.0)
    chosen_by(scripted, steps=100_000)
    assert {steps for _, _, steps in scripted.requested} == {MOST_START_STEPS // 2}


def test_leaving_out_may_not_use_up_a_limit_of_time_but_may_use_up_steps():
    """Starts of 125 steps in a second: a removal may begin in the first 65 % of the time, minus that of its trials."""
    scripted = Scripted(lambda c: 0.0)
    start = present(scripted.begin(Components(), Budget(None, 125)))
    view = Candidate(("view", 0), "", REMOVAL)
    for budget, began, tried in (
        (Budget(100.0, None), time.perf_counter() - 60.0, True),
        (Budget(100.0, None), time.perf_counter() - 64.0, False),
        (Budget(None, 2100), 0.0, True),
        (Budget(100.0, 200), time.perf_counter(), False),
    ):
        search = Search(scripted, start, Components(), budget=budget, began=began)  # type: ignore[arg-type]
        search.run([view])
        assert (search.decisions[view.change].why != NO_TIME) is tried


@pytest.mark.parametrize(("gain", "kept"), [(0.04, True), (-0.04, True), (-0.3, False)])
def test_cameras_whose_photos_disagree_only_must_not_lose(gain, kept):
    """Features miss by 2 pixels, so even +-0.04 dB, less than others have to gain, suffices. All photos gain alike."""
    wrong = replace(FITTED, cameras_known=None, cameras=CameraCheck(0.02, 0.01, (2.3, 2.2), 900))
    chosen = chosen_by(Scripted(lambda c: gain * (c.cameras == "poses"), spread=0.0), facts=wrong)
    assert chosen.components.cameras == ("poses" if kept else "fixed")
    unknown = replace(wrong, cameras=None)
    chosen = chosen_by(Scripted(lambda c: gain * (c.cameras == "poses"), spread=0.0), facts=unknown)
    assert chosen.components.cameras == "fixed"


def test_what_is_supported_must_not_lose_more_than_its_error():
    base = [trial(20.0), trial(20.0)]
    for gains, kept in (((0.05, 0.01), True), ((0.03, -0.05), True), ((-0.01, -0.05), False)):
        decision = judged(base, [trial(20.0 + gain) for gain in gains], SURE)
        assert decision.kept == kept  # mean m and distance d of two seeds: m > -d / 2


BOTH = Components(points=0.1, stereo=True)
SEEN = replace(FITTED, points=900, stereo=80_000)
# What photos show besides points and depths from stereo, and the components with which a training then begins.
EVIDENCE: list[tuple[dict[str, Any], Components]] = [
    ({}, BOTH),
    ({"stereo": 0}, Components(points=0.1)),
    ({"fixed": ("stereo",)}, Components(points=0.1)),
    ({"fixed": ("points",)}, Components()),
    ({"has_alpha": True}, Components()),
    ({"cameras": CameraCheck(0.0, 0.001, (0.3, 0.3), 1000)}, BOTH),
    ({"cameras": CameraCheck(0.0, 0.001, (0.7, 0.7), 1000)}, Components()),
    ({"exposure_spread": 0.1}, BOTH),
    ({"exposure_spread": 0.26, "photos": 16}, replace(BOTH, exposure="matched")),
    ({"exposure_spread": 0.26, "photos": 17}, replace(BOTH, exposure="learned")),
    ({"exposure_spread": 0.26, "has_alpha": True}, Components()),
    ({"occluded_fraction": 0.013}, replace(BOTH, occluders=True)),
    ({"occluded_fraction": 0.013, "fixed": ("occluders",)}, BOTH),
    ({"occluded_fraction": 0.013, "has_alpha": True}, Components()),
    ({"sky_confirmed": True}, replace(BOTH, background="sphere")),
    ({"sky_confirmed": True, "fixed": ("background",)}, BOTH),
]


@pytest.mark.parametrize(("shown", "expected"), EVIDENCE, ids=str)
def test_a_training_begins_with_what_photos_support(shown, expected):
    components, decisions = with_evidence(Components(), replace(SEEN, **shown))
    assert components == expected
    assert all(decision.kept for decision in decisions)


def test_evidence_is_reported_in_words():
    facts = replace(SEEN, exposure_spread=0.26, occluded_fraction=0.013, sky_fraction=0.2, sky_confirmed=True)
    assert [decision.seen for decision in with_evidence(Components(), facts)[1]] == [
        "900 pixels see a 3D point at a known distance",
        "several photos agree on the depth of 80,000 pixels",
        "photos differ by 0.38 stops at the same points",
        "1.3 % of the pixels hide surfaces that other photos see",
        "20 % of the pixels look like a sky, with hardly any surface in front",
    ]


def test_evidence_changes_nothing_that_was_requested():
    fixed = replace(SEEN, exposure_spread=0.26, fixed=("points", "exposure"))
    requested = Components(points=0.3, exposure="exif")
    assert with_evidence(requested, fixed)[0] == replace(requested, stereo=True)
    assert with_evidence(Components(cameras="poses"), SEEN)[0].points == 0.0
    checked = CameraCheck(0.0, 0.001, (0.3, 0.3), 1000)
    assert may_use_points(Components(points=0.2), ("points",), has_alpha=True, cameras=checked)


def test_what_evidence_has_decided_is_not_tried():
    facts = replace(SEEN, has_exif=True, exposure_spread=0.26)
    for known in (replace(BOTH, exposure="matched"), replace(BOTH, exposure="learned")):
        assert "exposure" not in [d.component for d in proposals(known, signs(0.0), facts)[1]]  # not declined, too
        assert "exposure" not in dict(changes_of(proposals(known, signs(0.3, 0.0), facts)[0]))
    sky = replace(SEEN, sky_fraction=0.2, sky_confirmed=True)
    tried, _ = proposals(Components(background="sphere"), signs(0.0, 0.3), sky)
    assert ("background", "sphere") not in changes_of(tried)


def test_a_sky_that_pixels_look_like_is_tried_and_kept_if_it_does_not_lose():
    change = ("background", "sphere")
    nearby = signs(0.0, 0.0)
    assert change not in changes_of(proposals(Components(), nearby, replace(FITTED, sky_fraction=0.04))[0])
    facts = replace(FITTED, sky_fraction=0.2)
    assert proposals(Components(), nearby, facts)[0][0] == Candidate(change, "20 % of the pixels look like a sky", SURE)
    assert change not in changes_of(proposals(Components(), nearby, replace(facts, has_alpha=True))[0])
    assert change not in changes_of(proposals(Components(), nearby, replace(facts, fixed=("background",)))[0])
