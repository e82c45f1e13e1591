"""Numbers in closed form that every implementation must reproduce, in float64 and float32, each with its trap."""

import math

import pytest
import torch
from kernel_parts import parts_for

from nerfcli.field.fourier_field import fourier_features
from nerfcli.kernels import RayTermination
from nerfcli.kernels.reference import depth
from nerfcli.render.depth import DepthRequest, requested

DTYPES = [torch.float64, torch.float32]
OFFSETS = torch.tensor([0, 3])


def close(actual, expected, dtype):
    torch.testing.assert_close(
        torch.as_tensor(actual, dtype=dtype),
        torch.as_tensor(expected, dtype=dtype),
        rtol=8 * torch.finfo(dtype).eps,
        atol=4 * torch.finfo(dtype).eps,
    )


@pytest.fixture(params=DTYPES, ids=["float64", "float32"])
def dtype(request):
    return request.param


@pytest.fixture
def slabs(dtype):
    """Unit slabs of densities log 2, log 2, log 4; red, green, blue."""
    density = torch.tensor([math.log(2), math.log(2), math.log(4)], dtype=dtype)
    return density, torch.eye(3, dtype=dtype), torch.ones(3, dtype=dtype)


def test_slabs_weights_transmittance_and_colour(slabs, dtype):
    density, rgb, lengths = slabs
    colour, transmittance, weights = parts_for(dtype).composite(
        density, rgb, lengths, offsets=OFFSETS, background=torch.ones(3, dtype=dtype)
    )
    close(weights, [1 / 2, 1 / 4, 3 / 16], dtype)
    close(transmittance, [1 / 16], dtype)
    close(colour, [[9 / 16, 5 / 16, 4 / 16]], dtype)
    close(weights.sum() + transmittance[0], 1.0, dtype)
    entering = torch.exp(-parts_for(dtype).optical_depth_before(density, lengths, OFFSETS))
    close(entering, [1.0, 1 / 2, 1 / 4], dtype)
    close(-torch.expm1(-density * lengths), [1 / 2, 1 / 2, 3 / 4], dtype)


def test_depths_of_slabs_at_points(slabs, dtype):
    # Depths 1, 2, 3 are given: each convention gives a different number.
    density, _, lengths = slabs
    weights, transmittance = parts_for(dtype).interval_weights(density, lengths, OFFSETS)
    places = torch.tensor([1.0, 2.0, 3.0], dtype=dtype)
    close(depth.moment(weights, places, OFFSETS), [25 / 16], dtype)
    close(weights.sum(), 15 / 16, dtype)
    mean = depth.conditional(weights, places, OFFSETS)
    close(mean, [5 / 3], dtype)
    peak = depth.max_weight(weights, places, OFFSETS)
    close(peak, [1.0], dtype)
    none = mean.new_empty(1, 0)
    ends = RayTermination(1 - transmittance, transmittance, mean, mean, peak, weights.max()[None], none)
    for far in (4.0, 100.0):
        request = DepthRequest("background", "ray", background_distance=far)
        close(requested(request, ends, background_distance=mean.new_tensor([far])), [25 / 16 + far / 16], dtype)


def test_median_of_slabs_is_inside_the_interval(slabs, dtype):
    # T falls to 1/2 exactly at the end of the first slab, t = 1; with twice the density, half way through it.
    density, _, lengths = slabs
    starts = torch.tensor([0.0, 1.0, 2.0], dtype=dtype)
    close(depth.quantile(density, starts, starts + lengths, offsets=OFFSETS, fraction=0.5), [1.0], dtype)
    close(depth.quantile(2 * density, starts, starts + lengths, offsets=OFFSETS, fraction=0.5), [0.5], dtype)


def test_gradients_of_the_slabs(slabs, dtype):
    density, rgb, lengths = slabs
    density.requires_grad_()
    rgb.requires_grad_()
    colour, _, weights = parts_for(dtype).composite(
        density, rgb, lengths, offsets=OFFSETS, background=torch.ones(3, dtype=dtype)
    )
    by_density = torch.stack([torch.autograd.grad(colour[0, c], density, retain_graph=True)[0] for c in range(3)])
    # B_2 = (1/4, 1/4, 1) is all that is behind the second slab, background included.
    close(by_density[:, 1], [-1 / 16, 3 / 16, -1 / 4], dtype)
    by_red = torch.autograd.grad(colour[0, 0], rgb)[0]
    close(by_red[:, 0], weights.detach(), dtype)


def test_fourier_features(dtype):
    at_zero = fourier_features(torch.zeros(1, dtype=dtype), 3)
    close(at_zero, [0, 1, 0, 1, 0, 1], dtype)
    at_quarter = fourier_features(torch.full((1,), 0.25, dtype=dtype), 3)
    close(at_quarter[:4], [math.sqrt(2) / 2, math.sqrt(2) / 2, 1, 0], dtype)
    torch.testing.assert_close(
        at_quarter[4:], torch.tensor([0, -1], dtype=dtype), rtol=0, atol=4 * torch.finfo(dtype).eps
    )
