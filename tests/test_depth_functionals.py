"""The five depths against quadrature, float64, and at the points where they degenerate."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import quadrature_of_end_density

from nerfcli import kernels
from nerfcli.kernels import depth
from nerfcli.render.depth import DepthRequest, disagreement, requested, shares, spread


def ray(seed, count=5, scale=1.0):
    g = torch.Generator().manual_seed(seed)
    edges = torch.rand(count + 1, generator=g, dtype=torch.float64).cumsum(0) + 0.5
    density = torch.rand(count, generator=g, dtype=torch.float64) * 3 * scale
    return density, edges[:-1], edges[1:], torch.tensor([0, count])


@pytest.mark.parametrize("seed", range(4))
def test_moment_and_conditional_are_exact_for_piecewise_constant_density(seed):
    # Against the integral of t p(t) by a fine midpoint rule (error of the rule ~1e-9).
    density, starts, ends, offsets = ray(seed)
    mass, first = quadrature_of_end_density(density.numpy(), starts.numpy(), ends.numpy())
    weights, _ = kernels.interval_weights(density, ends - starts, offsets)
    means = depth.interval_means(density, starts, ends)
    assert depth.moment(weights, means, offsets).item() == pytest.approx(first, rel=1e-8)
    conditional = depth.conditional(weights, means, offsets)
    assert conditional.item() == pytest.approx(first / mass, rel=1e-8)


def test_one_place_per_interval_is_not_the_moment():
    # The opacity of one thick interval is exact, its midpoint is not where light ends.
    density, start, end = (torch.tensor([v], dtype=torch.float64) for v in (10.0, 1.0, 2.0))
    mean = depth.interval_means(density, start, end)
    assert mean.item() == pytest.approx(1 + 1 / 10 - 1 / math.expm1(10.0), rel=1e-14)
    assert abs(mean.item() - 1.5) > 0.4


@settings(deadline=None)  # the first call imports
@given(seed=st.integers(0, 2**32 - 1), cut=st.integers(0, 4), at=st.floats(0.01, 0.99))
def test_splitting_an_interval_moves_no_depth_but_max_weight(seed, cut, at):
    density, starts, ends, offsets = ray(seed)
    middle = starts[cut] + at * (ends[cut] - starts[cut])
    split = (
        torch.cat([density[: cut + 1], density[cut:]]),
        torch.cat([starts[: cut + 1], middle[None], starts[cut + 1 :]]),
        torch.cat([ends[:cut], middle[None], ends[cut:]]),
        torch.tensor([0, 6]),
    )
    for convention in (lambda *r: _conditional(*r), lambda d, s, e, o: depth.quantile(d, s, e, offsets=o, share=0.5)):
        torch.testing.assert_close(
            convention(*split), convention(density, starts, ends, offsets), rtol=1e-11, atol=0, equal_nan=True
        )


def _conditional(density, starts, ends, offsets):
    weights, _ = kernels.interval_weights(density, ends - starts, offsets)
    means = depth.interval_means(density, starts, ends)
    return depth.conditional(weights, means, offsets)


def test_mean_fraction_in_float32_across_magnitudes():
    x = torch.logspace(-12, 6, 2000, dtype=torch.float64).float()
    exact = depth.mean_fraction(x.double())
    assert ((depth.mean_fraction(x).double() - exact).abs() / exact).max() < 1e-6


def test_mean_fraction_branches_meet():
    below = torch.tensor([depth.SERIES_BELOW * (1 - 1e-15)], dtype=torch.float64)
    above = torch.tensor([depth.SERIES_BELOW], dtype=torch.float64)
    torch.testing.assert_close(depth.mean_fraction(below), depth.mean_fraction(above), rtol=1e-13, atol=0)


@pytest.mark.parametrize(("x", "slope"), [(0.0, -1 / 12), (1e-9, -1 / 12), (500.0, -1 / 500**2), (1e4, -1e-8)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_mean_fraction_gradient_at_the_extremes(x, slope, dtype):
    x = torch.tensor([x], dtype=dtype, requires_grad=True)
    (gradient,) = torch.autograd.grad(depth.mean_fraction(x), x)
    assert gradient.item() == pytest.approx(slope, rel=1e-5)


def test_mean_fraction_gradcheck_on_both_sides_of_the_series():
    x = torch.tensor([0.01, 0.2, 0.3, 2.0, 40.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(depth.mean_fraction, x)


def test_median_crossing_in_a_later_interval_and_through_a_gap():
    density = torch.tensor([0.2, 0.0, 1.0], dtype=torch.float64)
    starts = torch.tensor([1.0, 2.0, 5.0], dtype=torch.float64)
    ends = torch.tensor([2.0, 3.0, 9.0], dtype=torch.float64)
    median = depth.quantile(density, starts, ends, offsets=torch.tensor([0, 3]), share=0.5)
    assert median.item() == pytest.approx(5.0 + math.log(2) - 0.2, rel=1e-14)


def test_undefined_depths_are_nan_and_only_those():
    # Ray 0 is empty, ray 1 has opacity 0.1, ray 2 is opaque.
    offsets = torch.tensor([0, 0, 1, 2])
    density = torch.tensor([-math.log(0.9), 50.0], dtype=torch.float64)
    starts, ends = torch.tensor([1.0, 1.0], dtype=torch.float64), torch.tensor([2.0, 2.0], dtype=torch.float64)
    light = depth.light_ends(density, starts, ends, offsets=offsets, shares=(0.5,))

    def undefined(convention, min_opacity):
        request = DepthRequest(convention, "ray", min_opacity, 7.0)
        light = depth.light_ends(density, starts, ends, offsets=offsets, shares=shares(request))
        far = torch.full((3,), 7.0, dtype=torch.float64)
        return requested(request, light, background_distance=far).isnan().tolist()

    for convention in ("conditional", "max-weight", "median", "quantile:0.05"):
        assert undefined(convention, 0.5) == [True, True, False]
    for convention in ("conditional", "max-weight", "quantile:0.05"):
        assert undefined(convention, 0.0) == [True, False, False]
    assert undefined("median", 0.0) == [True, True, False]
    for convention in ("moment", "background"):
        assert undefined(convention, 1.0) == [False, False, False]
    assert spread(DepthRequest("moment", "ray", 0.05), light).isnan().tolist() == [True, False, False]
    assert disagreement(DepthRequest("moment", "ray", 0.05), light).isnan().tolist() == [True, True, False]


def test_conditional_gradient_is_bounded_in_empty_space():
    # Zero density exactly: the value is NaN by definition, its gradient must not poison the rest.
    density = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    starts = torch.arange(3, dtype=torch.float64)
    weights, _ = kernels.interval_weights(density, torch.ones(3, dtype=torch.float64), torch.tensor([0, 3]))
    means = depth.interval_means(density, starts, starts + 1)
    values = depth.conditional(weights, means, torch.tensor([0, 3]))
    (gradient,) = torch.autograd.grad(torch.where(values.isnan(), 0.0, values).sum(), density)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().max() == 0


def test_max_weight_takes_the_nearest_of_equals():
    weights = torch.tensor([0.2, 0.3, 0.3, 0.1])
    means = torch.tensor([1.0, 2.0, 3.0, 4.0])
    nearest = depth.max_weight(weights, means, torch.tensor([0, 4]))
    assert nearest.tolist() == [2.0]
