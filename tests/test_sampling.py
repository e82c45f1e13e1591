"""Step schedules."""

import pytest
import torch

from nerfcli.render.trained_field import Marching


def test_equal_steps_cover_near_to_far():
    edges = Marching(1.0, 2.0, shortest_step=0.1, growth=0.0).edges()
    assert edges[0] == 1.0
    assert edges[-2] >= 2.0
    torch.testing.assert_close(edges.diff(), torch.full_like(edges[1:], 0.1), rtol=1e-9, atol=0)


def test_steps_grow_with_distance():
    edges = Marching(0.1, 300.0, shortest_step=0.01, growth=0.05).edges()
    steps = edges.diff()
    # A constant fraction of the distance up to 1, equal steps in 1 / distance beyond.
    expected = (edges[:-1] * edges[:-1].clamp_min(1.0) * 0.05).clamp_min(0.01)
    torch.testing.assert_close(steps, expected, rtol=1e-9, atol=0)
    assert edges[-2] >= 300.0


@pytest.mark.parametrize(("near", "far", "step"), [(1.0, 1.0, 0.1), (-1.0, 1.0, 0.1), (0.0, 1.0, 0.0)])
def test_impossible_steps_are_refused(near, far, step):
    with pytest.raises(ValueError, match="0 <= near < far and a positive step"):
        Marching(near, far, shortest_step=step, growth=0.0).edges()
