"""Depth conventions against quadrature and float64, and in degenerate cases."""

import math
from decimal import Decimal, localcontext

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import quadrature_of_end_density

from nerfcli.kernels import RayTermination, numba_cpu, reference
from nerfcli.kernels.reference import depth
from nerfcli.render.depth import DepthRequest, disagreement, fractions, requested, spread


def ray(seed, count=5, scale=1.0):
    g = torch.Generator().manual_seed(seed)
    edges = torch.rand(count + 1, generator=g, dtype=torch.float64).cumsum(0) + 0.5
    density = torch.rand(count, generator=g, dtype=torch.float64) * 3 * scale
    return density, edges[:-1], edges[1:], torch.tensor([0, count])


@pytest.mark.parametrize("seed", range(4))
def test_moment_and_conditional_are_exact_for_piecewise_constant_density(seed):
    # Against the integral of t p(t) by a fine midpoint rule (error of the rule ~1e-9).
    density, starts, ends, offsets = ray(seed)
    mass, first, _ = quadrature_of_end_density(density.numpy(), starts.numpy(), ends.numpy())
    weights, _ = reference.interval_weights(density, ends - starts, offsets)
    means = depth.interval_means(density, starts, ends)
    assert depth.moment(weights, means, offsets).item() == pytest.approx(first, rel=1e-8)
    conditional = depth.conditional(weights, means, offsets)
    assert conditional.item() == pytest.approx(first / mass, rel=1e-8)


@given(seed=st.integers(0, 2**32 - 1), cut=st.integers(0, 4), at=st.floats(0.01, 0.99), exponent=st.floats(-12.0, 6.0))
def test_splitting_an_interval_changes_nothing_but_max_weight(seed, cut, at, exponent):
    density, starts, ends, offsets = ray(seed, scale=10.0**exponent)
    middle = starts[cut] + at * (ends[cut] - starts[cut])
    split = depth.ray_termination(
        torch.cat([density[: cut + 1], density[cut:]]),
        torch.cat([starts[: cut + 1], middle[None], starts[cut + 1 :]]),
        torch.cat([ends[:cut], middle[None], ends[cut:]]),
        offsets=torch.tensor([0, 6]),
        fractions=(0.05, 0.5, 0.9),
    )
    whole = depth.ray_termination(density, starts, ends, offsets=offsets, fractions=(0.05, 0.5, 0.9))
    for name in ("opacity", "transmittance", "mean", "spread", "quantiles"):
        # Lengths are differences of distances, which are below 6.
        torch.testing.assert_close(
            getattr(split, name), getattr(whole, name), rtol=1e-11, atol=1e-14 if name == "spread" else 0,
            equal_nan=True, msg=lambda text, name=name: f"{name}: {text}",
        )  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_spread_is_the_standard_deviation_of_the_end_density(seed):
    density, starts, ends, offsets = ray(seed)
    light = depth.ray_termination(density, starts, ends, offsets=offsets, fractions=())
    mean = light.mean.item()
    mass, first, second = quadrature_of_end_density(density.numpy(), starts.numpy() - mean, ends.numpy() - mean)
    assert first / mass == pytest.approx(0, abs=1e-8)
    assert light.spread.item() == pytest.approx(math.sqrt(second / mass), rel=1e-7)


@pytest.mark.parametrize("fraction", [depth.mean_fraction, depth.variance_fraction])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 2e-14), (torch.float32, 2e-6)])
def test_fractions_across_magnitudes_against_sixty_digits(fraction, dtype, tolerance):
    x = torch.cat([torch.logspace(-12, 6, 400, dtype=dtype), torch.linspace(0.2, 1.2, 200, dtype=dtype)])
    with localcontext() as context:
        context.prec = 60
        values = [Decimal(value) for value in x.double().tolist()]
        if fraction is depth.mean_fraction:
            exact = [1 / v - 1 / (v.exp() - 1) for v in values]
        else:
            exact = [1 / (v * v) - v.exp() / (v.exp() - 1) ** 2 for v in values]
    wanted = torch.tensor([float(value) for value in exact], dtype=torch.float64)
    assert ((fraction(x).double() - wanted) / wanted).abs().max() < tolerance


@pytest.mark.parametrize(("x", "slope"), [(0.0, -1 / 12), (1e-9, -1 / 12), (500.0, -1 / 500**2), (1e4, -1e-8)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_mean_fraction_gradient_at_the_extremes(x, slope, dtype):
    x = torch.tensor([x], dtype=dtype, requires_grad=True)
    (gradient,) = torch.autograd.grad(depth.mean_fraction(x), x)
    assert gradient.item() == pytest.approx(slope, rel=1e-5)


def test_mean_fraction_gradcheck_on_both_sides_of_the_series():
    x = torch.tensor([0.01, 0.2, 0.3, 2.0, 40.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(depth.mean_fraction, x)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 30.0])
def test_gradcheck(scale):
    density, starts, ends, _ = ray(7, count=6, scale=scale)
    offsets = torch.tensor([0, 0, 2, 6])
    arguments = tuple(x.clone().requires_grad_() for x in (density, starts, ends))

    def function(*values):
        results = depth.ray_termination(*values, offsets=offsets, fractions=(0.001, 0.4))
        return tuple(result[~result.isnan()] for result in results)

    results = function(*arguments)
    assert min(map(len, results)) >= 2
    assert all(result.requires_grad for result in results)  # gradcheck passes over those that do not
    assert torch.autograd.gradcheck(function, arguments, atol=1e-7)


def test_gradients_are_finite_at_the_extremes():
    density = torch.tensor([0.0, 1e-12, 1e6, 0.0], dtype=torch.float64, requires_grad=True)
    starts = torch.arange(4, dtype=torch.float64)
    light = depth.ray_termination(density, starts, starts + 1, offsets=torch.tensor([0, 1, 4]), fractions=(0.5,))
    total = sum(torch.where(values.isnan(), 0.0, values).sum() for values in light)
    assert isinstance(total, torch.Tensor)
    (gradient,) = torch.autograd.grad(total, density)
    assert torch.isfinite(gradient).all()


def test_median_crossing_in_a_later_interval_and_through_a_gap():
    density = torch.tensor([0.2, 0.0, 1.0], dtype=torch.float64)
    starts = torch.tensor([1.0, 2.0, 5.0], dtype=torch.float64)
    ends = torch.tensor([2.0, 3.0, 9.0], dtype=torch.float64)
    median = depth.quantile(density, starts, ends, offsets=torch.tensor([0, 3]), fraction=0.5)
    assert median.item() == pytest.approx(5.0 + math.log(2) - 0.2, rel=1e-14)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradient_of_a_median_that_lies_on_an_edge(dtype):
    """The median is exactly at the end of the first of two equal slabs: its gradient is -1 / density for the first slab
    and 0 for the second. Minima that split the gradient between equal arguments once gave only part of this."""
    density = torch.full((2,), math.log(2), dtype=dtype, requires_grad=True)
    starts = torch.tensor([1.0, 2.0], dtype=dtype)
    median = depth.quantile(density, starts, starts + 1, offsets=torch.tensor([0, 2]), fraction=0.5)
    (gradient,) = torch.autograd.grad(median.sum(), density)
    assert median.item() == pytest.approx(2.0, rel=1e-6)
    assert gradient.tolist() == pytest.approx([-1 / math.log(2), 0.0], rel=1e-6)


def test_a_median_that_rounding_puts_into_thin_air_stays_inside_an_interval():
    """A wall's optical depth is one rounding below the median's, and 100 thin layers with gaps follow. The rounding
    equals the optical depth of sixty layers: divided by the density of one layer, it leads out of that layer."""
    target = torch.tensor(-math.log1p(-0.5))
    wall = torch.nextafter(target, torch.tensor(0.0))
    density = torch.cat([wall[None], torch.full((100,), 1e-6)])
    starts = torch.cat([torch.zeros(1), torch.arange(2.0, 102.0)])
    ends = starts + torch.cat([torch.ones(1), torch.full((100,), 2.0**-10)])
    median = depth.quantile(density, starts, ends, offsets=torch.tensor([0, 101]), fraction=0.5)
    assert ((starts <= median) & (median <= ends)).any()


def test_undefined_depths_are_nan_and_only_those():
    # Ray 0 is empty, ray 1 has opacity 0.1, ray 2 is opaque.
    offsets = torch.tensor([0, 0, 1, 2])
    density = torch.tensor([-math.log(0.9), 50.0], dtype=torch.float64)
    starts, ends = torch.tensor([1.0, 1.0], dtype=torch.float64), torch.tensor([2.0, 2.0], dtype=torch.float64)
    light = depth.ray_termination(density, starts, ends, offsets=offsets, fractions=(0.5,))

    def undefined(convention, min_opacity):
        request = DepthRequest(convention, "ray", min_opacity, 7.0)
        light = depth.ray_termination(density, starts, ends, offsets=offsets, fractions=fractions(request))
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


def test_max_weight_takes_the_nearest_of_equals():
    weights = torch.tensor([0.2, 0.3, 0.3, 0.1])
    means = torch.tensor([1.0, 2.0, 3.0, 4.0])
    nearest = depth.max_weight(weights, means, torch.tensor([0, 4]))
    assert nearest.tolist() == [2.0]
    # Weights that are equal to the last bit, in the definition and in the compiled kernel.
    density, starts = torch.tensor([1e-30, 1e-30, 1e-30]), torch.tensor([1.0, 3.0, 5.0])
    for module in (depth, numba_cpu):
        light = module.ray_termination(density, starts, starts + 1, offsets=torch.tensor([0, 3]), fractions=())
        assert light.peak.tolist() == [1.5]


def test_light_that_passes_counts_at_the_background():
    """Points at 1, 2 and 3 that stop 1/2, 1/4 and 3/16 of the light: the rest, 1/16, ends at the background."""
    offsets, places = torch.tensor([0, 3]), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    weights = torch.tensor([1 / 2, 1 / 4, 3 / 16], dtype=torch.float64)
    mean, left = depth.conditional(weights, places, offsets), torch.tensor([1 / 16], dtype=torch.float64)
    assert mean.item() == pytest.approx(5 / 3, rel=1e-15)
    ends = RayTermination(1 - left, left, mean, mean, mean, mean, mean.new_empty(1, 0))
    means = [("moment", 4.0, 25 / 16), ("background", 4.0, 29 / 16), ("background", 100.0, 7.8125)]
    for convention, far, wanted in means:
        request = DepthRequest(convention, "ray", background_distance=far)
        found = requested(request, ends, background_distance=mean.new_tensor([far]))
        assert found.item() == pytest.approx(wanted, rel=1e-15)
