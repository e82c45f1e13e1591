"""Short trainings from a common start, and the signs in residuals before any trial."""

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from pools import pool_of_photos
from present import present

from nerfcli.captures.capture import Capture
from nerfcli.field.exposure import exposed
from nerfcli.photos.loading import load_photos
from nerfcli.training.extent import BALLS_BEFORE_BACKGROUND, Extent, choose_extent
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import Budget
from nerfcli.training.step import light_from_beyond
from nerfcli.training.trials import Trials, TrialStart, diagnose

SETTINGS = TrainSettings(budget_seconds=None, steps=100, first_samples_per_step=2**11, threads=1)


@pytest.fixture(scope="module")
def trials(spheres) -> Trials:
    return Trials(inputs_of(spheres))


def inputs_of(scene: Capture) -> TrainingInputs:
    extent = choose_extent(scene, SETTINGS, is_object=True)
    photos = load_photos(scene.train_frames, factor=4, threads=1)
    return TrainingInputs(SETTINGS, extent, pool_of_photos(photos, extent.training_from_scene))


def fitting_of(trials: Trials, components: Components) -> Fitting:
    """Return a fresh training on the pixels of trials."""
    settings = replace(trials._inputs.settings, components=components)
    return Fitting(replace(trials._inputs, settings=settings))


@pytest.fixture(scope="module")
def start(trials) -> Iterator[TrialStart]:
    """A start early in a schedule, without closing cells: within a few dozen steps they would leave nothing to see."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nerfcli.training.trials.FORK_PROGRESS", 0.02)
        patch.setattr("nerfcli.training.schedule.CLOSING_ENDS", 1e9)
        yield trials.begin(Components(view=0), Budget(None, 20))


def test_what_begins_late_changes_nothing_at_first(trials, start):
    """Harmonics begin with weight 0 and gains with 1: before any further step, changed components keep the errors."""
    same = trials.go_on(start, Components(view=0), seed=0, steps=0)
    # Which levels learn is set by a step.
    assert same.errors.sum() == pytest.approx(start.trial.errors.sum(), rel=2e-5)
    assert np.array_equal(trials.go_on(start, Components(view=3), seed=0, steps=0).errors, same.errors)
    free = trials.go_on(start, Components(view=0, cameras="poses"), seed=0, steps=0)
    assert free.errors == pytest.approx(same.errors, rel=1e-6)  # rays are rotated by 0, with rounding
    # EXIF says that all exposures are equal.
    exif = trials.go_on(start, Components(view=0, exposure="exif"), seed=0, steps=0)
    assert exif.errors == pytest.approx(same.errors, rel=1e-3)


def test_trials_with_the_same_seed_are_the_same_and_leave_their_start_alone(trials, start):
    first, again = (trials.go_on(start, Components(view=0), seed=3, steps=4) for _ in range(2))
    assert np.array_equal(first.errors, again.errors)
    assert not np.array_equal(first.errors, trials.go_on(start, Components(view=0), seed=4, steps=4).errors)


def clock(monkeypatch: pytest.MonkeyPatch, seconds: Iterable[float]) -> list[int]:
    """Make each step do nothing but report the next of `seconds`; return the list of steps taken, which grows."""
    times, gone = iter(seconds), []

    def advance(self: Trials, fitting: Fitting, fraction: float) -> float:
        fitting.step += 1
        gone.append(fitting.step)
        return next(times)

    monkeypatch.setattr(Trials, "_advance", advance)
    return gone


def test_a_start_takes_longer_for_the_fewest_steps_but_twice_as_long_at_most(trials, monkeypatch):
    """A clock on which every step takes a second."""
    gone = clock(monkeypatch, itertools.repeat(1.0))
    for fewest, steps in ((0, 10), (7, 10), (14, 14)):
        assert trials.begin(Components(), Budget(10.0, 1000), fewest=fewest).trial.steps == steps
    assert trials.begin(Components(), Budget(10.0, 1000), fewest=24) is None
    assert gone[-1] == 20
    assert trials.begin(Components(), Budget(10.0, 5), fewest=50) is None
    assert gone[-1] == 5


def test_a_start_that_cannot_come_to_the_fewest_steps_ends_at_once(trials, monkeypatch):
    """Steps take a second, except that every fifth takes ten, as under other load on the machine."""
    gone = clock(monkeypatch, itertools.cycle([1.0, 1.0, 1.0, 1.0, 10.0]))
    assert trials.begin(Components(), Budget(100.0, 1000), fewest=260) is None
    assert gone[-1] == 10
    assert trials.begin(Components(), Budget(100.0, 1000), fewest=240) is None
    assert gone[-1] > 60  # at first the fewest steps seem possible


def test_the_learning_rate_falls_by_half_a_cosine_after_its_warm_up(trials):
    """Values by hand: from 0.01 to 0.001, the mean of both halfway."""
    fitting = fitting_of(trials, Components(view=0))
    assert fitting.schedule.learning_rate(0.0, step=0) == pytest.approx(0.01 / 50)
    rates = [fitting.schedule.learning_rate(progress, step=1000) for progress in (0.0, 0.25, 0.5, 1.0, 1.5)]
    assert rates == pytest.approx([0.01, 0.001 + 0.009 * (0.5 + 0.125**0.5), 0.0055, 0.001, 0.001])


def test_trials_have_the_small_tables_of_short_trainings(spheres):
    for given, used in ((18, 16), (8, 8)):
        inputs = inputs_of(spheres)
        trials = Trials(replace(inputs, settings=replace(SETTINGS, log2_rows=given)))
        fitting = fitting_of(trials, Components(view=0))
        assert fitting.field.settings.to_json()["log2_rows"] == used


@pytest.mark.parametrize(
    ("rows_of_large", "cameras", "learning"),
    [(16, "fixed", [4, 6, 8]), (17, "fixed", [4, 4, 4]), (16, "poses", [3, 3, 3])],
)
def test_large_tables_have_their_levels_by_steps(trials, monkeypatch, rows_of_large, cameras, learning):
    """In tables that count as large, half of 4 steps open all 8 levels, even at fraction 0 of a budget, and their rows
    move; but learned cameras keep the field coarse at first."""
    monkeypatch.setattr("nerfcli.field.hash_field.DETAILED_LOG2_ROWS", rows_of_large)
    monkeypatch.setattr("nerfcli.training.schedule.LARGE_TABLE_STEPS", 4)
    fitting = fitting_of(trials, Components(view=0, cameras=cameras))
    rows = present(fitting.field.rows())
    fresh = rows.detach().clone()
    moved = []
    for _ in learning:
        fitting.advance(0.0)
        moved.append(int((rows != fresh).any(2).any(1).sum()))
    assert moved == learning


def test_cameras_learn_from_the_fork_on(trials, start, monkeypatch):
    """A step at the fork, after 0.02 of the budget, does not move the cameras; a later one does."""
    made: list[Fitting] = []
    monkeypatch.setattr(
        "nerfcli.training.trials.Fitting", lambda *args, **named: made.append(Fitting(*args, **named)) or made[-1]
    )
    trials.go_on(start, Components(view=0, cameras="poses"), seed=0, steps=0)
    (fitting,) = made
    motions = present(present(fitting.appearance.cameras).poses).motions
    given = motions.clone()
    fitting.advance(0.02)
    assert torch.equal(motions, given)
    fitting.advance(0.8)
    assert not torch.equal(motions, given)


@pytest.mark.parametrize("distance", [0.3, 1.1, math.inf])
def test_light_from_beyond_a_distance_is_what_passes_until_there(spheres, monkeypatch, distance):
    """Closed form for fog of density sigma: exp(-sigma t), where t is the distance from the middle of the first step to
    the middle of the last step before the given distance."""
    inputs = inputs_of(spheres)
    trials = Trials(replace(inputs, extent=replace(inputs.extent, contraction="l2")))
    fitting = fitting_of(trials, Components(view=0))
    monkeypatch.setattr(fitting.ray_steps, "edges", lambda stride: torch.linspace(0.1, 1.4, 14))
    sigma = 0.1

    class Fog:
        def density(self, coordinates: torch.Tensor) -> torch.Tensor:
            return torch.full_like(coordinates[:, 0], sigma)

        def radiance(
            self, coordinates: torch.Tensor, directions: torch.Tensor, rays: torch.Tensor
        ) -> tuple[torch.Tensor, torch.Tensor]:
            return self.density(coordinates), torch.zeros_like(coordinates)

    monkeypatch.setattr(fitting.field, "medium", lambda detail: Fog())
    found = light_from_beyond(fitting, trials._pool.rays_of(torch.arange(50)), fitting.plan, distance=distance + 0.01)
    assert found.tolist() == pytest.approx([math.exp(-sigma * (min(distance, 1.4) - 0.2))] * 50, rel=1e-5)


def test_trials_use_the_lens_found_before(spheres):
    """Matches give focal lengths 5 % longer: learned lenses start from these, so their rays are closer together."""
    trials = Trials(replace(inputs_of(spheres), log_focal=math.log(1.05)))
    fitting = fitting_of(trials, Components(cameras="focal"))
    drawn = trials._pool.rays_of(torch.tensor([0, trials._pool.cameras[0].width - 1]))

    def width(directions: torch.Tensor) -> float:
        axis = trials._pool.poses[0, :3, 2].to(directions)
        across = directions / (directions @ axis)[:, None]
        return float((across[1] - across[0]).norm())

    refined = fitting.appearance.refine_cameras(drawn).directions
    assert width(refined) == pytest.approx(width(drawn.directions) / 1.05, rel=1e-5)


def test_blocks_that_judge_are_not_learned_from(trials):
    drawn = trials._pool.draw(20_000, torch.Generator().manual_seed(0)).numbers
    assert not set(drawn.tolist()) & set(trials._scored.numbers.tolist())


def test_the_brightness_of_photos_is_found_among_highlights_and_noise():
    """Known gains; a fifth of the pixels are highlights 3 times as bright, all have noise of 2 levels."""
    generator = torch.Generator().manual_seed(0)
    photos = torch.arange(9).repeat_interleave(400)
    gains = torch.linspace(-0.4, 0.4, 9)[:, None] + torch.tensor([0.0, 0.1, -0.1])
    gains = gains - gains.mean(0)
    rendered = 0.2 + 0.3 * torch.rand(len(photos), 3, generator=generator)
    measured = exposed(rendered, gains[photos])
    brightened = torch.rand(len(photos), generator=generator) < 0.2
    measured[brightened] = exposed(measured[brightened], torch.tensor(math.log(3.0)))
    measured = (measured + 2 / 255 * torch.randn(measured.shape, generator=generator)).clamp(0.0, 1.0)
    signs = diagnose(rendered, measured, photos, directions=rendered, from_beyond=torch.zeros(len(photos)), count=9)
    assert (signs.log_gains - gains).abs().max() < 0.03
    assert signs.exposure_spread == pytest.approx(gains.mean(1).std().item(), abs=0.02)


def test_photos_of_one_exposure_have_no_spread_and_an_empty_photo_is_left_alone():
    generator = torch.Generator().manual_seed(0)
    photos = torch.arange(8).repeat_interleave(400)
    rendered = 0.2 + 0.3 * torch.rand(len(photos), 3, generator=generator)
    measured = rendered + 0.05 * torch.randn(rendered.shape, generator=generator)
    measured[photos == 5] = 1.0
    from_beyond = torch.linspace(0.0, 1.0, len(photos))
    signs = diagnose(rendered, measured.clamp(0.0, 1.0), photos, directions=rendered, from_beyond=from_beyond, count=8)
    assert signs.exposure_spread < 0.02
    assert signs.far_fraction == 0.5
    assert signs.log_gains[5].tolist() == [0.0] * 3


def test_the_field_ends_where_a_background_begins(trials):
    """It ends beyond the unit ball, seen from the farthest camera; without a learned background, or with pixels that
    show the sky, it is unchanged.
    """
    extent = replace(trials._inputs.extent, reach=2.0 + BALLS_BEFORE_BACKGROUND)
    ended = extent.before("sphere", sky_known=False)
    assert ended.marching.far == min(extent.marching.far, 3.5)
    assert replace(extent, reach=1e9).before("sphere", sky_known=False).marching == extent.marching
    assert extent.before("sphere", sky_known=True) is extent
    assert extent.before("auto", sky_known=False) is extent
    assert Extent.from_json(extent.to_json()).to_json() == extent.to_json()
    assert ended.before("constant", sky_known=False).to_json() == ended.to_json()
    # Photos with alpha: it is already bounded.
    assert trials._inputs.extent.before("sphere", sky_known=False) is trials._inputs.extent
