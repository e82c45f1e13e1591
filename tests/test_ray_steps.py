"""Steps along rays: the schedule of a capture, and in the course of a training."""

from dataclasses import replace

import pytest
import torch
from trainings import prepared

from nerfcli.cameras.rigid import Similarity
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.voxel_field import VoxelFieldSettings
from nerfcli.render.trained_field import Marching
from nerfcli.training.extent import Extent, RaySteps, halvings
from nerfcli.training.fitting import Fitting
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import DETAILED_STEPS, stride

BALL = Marching(near=0.5, far=300.0, shortest_step=1 / 256, growth=1 / 128)
CUBE = Marching(near=0.5, far=4.0, shortest_step=1 / 128, growth=0.0)

CPU = torch.device("cpu")


def extent_of(marching: Marching) -> Extent:
    return Extent("l2", Similarity.identity(), marching)


def grid(finest: int, *, log2_rows: int = 17, contraction: str = "l2") -> HashFieldSettings:
    return HashFieldSettings(finest=finest, log2_rows=log2_rows, contraction=contraction)


@pytest.mark.parametrize(
    ("marching", "settings", "parallax", "times"),
    [
        # A step of 1/128 in a cube of side 4 is finest / 512 cells long, at distance 1 as anywhere else.
        (BALL, grid(1023), 1.0, 0),
        (BALL, grid(1024), 1.0, 1),
        (BALL, grid(2047), 1.0, 1),
        (BALL, grid(2048), 1.0, 2),
        (BALL, grid(4096), 1.0, 2),
        # From cameras that are close together, it is seen half as long.
        (BALL, grid(2047), 0.5, 0),
        (BALL, grid(2048), 0.5, 1),
        # The cube of a bounded field has a side of 2.
        (CUBE, grid(511, contraction="none"), 1.0, 0),
        (CUBE, grid(512, contraction="none"), 1.0, 1),
        # Trainings of small tables are too short, and other fields have no levels.
        (BALL, grid(4096, log2_rows=16), 1.0, 0),
        (BALL, VoxelFieldSettings(contraction="l2"), 1.0, 0),
    ],
)
def test_steps_are_halved_until_they_are_shorter_than_two_cells_at_most_twice(marching, settings, parallax, times):
    assert halvings(marching, settings, parallax) == times


@pytest.mark.parametrize(
    ("fraction", "step", "multiple"),
    [(0.0, 9999, 8), (0.05, 9999, 8), (0.06, 9999, 4), (0.15, 9999, 4), (0.16, 9999, 2), (0.4, 9999, 2),
     (0.41, 9999, 1), (0.51, 9999, 0.25), (1.0, 9999, 0.25), (1.0, DETAILED_STEPS * 2 // 5, 2), (1.0, 0, 8)],
)  # fmt: skip
def test_steps_begin_eight_times_as_long_as_those_of_the_capture_and_end_with_a_quarter(fraction, step, multiple):
    marching = Marching(near=1.0, far=3.0, shortest_step=1 / 128, growth=0.0)
    steps = RaySteps(extent_of(marching), grid(1024, contraction="none"), CPU)
    edges = steps.edges(stride(fraction, step))
    torch.testing.assert_close(edges.diff(), torch.full_like(edges[1:], multiple / 128), rtol=1e-4, atol=0)
    assert edges[0] == 1.0
    assert len(edges) - 1 <= steps.most + 1


def test_pictures_of_detailed_fields_have_at_most_half_of_the_steps_of_the_capture():
    for settings, part in ((grid(4096), 1 / 4), (grid(1024), 1 / 2), (grid(800), 1 / 2), (grid(4096, log2_rows=16), 1)):
        steps = RaySteps(extent_of(BALL), settings, CPU)
        assert steps.render_steps(stride(1.0, DETAILED_STEPS)) == BALL.stretched(part)
        # A training that ends before it gets to the shortest steps has not learned what they would show.
        assert steps.render_steps(stride(1.0, DETAILED_STEPS // 2)) == BALL.stretched(max(part, 1 / 2))


def test_a_training_sees_the_parallax_of_its_capture(spheres, tmp_path):
    # Steps of 2 sqrt(3) / 512 in a cube of side 2 are 3.46 cells long where 1024 fit along its side.
    inputs, _ = prepared(spheres, tmp_path, TrainSettings(budget_seconds=None, steps=10, log2_rows=17))
    assert inputs.extent.parallax == 1.0
    most = []
    for parallax in (1.0, 0.5):
        seen = Fitting(replace(inputs, extent=replace(inputs.extent, parallax=parallax)))
        most.append(seen.ray_steps.most)
    assert most[0] == pytest.approx(2 * most[1], abs=2)


@pytest.mark.parametrize(("near", "far", "step", "growth"), [(1.0, 2.0, 0.1, 0.0), (0.1, 300.0, 0.01, 0.05)])
def test_steps_grow_with_distance_and_cover_near_to_far(near, far, step, growth):
    """A constant fraction of the distance up to 1, equal steps in 1 / distance beyond; without growth, all alike."""
    edges = Marching(near, far, shortest_step=step, growth=growth).edges()
    expected = (edges[:-1] * edges[:-1].clamp_min(1.0) * growth).clamp_min(step)
    torch.testing.assert_close(edges.diff(), expected, rtol=1e-9, atol=0)
    assert edges[0] == near
    assert edges[-2] >= far


@pytest.mark.parametrize(("near", "far", "step"), [(1.0, 1.0, 0.1), (-1.0, 1.0, 0.1), (0.0, 1.0, 0.0)])
def test_impossible_steps_are_refused(near, far, step):
    with pytest.raises(ValueError, match="0 <= near < far and a positive step"):
        Marching(near, far, shortest_step=step, growth=0.0).edges()
