"""The compiled kernels against the reference in float64: value and gradient, across magnitudes, on odd sizes.

Gradients are compared as vectors (relative L2) and per element against the largest one.
"""

import numba
import numpy as np
import pytest
import torch
from numba.core import config
from present import present
from test_kernels import RELATIVE, assert_close

from nerfcli import kernels
from nerfcli.kernels import AdamStep, HashGrid, March, Rays, numba_cpu, reference
from nerfcli.kernels.numba_cpu import visible
from nerfcli.kernels.numba_cpu.exponential import exponential, sigmoid, sigmoid_slope
from nerfcli.kernels.numba_cpu.threads import use_threads


@pytest.fixture(params=[1, 2], ids=["1 thread", "2 threads"], autouse=True)
def threads(request):
    torch.set_num_threads(request.param)


# For tests that set the number of threads themselves, or use none.
once = pytest.mark.parametrize("threads", [1], ids=["1 thread"], indirect=True)


def test_hash_encode_takes_a_sink_and_known_values(generator):
    table = torch.randn(2, 64, 4, generator=generator, requires_grad=True)
    points = torch.rand(50, 3, generator=generator)
    plain = numba_cpu.hash_encode(points, table, (3, 30), None, None)
    plain.sum().backward()
    table_grad = torch.ones_like(table)
    computed = numba_cpu.hash_encode(points, table, (3, 30), table_grad, plain.detach())
    assert torch.equal(computed, plain)
    expected = 1 + present(table.grad)
    table.grad = None
    computed.sum().backward()
    assert table.grad is None
    assert_close(table_grad, expected, "sink")


def test_hash_encode_shows_coordinates_gone_bad(generator):
    """NaN, infinite and huge coordinates, beside good ones in the same vector, on dense and hashed levels."""
    table = torch.rand(2, 16, 4, generator=generator)
    points = torch.rand(20, 3, generator=generator)
    good = numba_cpu.hash_encode(points, table, (1, 64))
    odd = points.clone()
    odd[3, 1], odd[5, 0], odd[7, 2], odd[17] = torch.nan, torch.inf, -1e30, torch.nan
    found = numba_cpu.hash_encode(odd, table, (1, 64))
    assert found[[3, 17]].isnan().all()
    assert found[[5, 7]].isfinite().all()
    others = [i for i in range(20) if i not in (3, 5, 7, 17)]
    assert torch.equal(found[others], good[others])


WEIGHTS = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
RESOLUTIONS = (4, 5, 6, 7, 9, 11, 13, 16)
EMPTY = HashGrid(torch.zeros(8, 16, 4), (2,) * 8, tuple(torch.zeros(shape) for shape in WEIGHTS))


def random_rays(count: int, generator: torch.Generator, *, cones: bool = False) -> Rays:
    origins = torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    jitter = torch.rand(count, generator=generator)
    return Rays(origins, directions, jitter, torch.rand(count, generator=generator) if cones else None)


def random_grid(contrast: float, generator: torch.Generator, *, antialias: bool = False) -> HashGrid:
    weights = tuple(torch.randn(shape, generator=generator) * 0.3 for shape in WEIGHTS)
    table = torch.randn(8, 256, 4, generator=generator) * contrast
    return HashGrid(table, RESOLUTIONS, weights, antialias=antialias)


@pytest.mark.parametrize(
    ("rays", "contraction"),
    [(0, "l2"), (1, "l2"), (5, "none"), *((123, contraction) for contraction in kernels.CONTRACTIONS), (700, "l2")],
)
# Thin fog lets every ray through; at 8 the densities reach e^15, and some rays end in their first sample.
@pytest.mark.parametrize("contrast", [0.0, 1.0, 8.0])
@pytest.mark.parametrize(("with_cones", "least"), [(False, 0.0), (True, 0.0), (False, 1e-2)])
def test_visible_samples(rays, contraction, contrast, with_cones, least, generator):
    edges = torch.rand(60, generator=generator).cumsum(0) * 0.2
    occupied = torch.rand(8, 8, 8, generator=generator) > 0.4
    grid = random_grid(contrast, generator, antialias=with_cones)
    lines = random_rays(rays, generator, cones=with_cones)
    given = (lines, March(edges, occupied, contraction, 7.0, least), grid)
    cell_depths = torch.full((2, 8, 8, 8), -1.0)
    fast = numba_cpu.visible_samples(*given, cell_depths[0])
    exact = reference.visible_samples(*given, cell_depths[1])
    # Exponentials of sums of up to 15.
    torch.testing.assert_close(cell_depths[0], cell_depths[1], rtol=1e-4, atol=1e-12)
    # A midpoint that rounds into the neighbouring cell, or an optical depth that rounds across the limit, could be
    # kept by only one of the two; this does not happen for these seeds.
    assert torch.equal(fast[5], exact[5])
    names = ("starts", "ends", "density", "encoded", "coordinates")
    for name, actual, expected in zip(names, fast[:5], exact[:5], strict=True):
        relative = 5 * RELATIVE if name == "density" else RELATIVE
        assert_close(actual, expected, f"{name} of samples", relative=relative)
    if rays:
        depth = reference.optical_depth_before(fast[2], fast[1] - fast[0], fast[5])
        assert (depth < 7.0).all()


@pytest.mark.parametrize("least", [0.0, 1e-4, 1e-3, 0.1])
def test_visible_samples_leave_out_what_absorbs_little_light(least, generator):
    # Law: the kept samples are unchanged, and each sample that is left out absorbs less than `least` of the light.
    given, grid = random_rays(300, generator), random_grid(8.0, generator)
    edges = torch.rand(60, generator=generator).cumsum(0) * 0.2
    march = March(edges, torch.ones(8, 8, 8, dtype=torch.bool), "l2", 7.0)
    cell_depths = torch.full((2, 64, 64, 64), -1.0)
    every = numba_cpu.visible_samples(given, march, grid, cell_depths[0])
    kept = numba_cpu.visible_samples(given, march._replace(least_weight=least), grid, cell_depths[1])
    # A cell in which all samples are faint is known to be empty, not left open as if it had no samples.
    assert torch.equal(cell_depths[0], cell_depths[1])
    lengths = (every.ends - every.starts).double()
    weights, _ = reference.interval_weights(every.density.double(), lengths, every.offsets)
    before = reference.optical_depth_before(every.density.double(), lengths, every.offsets)
    bound = every.density * lengths * torch.exp(-before)
    places = {tuple(place) for place in kept.coordinates.tolist()}
    left_out = torch.tensor([tuple(place) not in places for place in every.coordinates.tolist()])
    assert left_out.sum() == len(every.starts) - len(kept.starts)
    assert bool(left_out.any()) == (least > 0.0)
    assert (weights[left_out] < least).all()
    assert (bound[~left_out] > 0.9999 * least).all()


@pytest.mark.parametrize("backend", [reference, numba_cpu])
def test_visible_samples_of_a_transparent_field_are_all_kept(backend, generator):
    # Otherwise no gradient would ever bring back a field that has become transparent.
    grid = HashGrid(torch.ones(8, 256, 4), RESOLUTIONS, (torch.ones(WEIGHTS[0]), -torch.ones(WEIGHTS[1])))
    march = March(torch.linspace(0.0, 2.0, 30), torch.ones(8, 8, 8, dtype=torch.bool), "l2", 7.0)
    given = random_rays(50, generator)._replace(origins=torch.zeros(50, 3))
    every = backend.visible_samples(given, march, grid)
    assert 0.0 < every.density.max() < 1e-6
    kept = backend.visible_samples(given, march._replace(least_weight=1e-3), grid)
    assert torch.equal(kept.starts, every.starts)


@pytest.mark.parametrize(
    ("side", "measured"), [(30, False), (30, True), (64, False), (64, True), (130, False), (256, False), (256, True)]
)
@pytest.mark.parametrize("contraction", kernels.CONTRACTIONS)
@pytest.mark.parametrize("steps", [2000, 150, 20])
def test_visible_samples_misses_no_lonely_cell(side, contraction, steps, measured, generator):
    # Nearly all blocks of cells are empty and skipped as a whole; steps are from a part of a block to many blocks long.
    # A side of 130 leaves a narrow last block. Against the reference, which evaluates every step.
    rays = 300 if steps > 20 else 3000
    origins = torch.randn(rays, 3, generator=generator)
    directions = torch.nn.functional.normalize(-origins + 0.5 * torch.randn(rays, 3, generator=generator), dim=-1)
    jitter = torch.rand(rays, generator=generator)
    occupied = torch.zeros(side, side, side, dtype=torch.bool)
    occupied.view(-1)[torch.randint(side**3, (side**3 // 500,), generator=generator)] = True
    distances = kernels.distances_to_occupied(occupied) if measured else None
    along = March(torch.linspace(0.0, 5.0, steps), occupied, contraction, 1e9, distances=distances)
    given = (Rays(origins, directions, jitter), along, EMPTY)
    fast, exact = numba_cpu.visible_samples(*given), reference.visible_samples(*given)
    assert len(exact[0]) > 20
    # A midpoint that rounds across a cell's border may differ; a lost block would be many samples.
    counts = [out[5].diff() for out in (fast, exact)]
    assert (counts[0] - counts[1]).abs().sum() <= 2


@pytest.mark.parametrize("room", [2**19, 5000])
def test_visible_samples_holds_many_rays_of_many_samples(room, generator, monkeypatch):
    # 80,000 samples, in order of rays, in fog so thin that no ray ends early; or more than there is room for at first.
    monkeypatch.setattr(visible, "USUAL_SAMPLES", room)
    rays, edges = 200, torch.linspace(0, 2, 402)
    origins = torch.tensor([0.0, 0.0, -1.0]).repeat(rays, 1)
    directions = torch.tensor([0.0, 0.0, 1.0]).repeat(rays, 1)
    along = March(edges, torch.ones(2, 2, 2, dtype=torch.bool), "none", 7.0)
    given = Rays(origins, directions, torch.zeros(rays))
    starts, ends, density, _, coordinates, offsets, *_ = numba_cpu.visible_samples(given, along, EMPTY)
    assert torch.equal(offsets, torch.arange(rays + 1) * 400)
    assert torch.equal(starts.view(rays, 400), edges[:400].expand(rays, 400))
    assert torch.equal(ends.view(rays, 400), edges[1:401].expand(rays, 400))
    assert (density == 1).all()
    torch.testing.assert_close(coordinates[:, 2], ((starts + ends) / 2).clamp(0, 2) / 2)


@pytest.mark.parametrize("decay", [0.0, 0.3])
def test_adam_rows_is_adam_where_every_row_is_touched(decay, generator):
    # Against torch's own Adam over five steps.
    parameter = torch.nn.Parameter(torch.randn(1, 20, 4, generator=generator))
    ours = [parameter.detach().clone(), *torch.zeros(3, 1, 20, 4)]
    optimiser = torch.optim.Adam([parameter], lr=0.01, betas=(0.9, 0.99), eps=1e-15, weight_decay=decay)
    for step in range(1, 6):
        gradient = torch.randn(1, 20, 4, generator=generator)
        parameter.grad = gradient.clone()
        optimiser.step()
        ours[1].copy_(gradient)
        numba_cpu.adam_rows(*ours, step=AdamStep(step, 0.01, (0.9, 0.99), 1e-15, decay))
    assert_close(ours[0], parameter.detach(), "table")


@once
def test_exponential_and_sigmoid_in_every_range():
    @numba.njit(error_model="numpy")
    def evaluate(x, values):
        for i in range(len(x)):
            values[0, i], values[1, i], values[2, i] = exponential(x[i]), sigmoid(x[i]), sigmoid_slope(x[i])

    tiny = np.geomspace(1e-30, 1.0, 5000)
    x = np.concatenate([np.linspace(-87.0, 87.0, 200_001), tiny, -tiny, [0.0]]).astype(np.float32)
    values = np.empty((3, len(x)), np.float32)
    evaluate(x, values)
    exact = x.astype(np.float64)
    tail = np.exp(-np.abs(exact))
    for actual, expected in zip(values, (np.exp(exact), 1 / (1 + np.exp(-exact)), tail / (1 + tail) ** 2), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=3e-7)

    odd = np.array([np.nan, np.inf, -np.inf, 1e30, -1e30], np.float32)
    values = np.empty((3, len(odd)), np.float32)
    evaluate(odd, values)
    assert np.isnan(values[:, 0]).all()  # so that a number gone bad is found
    assert np.isfinite(values[:, 1:]).all()


@once
def test_numba_follows_when_the_thread_count_changes():
    limit = int(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    # Numba's own count used to stay where the last loop had left it, and loops that asked for two threads got one.
    for wanted in (1, 2, 1, 2):
        torch.set_num_threads(wanted)
        assert use_threads() == numba.get_num_threads() == min(wanted, limit)
