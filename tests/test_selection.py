"""Which components are kept: the rule on trials whose gain and noise are known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerfcli.train.components import Components
from nerfcli.train.selection import LEAST_GAIN_DB, judge, proposals, select
from nerfcli.train.trials import Trial

PHOTOS = 20


def trial(psnr: float, *, halfway: float | None = None, seconds: float = 1.0, noise_db: float = 0.0) -> Trial:
    """Every photo has the PSNR, give or take what cancels in the sum of their logarithms."""
    counts = np.full(PHOTOS, 300)
    away = noise_db * np.array([1.0, -1.0] * (PHOTOS // 2))

    def errors(dB: float) -> np.ndarray:
        return counts * 10.0 ** (-(dB + away) / 10.0)

    return Trial(errors(psnr), errors(psnr - 1.0 if halfway is None else halfway), counts, seconds, 100)


def test_a_gain_is_told_as_it_is_and_kept():
    (decision,) = judge([trial(20.0), trial(21.0)], [("view", 0, [trial(20.4), trial(21.6)])])
    assert decision.gain_db == pytest.approx(0.5, abs=1e-9)
    # Two seeds that differ by 0.2 dB: variance 0.02, of their mean 0.01; all photos gain the same.
    assert decision.error_db == pytest.approx(0.1, abs=1e-9)
    assert decision.kept
    assert decision.cost == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ([trial(19.0), trial(20.0)], "loses"),
        ([trial(20.0), trial(21.0)], "no gain above the noise"),
        ([trial(20.9), trial(21.1)], "no gain above the noise"),
        ([trial(20.4, halfway=20.2), trial(21.4, halfway=21.2)], "gains at first only"),
        ([trial(20.4, seconds=2.0), trial(21.4, seconds=2.0)], "gains less than the steps would that it costs"),
    ],
)
def test_what_is_not_kept_is_told_why(changed, why):
    (decision,) = judge([trial(20.0), trial(21.0)], [("view", 0, changed)])
    assert (decision.kept, decision.why) == (False, why)


def test_a_gain_that_rests_on_a_few_photos_is_not_clear():
    """One photo of twenty gains 10 dB, all others nothing: the jackknife's error is about as large as the gain."""
    base = [trial(20.0), trial(20.0)]
    errors = base[0].errors.copy()
    errors[3] *= 0.1
    lucky = Trial(errors, base[0].halfway, base[0].counts, 1.0, 100)
    (decision,) = judge(base, [("view", 0, [lucky, lucky])])
    assert decision.gain_db > 3 * LEAST_GAIN_DB
    assert decision.error_db == pytest.approx(decision.gain_db, rel=0.1)
    assert not decision.kept


@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.integers(0, 2**31))
def test_candidates_that_do_nothing_are_seldom_kept(first, second, seed):
    """Gains within the noise of seeds that is pooled over five candidates are never kept."""
    generator = np.random.default_rng(seed)
    base = [trial(20.0), trial(20.0)]
    tried = [("view", 0, [trial(20.0 + first), trial(20.0 + second)])]
    for _ in range(4):
        tried.append(("near", False, [trial(20.0 + 0.3), trial(20.0 - 0.3)]))
    generator.shuffle(tried)
    assert not any(decision.kept for decision in judge(base, tried))


def test_proposals_leave_alone_what_the_user_decided_and_what_is_there():
    named = {name for name, _ in proposals(Components(), has_alpha=False, photos=9, fixed=())}
    assert {"exposure", "background", "view"} <= named
    assert "view" not in {name for name, _ in proposals(Components(), has_alpha=False, photos=9, fixed=("view",))}
    assert "view" not in {name for name, _ in proposals(Components(view=0), has_alpha=False, photos=9, fixed=())}
    assert "background" not in {name for name, _ in proposals(Components(), has_alpha=True, photos=9, fixed=())}
    assert "exposure" not in {name for name, _ in proposals(Components(), has_alpha=False, photos=1, fixed=())}


class Scripted:
    """Trials that answer at once: view=0 gains 0.5 dB, near=False nothing."""

    def __init__(self) -> None:
        self.asked: list[tuple[Components, int, int | None]] = []

    def run(self, components: Components, *, seed: int, steps: int | None, seconds: float | None = None) -> Trial:
        self.asked.append((components, seed, steps))
        return trial(20.0 + seed + (0.5 if components.view == 0 else 0.0))


def test_what_is_kept_is_in_the_model_and_seeds_are_paired():
    scripted = Scripted()
    chosen = select(
        scripted,  # type: ignore[arg-type]
        Components(),
        [("view", 0), ("near", False)],
        seconds=60.0,
        steps=None,
    )
    assert chosen.components == Components(view=0)
    assert [decision.kept for decision in chosen.decisions] == [True, False]
    assert [seed for _, seed, _ in scripted.asked] == [0, 1] * 3
    assert {steps for _, _, steps in scripted.asked[1:]} == {100}
    assert math.isfinite(chosen.seconds)


def test_of_two_that_gain_the_same_only_one_is_kept():
    """view=0 and near=False each gain 0.5 dB, and both together no more than 0.4."""

    class Overlapping(Scripted):
        def run(self, components: Components, *, seed: int, steps: int | None, seconds: float | None = None) -> Trial:
            changed = (components.view == 0) + (not components.near)
            return trial(20.0 + seed + (0.0, 0.5, 0.4)[changed])

    chosen = select(
        Overlapping(),  # type: ignore[arg-type]
        Components(),
        [("view", 0), ("near", False)],
        seconds=60.0,
        steps=None,
    )
    assert chosen.components == Components(view=0)
    assert [decision.why for decision in chosen.decisions][1] == "no gain beside view"


def test_too_few_steps_are_not_spent():
    scripted = Scripted()
    chosen = select(scripted, Components(), [("view", 0)], seconds=None, steps=100)  # type: ignore[arg-type]
    assert (chosen.components, chosen.decisions, scripted.asked) == (Components(), (), [])
