"""The plain-torch definitions against slow loops, closed forms, float64 and laws."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerfcli import kernels
from nerfcli.kernels import March, Rays, reference
from nerfcli.kernels.contraction import cube_widths
from nerfcli.training.open_cells import training_points


@given(seed=st.integers(0, 2**32 - 1), cut=st.integers(0, 6), at=st.floats(0.01, 0.99))
def test_splitting_an_interval_changes_nothing(seed, cut, at):
    g = torch.Generator().manual_seed(seed)
    (density, lengths), rgb = (torch.rand(shape, generator=g, dtype=torch.float64) for shape in ((2, 7), (7, 3)))
    density, background = (6 * density - 3).exp(), torch.ones(3, dtype=torch.float64)
    whole, behind, _ = reference.composite(density, rgb, lengths, offsets=torch.tensor([0, 7]), background=background)
    cut_one = lengths[cut : cut + 1]
    parts = torch.cat([lengths[:cut], cut_one * at, cut_one * (1 - at), lengths[cut + 1 :]])
    density, rgb = (torch.cat([x[: cut + 1], x[cut:]]) for x in (density, rgb))
    split, behind2, _ = reference.composite(density, rgb, parts, offsets=torch.tensor([0, 8]), background=background)
    torch.testing.assert_close(split, whole, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(behind2, behind, rtol=1e-12, atol=1e-14)


RESOLUTIONS = (4, 7, 40)
ROWS = 512  # the first two levels fit densely (125 vertices, and 512), the last is hashed


def test_hash_encode_leaves_levels_out():
    table = torch.rand(3, ROWS, 2, dtype=torch.float64, requires_grad=True)
    points = torch.rand(50, 3, dtype=torch.float64)
    encoded = reference.hash_encode(points, table, (4, 0, 40))
    whole = reference.hash_encode(points, table, RESOLUTIONS)
    assert torch.equal(encoded, whole * torch.tensor([1, 1, 0, 0, 1, 1]))
    (gradient,) = torch.autograd.grad(encoded.sum(), table)
    assert (gradient != 0).any((1, 2)).tolist() == [True, False, True]


def test_hash_encode_fades_levels_finer_than_a_pixel():
    # Closed form: a pixel as wide as n cells of a level leaves 1 / n of it, one narrower than a cell leaves all.
    table = torch.rand(3, ROWS, 2, dtype=torch.float64)
    points = torch.rand(5, 3, dtype=torch.float64)
    widths = torch.tensor([0.0, 1 / 40, 1 / 7, 0.5, 1e30], dtype=torch.float64)
    left = torch.tensor([[1, 1, 1], [1, 1, 1], [1, 1, 7 / 40], [1 / 2, 2 / 7, 1 / 20], [0, 0, 0]]).double()
    whole = reference.hash_encode(points, table, RESOLUTIONS)
    faded = reference.hash_encode(points, table, RESOLUTIONS, widths)
    torch.testing.assert_close(faded, whole * left.repeat_interleave(2, dim=1))


@pytest.mark.parametrize("contraction", kernels.CONTRACTIONS)
@pytest.mark.parametrize("radius", [1e-3, 0.9, 1.1, 30.0, 1e6])
def test_widths_are_those_of_a_short_line_across(contraction, radius):
    # Against `grid_coordinates` of both ends of a line across the direction from the centre.
    point = torch.tensor([[0.0, -radius, 0.0]], dtype=torch.float64)
    across = torch.tensor([[radius * 1e-6, 0.0, 0.0]], dtype=torch.float64)
    ends = [kernels.grid_coordinates(point + half * across, contraction) for half in (-0.5, 0.5)]
    width = cube_widths(point, across.norm(dim=-1), contraction)
    torch.testing.assert_close(width, (ends[1] - ends[0]).norm(dim=-1), rtol=1e-6, atol=0)


def test_hash_encode_gradcheck_in_points_inside_cells(generator):
    table = torch.randn(3, 64, 4, generator=generator, dtype=torch.float64)
    points = torch.rand(6, 3, generator=generator, dtype=torch.float64)
    resolutions = (2, 5, 11)
    places = torch.cat([points * resolution for resolution in resolutions])
    assert ((places - places.round()).abs() > 1e-3).all(), "a step of gradcheck would cross a face"
    points.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: reference.hash_encode(p, table, resolutions), points)


def test_hash_encode_says_what_is_wrong():
    with pytest.raises(ValueError, match="must have 2 levels"):
        reference.hash_encode(torch.rand(1, 3), torch.rand(3, 64, 2), (2, 3))
    with pytest.raises(ValueError, match="power of two, got 60"):
        reference.hash_encode(torch.rand(1, 3), torch.rand(1, 60, 2), (2,))


def test_contraction_leaves_the_unit_ball_and_bounds_the_rest():
    g = torch.Generator().manual_seed(0)
    inside = torch.nn.functional.normalize(torch.randn(50, 3, generator=g, dtype=torch.float64), dim=-1) * 0.999
    assert torch.equal(kernels.contract(inside), inside)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=g, dtype=torch.float64), dim=-1)
    for radius in (1.0, 2.0, 1e3, 1e10):
        contracted = kernels.contract(directions * radius)
        torch.testing.assert_close(contracted, directions * (2 - 1 / radius), rtol=1e-12, atol=0)


@given(seed=st.integers(0, 2**32 - 1), log_radius=st.floats(-6, 3))
def test_contraction_round_trip(seed, log_radius):
    g = torch.Generator().manual_seed(seed)
    point = torch.nn.functional.normalize(torch.randn(1, 3, generator=g, dtype=torch.float64), dim=-1)
    point = point * 10**log_radius
    for contraction in kernels.CONTRACTIONS:
        again = training_points(kernels.grid_coordinates(point, contraction), contraction)
        torch.testing.assert_close(again, point, rtol=1e-11 * max(1.0, 10**log_radius), atol=1e-15)


def test_march_keeps_what_is_occupied():
    # A ray along x through the cube [-1, 1]^3 with its last octant slab occupied: only intervals with x > 0.5.
    occupied = torch.zeros(4, 4, 4, dtype=torch.bool)
    occupied[:, :, 3] = True
    edges = torch.linspace(0.0, 4.0, 42, dtype=torch.float64)
    starts, ends, offsets = reference.march(
        Rays(
            torch.tensor([[-1.5, 0.1, 0.1], [-1.5, 5.0, 0.0]], dtype=torch.float64),
            torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(2, 3),
            torch.tensor([0.25, 0.25], dtype=torch.float64),
        ),
        March(edges, occupied, "none", math.inf),
    )
    middles = (starts + ends) / 2 - 1.5
    assert offsets.tolist() == [0, len(starts), len(starts)]  # the second ray misses the cube
    assert ((middles >= 0.5) & (middles <= 1.0)).all()
    cuts = edges[:-1] + 0.25 * (edges[1] - edges[0])
    all_middles = (cuts[1:] + cuts[:-1]) / 2 - 1.5
    kept = (all_middles >= 0.5) & (all_middles <= 1.0)
    torch.testing.assert_close(starts, cuts[:-1][kept], rtol=1e-12, atol=0)
    torch.testing.assert_close(ends, cuts[1:][kept], rtol=1e-12, atol=0)


def test_march_with_everything_occupied_covers_the_ray():
    edges = torch.tensor([0.1, 0.2, 0.4, 0.8, 1.6, 3.2], dtype=torch.float64)
    starts, ends, offsets = reference.march(
        Rays(
            torch.zeros(1, 3, dtype=torch.float64),
            torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
            torch.zeros(1, dtype=torch.float64),
        ),
        March(edges, torch.ones(2, 2, 2, dtype=torch.bool), "l2", math.inf),
    )
    assert offsets.tolist() == [0, 4]
    torch.testing.assert_close(starts, edges[:4])
    torch.testing.assert_close(ends, edges[1:5])
