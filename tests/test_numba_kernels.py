"""The compiled kernels against the reference in float64: value and gradient, across magnitudes, on odd sizes.

Gradients are compared as vectors (relative L2) and per element against the largest one.
"""

import numba
import numpy as np
import pytest
import torch
from numba.core import config

from nerfcli import kernels
from nerfcli.kernels import AdamStep, BearingGrids, HashGrid, March, PixelTable, Rays, numba_cpu, reference
from nerfcli.kernels.numba_cpu import visible
from nerfcli.kernels.numba_cpu.exponential import exponential, sigmoid, sigmoid_slope
from nerfcli.kernels.numba_cpu.threads import use_threads

SIZES = [0, 1, 5, 123, 3000]
RELATIVE = 1e-5


def assert_close(actual, expected, name, relative=RELATIVE, floor=1e-30):
    assert actual is not None, name
    actual, expected = actual.double(), expected.double()
    assert actual.shape == expected.shape, name
    if actual.numel() == 0:
        return
    assert torch.isfinite(actual).all(), name
    error = actual - expected
    assert error.norm() <= relative * expected.norm() + floor, (name, error.norm() / expected.norm())
    assert error.abs().max() <= relative * expected.abs().max() + floor, name


def offsets_of(samples, generator):
    """Return the offsets of rays with random numbers of samples, some with none."""
    cuts = torch.randint(0, samples + 1, (max(1, samples // 7),), generator=generator).sort()[0]
    return torch.cat([torch.tensor([0]), cuts, cuts[-1:], torch.tensor([samples])])


@pytest.fixture(params=[1, 2], ids=["1 thread", "2 threads"], autouse=True)
def threads(request):
    torch.set_num_threads(request.param)
    yield
    torch.set_num_threads(2)


# For tests that set the number of threads themselves, or use none.
once = pytest.mark.parametrize("threads", [1], ids=["1 thread"], indirect=True)


@pytest.mark.parametrize("samples", SIZES)
@pytest.mark.parametrize("magnitude", [1e-6, 1.0, 1e6])
def test_hash_encode(samples, magnitude, generator):
    resolutions = (4, 7, 0, 40, 700)  # the second has as many vertices as the table has rows, the third is left out
    table = torch.randn(5, 512, 4, generator=generator) * magnitude
    points = torch.rand(samples, 3, generator=generator) * 1.2 - 0.1  # some are clamped
    gradient = torch.randn(samples, 20, generator=generator)
    for feature in range(4):
        gradient[feature::5, [i for i in range(20) if i % 4 != feature]] = 0.0  # only one feature has a gradient
    fast, exact = table.clone().requires_grad_(), table.double().requires_grad_()
    encoded = numba_cpu.hash_encode(points, fast, resolutions, None, None)
    encoded.backward(gradient)
    # The oracle gets the coordinates as the kernel sees them: scaled in float32, where 700 cells cost 3 digits.
    assert_close(encoded, reference.hash_encode(points, table, resolutions), "encoded")
    reference.hash_encode(points.double(), exact, resolutions).backward(gradient.double())
    same_precision = table.clone().requires_grad_()
    reference.hash_encode(points, same_precision, resolutions).backward(gradient)
    assert_close(fast.grad, same_precision.grad, "table gradient")
    widths = torch.rand(samples, generator=generator).pow(4)
    faded = table.clone().requires_grad_()
    encoded = numba_cpu.hash_encode(points, faded, resolutions, None, None, widths)
    encoded.backward(gradient)
    assert_close(encoded, reference.hash_encode(points, table, resolutions, widths), "encoded, with widths")
    same_precision.grad = None
    reference.hash_encode(points, same_precision, resolutions, widths).backward(gradient)
    assert_close(faded.grad, same_precision.grad, "table gradient, with widths")
    if samples and fast.grad is not None and exact.grad is not None:
        # Compared with float64, the position inside a cell is off by 700 * eps; so are weights and gradients.
        assert (fast.grad.double() - exact.grad).norm() <= 700 * 2e-7 * exact.grad.norm()


@pytest.mark.parametrize("samples", SIZES)
@pytest.mark.parametrize("magnitude", [1e-6, 1.0, 1e6])
def test_hash_encode_by_points(samples, magnitude, generator):
    resolutions = (4, 7, 0, 40, 700)
    table = torch.randn(5, 512, 4, generator=generator) * magnitude
    points = torch.rand(samples, 3, generator=generator) * 1.2 - 0.1
    points[::7, 0], points[1::7, 1] = 0.0, 1.0  # on the border the slope is that of the inside
    gradient = torch.randn(samples, 20, generator=generator)
    fast, same_precision, exact = (
        points.to(t).clone().requires_grad_() for t in (torch.float32,) * 2 + (torch.float64,)
    )
    numba_cpu.hash_encode(fast, table, resolutions, None, None).backward(gradient)
    reference.hash_encode(same_precision, table, resolutions).backward(gradient)
    reference.hash_encode(exact, table.double(), resolutions).backward(gradient.double())
    assert_close(fast.grad, same_precision.grad, "gradient by points")
    outside = (points < 0) | (points > 1)
    assert fast.grad is not None
    assert not fast.grad[outside].any()
    if samples == 5:  # few enough that none lies on a face where rounding chooses another cell
        assert_close(fast.grad, exact.grad, "gradient by points, against float64", relative=1e-3)
    widths = torch.rand(samples, generator=generator).pow(4)
    fast.grad, same_precision.grad = None, None
    numba_cpu.hash_encode(fast, table, resolutions, None, None, widths).backward(gradient)
    reference.hash_encode(same_precision, table, resolutions, widths).backward(gradient)
    assert_close(fast.grad, same_precision.grad, "gradient by points, with widths")


def test_hash_encode_takes_a_sink_and_known_values(generator):
    table = torch.randn(2, 64, 4, generator=generator, requires_grad=True)
    points = torch.rand(50, 3, generator=generator)
    plain = numba_cpu.hash_encode(points, table, (3, 30), None, None)
    plain.sum().backward()
    table_grad = torch.ones_like(table)
    computed = numba_cpu.hash_encode(points, table, (3, 30), table_grad, plain.detach())
    assert torch.equal(computed, plain)
    assert table.grad is not None
    expected = 1 + table.grad
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


def test_hash_encode_reads_no_row_that_is_no_vertex():
    table = torch.full((1, 512, 4), torch.nan)
    table[0, :125] = 1.0
    points = torch.tensor([[1.0, 1.0, 1.0], [0.0, 1.0, 0.5], [7.0, -3.0, 1.0]])
    assert torch.equal(numba_cpu.hash_encode(points, table, (4,), None, None), torch.ones(3, 4))


WEIGHTS = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
EMPTY = HashGrid(torch.zeros(8, 16, 4), (2,) * 8, tuple(torch.zeros(shape) for shape in WEIGHTS))


def test_radiance_ends_where_the_logarithm_of_a_density_does():
    # Weights that carry the first feature through, one path for each sign.
    weights = tuple(torch.zeros(shape) for shape in WEIGHTS)
    weights[0][0, 0], weights[0][1, 0], weights[1][0, 0], weights[1][0, 1] = 1.0, -1.0, 1.0, -1.0
    encoded = torch.zeros(4, 32)
    encoded[:, 0] = torch.tensor([-60.0, -16.0, 16.0, 60.0])
    wanted = torch.tensor([-15.0, -15.0, 15.0, 15.0]).exp()
    rays = torch.zeros(4, dtype=torch.int64)
    torch.testing.assert_close(numba_cpu.radiance(encoded, torch.zeros(1, 16), rays, weights)[0], wanted)
    torch.testing.assert_close(numba_cpu.density(encoded, weights), wanted)


@pytest.mark.parametrize("samples", SIZES)
# At 0.4 the input of the sigmoid reaches 20 to 40, and its float32 rounding of 2e-6 carries through.
@pytest.mark.parametrize("magnitude", [1e-4, 0.2, 0.4])
def test_radiance_and_density(samples, magnitude, generator):
    encoded = torch.randn(samples, 32, generator=generator)
    harmonics = torch.randn(9, 16, generator=generator)
    rays = torch.randint(9, (samples,), generator=generator).sort()[0]
    weights = [torch.randn(shape, generator=generator) * magnitude for shape in WEIGHTS]
    by_density, by_rgb = torch.randn(samples, generator=generator), torch.randn(samples, 3, generator=generator)

    def run(function, dtype):
        inputs = [x.to(dtype).clone().requires_grad_() for x in (encoded, harmonics, *weights)]
        density, rgb = function(inputs[0], inputs[1], rays, tuple(inputs[2:]))
        (density @ by_density.to(dtype) + (rgb * by_rgb.to(dtype)).sum()).backward()
        return density.detach(), rgb.detach(), *(x.grad for x in inputs)

    fast, exact = run(numba_cpu.radiance, torch.float32), run(reference.radiance, torch.float64)
    names = ("density", "rgb", "encoded", "harmonics", *(f"weights {i}" for i in range(5)))
    for name, actual, expected in zip(names, fast, exact, strict=True):
        if name in ("density", "rgb") or samples == 0:
            assert_close(actual, expected, name)
        else:
            # exp(log density) turns the rounding of a logarithm of up to 15 into a relative error 15 times as large,
            # and a hidden value that rounds to the other side of 0 moves one term of a sum.
            # Where a sigmoid saturates, 1 - value in float64 ends at 1e-16, and the kernel goes on below.
            assert_close(actual, expected, name, relative=5 * RELATIVE, floor=1e-15)
    assert_close(numba_cpu.density(encoded, tuple(weights)), exact[0], "density alone")


@pytest.mark.parametrize("samples", SIZES)
@pytest.mark.parametrize("contraction", kernels.CONTRACTIONS)
@pytest.mark.parametrize("reach", [1e-3, 2.0, 1e6])
def test_sample_coordinates(samples, contraction, reach, generator):
    offsets = offsets_of(samples, generator)
    rays = len(offsets) - 1
    origins, directions = torch.randn(2, rays, 3, generator=generator)
    starts = torch.rand(samples, generator=generator) * reach
    ends = starts + 0.1 * reach
    gradient = torch.randn(samples, 3, generator=generator)

    def run(function, dtype):
        inputs = [x.to(dtype).clone().requires_grad_() for x in (origins, directions)]
        spans = (starts.to(dtype), ends.to(dtype))
        coordinates = function(*inputs, *spans, offsets=offsets, contraction=contraction)
        coordinates.backward(gradient.to(dtype))
        return coordinates.detach(), *(x.grad for x in inputs)

    fast, exact = run(numba_cpu.sample_coordinates, torch.float32), run(reference.sample_coordinates, torch.float64)
    for name, actual, expected in zip(("coordinates", "origins", "directions"), fast, exact, strict=True):
        assert_close(actual, expected, name)


@pytest.mark.parametrize("samples", SIZES)
@pytest.mark.parametrize("magnitude", [1e-10, 1e-3, 1.0, 30.0, 1e10])
def test_composite(samples, magnitude, generator):
    offsets = offsets_of(samples, generator)
    density = torch.rand(samples, generator=generator) * magnitude
    density[::3] = 0.0
    lengths = torch.rand(samples, generator=generator)
    rgb = torch.rand(samples, 3, generator=generator)
    background = torch.rand(len(offsets) - 1, 3, generator=generator)
    shapes = ((len(offsets) - 1, 3), (len(offsets) - 1,), (samples,))
    back = [torch.randn(shape, generator=generator) for shape in shapes]

    def run(function, dtype):
        d, c = (x.detach().clone().to(dtype).requires_grad_() for x in (density, rgb))
        out = function(d, c, lengths.to(dtype), offsets=offsets, background=background.to(dtype))
        torch.autograd.backward(out, [g.to(dtype) for g in back])
        return *(x.detach() for x in out), d.grad, c.grad

    fast, exact = run(numba_cpu.composite, torch.float32), run(reference.composite, torch.float64)
    for name, actual, expected in zip(
        ("colour", "transmittance", "weights", "density gradient", "rgb gradient"), fast, exact, strict=True
    ):
        assert_close(actual, expected, name)
    weights, behind = numba_cpu.interval_weights(density, lengths, offsets)
    assert_close(weights, exact[2], "weights alone")
    assert_close(behind, exact[1], "transmittance alone")
    before = numba_cpu.optical_depth_before(density, lengths, offsets)
    assert_close(before, reference.optical_depth_before(density.double(), lengths.double(), offsets), "before")


@pytest.mark.parametrize("samples", SIZES)
@pytest.mark.parametrize("magnitude", [1e-12, 1.0, 1e6])
def test_distortion(samples, magnitude, generator):
    offsets = offsets_of(samples, generator)
    cuts = torch.rand(samples + 1, generator=generator).cumsum(0)
    weights = torch.rand(samples, generator=generator) * magnitude
    weights[::3] = 0.0
    by_ray = torch.randn(len(offsets) - 1, generator=generator)

    def run(function, dtype):
        w = weights.detach().clone().to(dtype).requires_grad_()
        out = function(w, cuts[:-1].to(dtype), cuts[1:].to(dtype), offsets)
        (out @ by_ray.to(dtype)).backward()
        return out.detach(), w.grad

    for name, actual, expected in zip(
        ("value", "gradient"), run(numba_cpu.distortion, torch.float32), run(reference.distortion, torch.float64),
        strict=True,
    ):  # fmt: skip
        assert_close(actual, expected, name)


@pytest.mark.parametrize("samples", SIZES)
def test_ray_indices(samples, generator):
    offsets = offsets_of(samples, generator)
    assert torch.equal(numba_cpu.ray_indices(offsets), reference.ray_indices(offsets))


@pytest.mark.parametrize(
    ("rays", "contraction"),
    [(0, "l2"), (1, "l2"), (5, "none"), *((123, contraction) for contraction in kernels.CONTRACTIONS), (700, "l2")],
)
# Thin fog lets every ray through; at 8 the densities reach e^15, and some rays end in their first sample.
@pytest.mark.parametrize("contrast", [0.0, 1.0, 8.0])
@pytest.mark.parametrize(("with_cones", "least"), [(False, 0.0), (True, 0.0), (False, 1e-2)])
def test_visible_samples(rays, contraction, contrast, with_cones, least, generator):
    origins = torch.randn(rays, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator), dim=-1)
    edges = torch.rand(60, generator=generator).cumsum(0) * 0.2
    occupied = torch.rand(8, 8, 8, generator=generator) > 0.4
    weights = tuple(torch.randn(shape, generator=generator) * 0.3 for shape in WEIGHTS)
    jitter = torch.rand(rays, generator=generator)
    table = torch.randn(8, 256, 4, generator=generator) * contrast
    grid = HashGrid(table, (4, 5, 6, 7, 9, 11, 13, 16), weights, antialias=with_cones)
    cones = torch.rand(rays, generator=generator) if with_cones else None
    given = (Rays(origins, directions, jitter, cones), March(edges, occupied, contraction, 7.0, least), grid)
    cell_depths = torch.full((2, 8, 8, 8), -1.0)
    fast = numba_cpu.visible_samples(*given, cell_depths[0])
    exact = reference.visible_samples(*given, cell_depths[1])
    torch.testing.assert_close(
        cell_depths[0], cell_depths[1], rtol=1e-4, atol=1e-12
    )  # exponentials of sums of up to 15
    # A midpoint that rounds into the neighbouring cell, or an optical depth that rounds across the limit, could be
    # kept by only one of the two; this does not happen for these seeds.
    assert torch.equal(fast[5], exact[5])
    names = ("starts", "ends", "density", "encoded", "coordinates")
    for name, actual, expected in zip(names, fast[:5], exact[:5], strict=True):
        assert_close(actual, expected, name, relative=5 * RELATIVE if name == "density" else RELATIVE)
    if rays:
        depth = reference.optical_depth_before(fast[2], fast[1] - fast[0], fast[5])
        assert (depth < 7.0).all()


@pytest.mark.parametrize("least", [0.0, 1e-4, 1e-3, 0.1])
def test_visible_samples_leave_out_what_absorbs_little_light(least, generator):
    # Law: the kept samples are unchanged, and each sample that is left out absorbs less than `least` of the light.
    rays, edges = 300, torch.rand(60, generator=generator).cumsum(0) * 0.2
    origins = torch.randn(rays, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator), dim=-1)
    grid = HashGrid(
        torch.randn(8, 256, 4, generator=generator) * 8.0, (4, 5, 6, 7, 9, 11, 13, 16),
        tuple(torch.randn(shape, generator=generator) * 0.3 for shape in WEIGHTS),
    )  # fmt: skip
    march = March(edges, torch.ones(8, 8, 8, dtype=torch.bool), "l2", 7.0)
    given = Rays(origins, directions, torch.rand(rays, generator=generator))
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
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator), dim=-1)
    grid = HashGrid(
        torch.ones(8, 256, 4), (4, 5, 6, 7, 9, 11, 13, 16), (torch.ones(WEIGHTS[0]), -torch.ones(WEIGHTS[1]))
    )
    march = March(torch.linspace(0.0, 2.0, 30), torch.ones(8, 8, 8, dtype=torch.bool), "l2", 7.0)
    given = Rays(torch.zeros(50, 3), directions, torch.rand(50, generator=generator))
    every = backend.visible_samples(given, march, grid)
    assert 0.0 < every.density.max() < 1e-6
    kept = backend.visible_samples(given, march._replace(least_weight=1e-3), grid)
    assert torch.equal(kept.starts, every.starts)


@pytest.mark.parametrize("side", [30, 64])
@pytest.mark.parametrize("contraction", kernels.CONTRACTIONS)
@pytest.mark.parametrize("steps", [2000, 150, 20])
def test_visible_samples_misses_no_lonely_cell(side, contraction, steps, generator):
    # Nearly all blocks of cells are empty and skipped as a whole; steps are from a part of a block to many blocks long.
    # A side of 30 leaves a narrow last block. Against the reference, which evaluates every step.
    rays = 300 if steps > 20 else 3000
    origins = torch.randn(rays, 3, generator=generator)
    directions = torch.nn.functional.normalize(-origins + 0.5 * torch.randn(rays, 3, generator=generator), dim=-1)
    jitter = torch.rand(rays, generator=generator)
    occupied = torch.rand(side, side, side, generator=generator) < 0.002
    along = March(torch.linspace(0.0, 5.0, steps), occupied, contraction, 1e9)
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
    starts, ends, density, _, coordinates, offsets, _ = numba_cpu.visible_samples(
        Rays(origins, directions, torch.zeros(rays)), along, EMPTY
    )
    assert torch.equal(offsets, torch.arange(rays + 1) * 400)
    assert torch.equal(starts.view(rays, 400), edges[:400].expand(rays, 400))
    assert torch.equal(ends.view(rays, 400), edges[1:401].expand(rays, 400))
    assert (density == 1).all()
    torch.testing.assert_close(coordinates[:, 2], ((starts + ends) / 2).clamp(0, 2) / 2)


@pytest.mark.parametrize("rows", [0, 1, 5, 123])
@pytest.mark.parametrize("magnitude", [1e-12, 1.0, 1e6])
@pytest.mark.parametrize("decay", [0.0, 0.1])
def test_adam_rows(rows, magnitude, decay, generator):
    values = [torch.randn(2, rows, 4, generator=generator) for _ in range(4)]
    values[1] *= magnitude
    values[1][:, ::2] = 0.0
    values[1][:, 1::4, 1:] = 0.0  # one feature is enough for a row to be touched
    values[1][:, 3::4, :-1] = 0.0
    values[2] *= magnitude
    values[3] = values[3].square() * magnitude**2
    fast, exact = [v.clone() for v in values], [v.double() for v in values]
    for arrays, function in ((fast, numba_cpu.adam_rows), (exact, reference.adam_rows)):
        for step in (1, 2):
            function(*arrays, step=AdamStep(step, 0.01, (0.9, 0.99), 1e-15, decay * magnitude))
            if step == 1:
                arrays[1] += values[1].to(arrays[1].dtype)
    for name, actual, expected in zip(("table", "gradient", "first", "second"), fast, exact, strict=True):
        assert_close(actual, expected, name)
    assert torch.equal(fast[0][:, ::2], values[0][:, ::2])  # untouched rows stay


@pytest.mark.parametrize("decay", [0.0, 0.3])
def test_adam_rows_is_adam_where_every_row_is_touched(decay, generator):
    # Against torch's own Adam over five steps.
    parameter = torch.nn.Parameter(torch.randn(1, 20, 4, generator=generator))
    ours = [parameter.detach().clone(), torch.zeros(1, 20, 4), torch.zeros(1, 20, 4), torch.zeros(1, 20, 4)]
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


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize(("channels", "grids"), [(3, False), (4, False), (3, True)])
def test_pixel_rays(count, channels, grids, generator):
    # Three photos of 5, 700 and 20 pixels, of which the first and the last share a camera's bearings.
    poses = torch.randn(3, 4, 4, generator=generator)
    bearings = torch.randn(720, 3, generator=generator)
    photos = torch.randint(256, (725, channels), generator=generator, dtype=torch.uint8)
    pixels = PixelTable(torch.tensor([0, 5, 705]), torch.tensor([700, 0, 700]), bearings, poses, photos)
    if grids:  # the first two photos between the bearings of grids of 10 x 3 and 71 x 11, the last one on its own
        corners = torch.tensor([[0.25, 0.35, 0.15, 0.25], [0.5, 0.5, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
        bearings = torch.randn(801, 3, generator=generator)
        between = BearingGrids(torch.tensor([[4, 10], [70, 71], [5, 5]]), corners)
        pixels = pixels._replace(first_bearing=torch.tensor([3, 0, 781]), bearings=bearings, grids=between)
    chosen = torch.randint(725, (count,), generator=generator)
    fast = numba_cpu.pixel_rays(chosen, pixels)
    exact = reference.pixel_rays(chosen, pixels._replace(bearings=bearings.double(), poses=poses.double()))
    for name, actual, expected in zip(("origins", "directions", "colours"), fast, exact, strict=True):
        assert_close(actual, expected, name)


@once
def test_numba_follows_when_the_thread_count_changes():
    limit = int(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    # Numba's own count used to stay where the last loop had left it, and loops that asked for two threads got one.
    for wanted in (1, 2, 1, 2):
        torch.set_num_threads(wanted)
        assert use_threads() == numba.get_num_threads() == min(wanted, limit)
