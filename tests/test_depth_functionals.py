"""Depth conventions against quadrature and float64, and in degenerate cases."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerfcli.kernels import RayTermination, numba_cpu
from nerfcli.kernels.reference import depth
from nerfcli.render.depth import DepthRequest, disagreement, fractions, requested, spread


def ray(seed, count=5, scale=1.0):
    g = torch.Generator().manual_seed(seed)
    edges = torch.rand(count + 1, generator=g, dtype=torch.float64).cumsum(0) + 0.5
    density = torch.rand(count, generator=g, dtype=torch.float64) * 3 * scale
    return density, edges[:-1], edges[1:], torch.tensor([0, count])


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


def quadrature_of_end_density(density, starts, ends, steps=20000):
    """Return the integrals of p(t), t p(t) and t^2 p(t), p = T sigma, for a piecewise constant density, by the midpoint
    rule."""
    moments, tau = np.zeros(3), 0.0
    for s, t0, t1 in zip(density, starts, ends, strict=True):
        h = (t1 - t0) / steps
        t = t0 + (np.arange(steps) + 0.5) * h
        p = s * np.exp(-(tau + s * (t - t0)))
        moments += np.stack([p, t * p, t * t * p]).sum(1) * h
        tau += s * (t1 - t0)
    return moments


@pytest.mark.parametrize("seed", range(4))
def test_mean_and_spread_are_those_of_the_end_density(seed):
    """Against the integrals of p(t), t p(t) and t^2 p(t) by a fine midpoint rule, whose error is about 1e-9."""
    density, starts, ends, offsets = ray(seed)
    light = depth.ray_termination(density, starts, ends, offsets=offsets, fractions=())
    mean = light.mean.item()
    mass, first, second = quadrature_of_end_density(density.numpy(), starts.numpy() - mean, ends.numpy() - mean)
    assert light.opacity.item() == pytest.approx(mass, rel=1e-8)
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


def test_median_crossing_in_a_later_interval_and_through_a_gap():
    density = torch.tensor([0.2, 0.0, 1.0], dtype=torch.float64)
    starts = torch.tensor([1.0, 2.0, 5.0], dtype=torch.float64)
    ends = torch.tensor([2.0, 3.0, 9.0], dtype=torch.float64)
    median = depth.quantile(density, starts, ends, offsets=torch.tensor([0, 3]), fraction=0.5)
    assert median.item() == pytest.approx(5.0 + math.log(2) - 0.2, rel=1e-14)


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
    """Weights that are equal to the last bit, in the definition and in the compiled kernel."""
    density, starts = torch.tensor([1e-30, 1e-30, 1e-30]), torch.tensor([1.0, 3.0, 5.0])
    for module in (depth, numba_cpu):
        light = module.ray_termination(density, starts, starts + 1, offsets=torch.tensor([0, 3]), fractions=())
        assert light.peak.tolist() == [1.5]


def test_light_that_passes_counts_at_the_background():
    """Points at 1, 2 and 3 that stop 1/2, 1/4 and 3/16 of the light, 5/3 away in the mean: the rest, 1/16, ends at the
    background."""
    mean, left = (torch.tensor([value], dtype=torch.float64) for value in (5 / 3, 1 / 16))
    ends = RayTermination(1 - left, left, mean, mean, mean, mean.new_empty(1, 0))
    means = [("moment", 4.0, 25 / 16), ("background", 4.0, 29 / 16), ("background", 100.0, 7.8125)]
    for convention, far, wanted in means:
        request = DepthRequest(convention, "ray", background_distance=far)
        found = requested(request, ends, background_distance=mean.new_tensor([far]))
        assert found.item() == pytest.approx(wanted, rel=1e-15)
