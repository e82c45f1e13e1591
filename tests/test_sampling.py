"""Step schedules, stratified places and draws from a histogram."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerfcli.render.sampling import inverse_cdf, step_edges, stratified


def test_equal_steps_cover_near_to_far():
    edges = step_edges(1.0, 2.0, shortest_step=0.1, growth=0.0)
    assert edges[0] == 1.0
    assert edges[-2] >= 2.0
    torch.testing.assert_close(edges.diff(), torch.full_like(edges[1:], 0.1), rtol=1e-9, atol=0)


def test_steps_grow_with_distance():
    edges = step_edges(0.1, 300.0, shortest_step=0.01, growth=0.05)
    steps = edges.diff()
    # Equal shares of the distance up to 1, equal steps in 1 / distance beyond.
    expected = (edges[:-1] * edges[:-1].clamp_min(1.0) * 0.05).clamp_min(0.01)
    torch.testing.assert_close(steps, expected, rtol=1e-9, atol=0)
    assert edges[-2] >= 300.0


@pytest.mark.parametrize(("near", "far", "step"), [(1.0, 1.0, 0.1), (-1.0, 1.0, 0.1), (0.0, 1.0, 0.0)])
def test_impossible_steps_are_refused(near, far, step):
    with pytest.raises(ValueError, match="0 <= near < far and a positive step"):
        step_edges(near, far, shortest_step=step, growth=0.0)


def test_stratified_draws_stay_in_their_strata():
    near, far = torch.tensor([1.0, 0.0]), torch.tensor([3.0, 8.0])
    uniform = torch.rand(2, 16)
    places = stratified(near, far, uniform=uniform)
    strata = ((places - near[:, None]) / (far - near)[:, None] * 16).floor()
    assert torch.equal(strata, torch.arange(16.0).expand(2, 16))
    middle = stratified(near, far, uniform=torch.full((2, 2), 0.5))
    torch.testing.assert_close(middle, torch.tensor([[1.5, 2.5], [2.0, 6.0]]))


def test_histogram_of_draws_is_the_distribution():
    # Kolmogorov-Smirnov: the largest gap of the empirical distribution, of n draws, above 1.95 / sqrt(n) has p < 1e-3.
    g = torch.Generator().manual_seed(0)
    edges = torch.tensor([[0.0, 1.0, 1.5, 4.0, 5.0]], dtype=torch.float64)
    weights = torch.tensor([[0.1, 0.5, 0.0, 0.4]], dtype=torch.float64)
    draws = inverse_cdf(edges, weights, uniform=torch.rand(1, 20000, generator=g, dtype=torch.float64))[0].sort()[0]
    cdf = torch.tensor([0.0, 0.1, 0.6, 0.6, 1.0], dtype=torch.float64)
    bins = torch.searchsorted(edges[0], draws, right=True).clamp(1, 4)
    left, right = edges[0][bins - 1], edges[0][bins]
    expected = cdf[bins - 1] + (cdf[bins] - cdf[bins - 1]) * (draws - left) / (right - left)
    empirical = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
    assert (expected - empirical).abs().max() < 1.95 / 20000**0.5


@given(seed=st.integers(0, 2**32 - 1))
def test_draws_are_increasing_and_inside(seed):
    g = torch.Generator().manual_seed(seed)
    edges = torch.rand(3, 9, generator=g).cumsum(1)
    weights = torch.rand(3, 8, generator=g) * (torch.rand(3, 8, generator=g) > 0.5)
    uniform = torch.rand(3, 50, generator=g).sort(1)[0]
    uniform[:, 0], uniform[:, -1] = 0.0, 1.0
    draws = inverse_cdf(edges, weights, uniform=uniform)
    assert (draws.diff(dim=1) >= -1e-6).all()
    assert (draws >= edges[:, :1]).all()
    assert (draws <= edges[:, -1:]).all()


def test_no_draw_from_bins_without_weight():
    edges = torch.arange(5.0)[None]
    weights = torch.tensor([[0.0, 1.0, 0.0, 0.0]])
    draws = inverse_cdf(edges, weights, uniform=torch.tensor([[0.0, 0.3, 1.0 - 1e-7, 1.0]]))
    assert ((draws >= 1.0) & (draws <= 2.0)).all()


def test_a_ray_without_weight_is_drawn_uniformly():
    edges = torch.tensor([[0.0, 1.0, 4.0]])
    draws = inverse_cdf(edges, torch.zeros(1, 2), uniform=torch.tensor([[0.0, 0.25, 0.5, 1.0]]))
    torch.testing.assert_close(draws, torch.tensor([[0.0, 1.0, 2.0, 4.0]]))


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r"edges must be \(rays, 3\), got \(1, 4\)"):
        inverse_cdf(torch.zeros(1, 4), torch.zeros(1, 2), uniform=torch.zeros(1, 1))
