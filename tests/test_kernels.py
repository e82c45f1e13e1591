"""Every fast kernel against the definition in float64: cases x backends x {value, gradient}, on odd sizes.

Here the backend is the compiled one, on one thread and on two. `test_triton` runs this file in another process with
NERFCLI_KERNELS=triton_cuda, in Triton's interpreter or on a GPU. Errors are relative to a result as a whole (L2) and to
its largest number, except where light ends: there to each number. `test_selftest` has the hard cases.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.kernels import AdamStep, BearingGrids, March, PixelTable, Rays, numba_cpu, reference
from nerfcli.kernels.selftest.operations import Inputs, Outcome, exact

ON_GPU = os.environ.get("NERFCLI_KERNELS") == "triton_cuda"
if ON_GPU:
    from nerfcli.kernels.triton_cuda import operations
    from nerfcli.kernels.triton_cuda.launch import INTERPRETED

    FAST: ModuleType = operations
    DEVICE, SIZES, THREADS = torch.device("cpu" if INTERPRETED else "cuda"), (0, 1, 5, 123), (2,)
else:
    FAST, DEVICE, SIZES, THREADS = numba_cpu, torch.device("cpu"), (0, 1, 5, 123, 3000), (1, 2)
RELATIVE = 1e-5


@dataclass(frozen=True)
class Case:
    """Random inputs of an operation, in float32, and what a module computes from them."""

    name: str
    inputs: Callable[[int, torch.Generator], Inputs]  # of a size
    run: Callable[[ModuleType, Inputs], Inputs]
    leaves: tuple[str, ...] = ()  # inputs by which the gradient of a randomly weighted sum of the results is compared
    relative: float = RELATIVE  # largest error
    each: bool = False  # whether errors are relative to each number
    sizes: tuple[int, ...] = SIZES
    on_gpu: bool = True  # whether the GPU kernels have this operation


def offsets_of(samples: int, generator: torch.Generator) -> Tensor:
    """Return offsets of rays of random sizes: some are empty, one is longer than a Triton program's block."""
    cuts = torch.randint(0, samples + 1, (max(1, samples // 9),), generator=generator).sort()[0]
    cuts = cuts[cuts <= samples // 3]
    return torch.cat([torch.tensor([0]), cuts, torch.tensor([samples // 3, samples, samples])])


def samples_along(magnitude: float, far: float, samples: int, generator: torch.Generator) -> Inputs:
    """Return packed samples with gaps.

    At the smallest and the largest magnitudes, every 11th sample is a million times denser. At the others, rays absorb
    along their whole length, also beyond the first block of a Triton program.
    """
    offsets = offsets_of(samples, generator)
    density = torch.rand(samples, generator=generator) * magnitude
    if not 1e-3 < magnitude < 10.0:
        density[3::11] *= 1e6
    density[1::7], density[60:90] = 0.0, 0.0
    starts = far + torch.arange(samples) * 0.11 + 0.05 * torch.rand(samples, generator=generator)
    ends = starts + 0.05 * torch.rand(samples, generator=generator)
    colours = torch.rand(samples + len(offsets) - 1, 3, generator=generator)
    given = {"density": density, "starts": starts, "ends": ends, "lengths": ends - starts, "offsets": offsets}
    return {**given, "rgb": colours[:samples], "background": colours[samples:]}


def composite(module: ModuleType, given: Inputs) -> Inputs:
    density, lengths, offsets = given["density"], given["lengths"], given["offsets"]
    found = module.composite(density, given["rgb"], lengths, offsets=offsets, background=given["background"])
    alone = (density.detach(), lengths, offsets)
    before = module.optical_depth_before(*alone)
    return dict(
        zip(
            ("colour", "transmittance", "weights", "weights alone", "transmittance alone", "before"),
            (*found, *module.interval_weights(*alone), before), strict=True,
        )
    )  # fmt: skip


def weights_along(magnitude: float, far: float, samples: int, generator: torch.Generator) -> Inputs:
    """Return light that ends along rays, also far away: differences of sums of distances would have no digits left."""
    given = samples_along(1.0, far, samples, generator)
    weights = magnitude * reference.interval_weights(given["density"], given["lengths"], given["offsets"])[0]
    return {**given, "weights": weights}


def distortion(module: ModuleType, given: Inputs) -> Inputs:
    return {"distortion": module.distortion(given["weights"], given["starts"], given["ends"], given["offsets"])}


def ray_termination(fractions: tuple[float, ...], module: ModuleType, given: Inputs) -> Inputs:
    spans = (given["density"], given["starts"], given["ends"])
    return module.ray_termination(*spans, offsets=given["offsets"], fractions=fractions)._asdict()


def points_and_table(magnitude: float, faded: bool, samples: int, generator: torch.Generator) -> Inputs:
    """Return points, some of them on the border and outside, that float32 holds also when they are counted in cells."""
    points = ((torch.rand(samples, 3, generator=generator) * 1.2 - 0.1) * 2**12).round() / 2**12
    points[::7, 0], points[1::7, 1] = 0.0, 1.0
    gradient = torch.randn(samples, 20, generator=generator)
    for feature in range(4):
        gradient[feature::5, [i for i in range(20) if i % 4 != feature]] = 0.0  # only one feature has a gradient
    gradient[::5, 4:] = 0.0
    given = {"points": points, "table": torch.randn(5, 512, 4, generator=generator) * magnitude, "gradient": gradient}
    return {**given, "widths": torch.rand(samples, generator=generator).pow(4)} if faded else given


def hash_encode(module: ModuleType, given: Inputs) -> Inputs:
    resolutions = (4, 7, 0, 40, 700)  # the second has as many vertices as the table has rows, the third is left out
    encoded = module.hash_encode(given["points"], given["table"], resolutions, widths=given.get("widths"))
    return {"encoded": encoded.detach(), "weighted": encoded * given["gradient"]}


LAYERS = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))


def codes_and_layers(magnitude: float, samples: int, generator: torch.Generator) -> Inputs:
    layers = {f"layer {i}": torch.randn(shape, generator=generator) * magnitude for i, shape in enumerate(LAYERS)}
    given = {"encoded": torch.randn(samples, 32, generator=generator)}
    given["harmonics"] = torch.randn(9, 16, generator=generator)
    return {**given, **layers, "rays": torch.randint(9, (samples,), generator=generator).sort()[0]}


def radiance(module: ModuleType, given: Inputs) -> Inputs:
    layers = tuple(given[f"layer {i}"] for i in range(5))
    density, rgb = module.radiance(given["encoded"], given["harmonics"], given["rays"], layers)
    return {"density": density, "rgb": rgb, "density alone": module.density(given["encoded"], layers).detach()}


def rays_and_steps(reach: float, samples: int, generator: torch.Generator) -> Inputs:
    offsets = offsets_of(samples, generator)
    origins, directions = torch.randn(2, len(offsets) - 1, 3, generator=generator)
    starts = torch.rand(samples, generator=generator) * reach
    lines = {"origins": origins, "directions": directions, "starts": starts, "ends": starts + 0.1 * reach}
    return {**lines, "offsets": offsets, "gradient": torch.randn(samples, 3, generator=generator)}


def ray_gradients(contraction: str, module: ModuleType, given: Inputs) -> Inputs:
    lines = (given[name] for name in ("origins", "directions", "starts", "ends"))
    named = {"offsets": given["offsets"], "contraction": contraction, "gradient": given["gradient"]}
    return dict(zip(("by origins", "by directions"), module.ray_gradients(*lines, **named), strict=True))


def rows_and_moments(magnitude: float, rows: int, generator: torch.Generator) -> Inputs:
    """Return rows of which some have no gradient, and some one of a single feature."""
    table, gradient, first, second = (torch.randn(2, rows, 4, generator=generator) for _ in range(4))
    gradient[:, ::2], gradient[:, 1::4, 1:], gradient[:, 3::4, :-1] = 0.0, 0.0, 0.0
    gradient, first, second = gradient * magnitude, first * magnitude, second.square() * magnitude**2
    return {"table": table, "gradient": gradient, "first": first, "second": second}


def adam_rows(decay: float, module: ModuleType, given: Inputs) -> Inputs:
    """Take two steps, with the same gradient."""
    state = {name: values.clone() for name, values in given.items()}
    for number in (1, 2):
        state["gradient"] += given["gradient"] if number == 2 else 0.0
        module.adam_rows(*state.values(), step=AdamStep(number, 0.01, (0.9, 0.99), 1e-15, decay))
    assert torch.equal(state["table"][:, ::2], given["table"][:, ::2])  # untouched rows stay
    return state


def photos(channels: int, grids: bool, count: int, generator: torch.Generator) -> Inputs:
    """Return pixels of photos of 5, 700 and 20 pixels, of which the first and the last share a camera's bearings.

    With grids, those of the first two are between the bearings of grids of 10 x 3 and 71 x 11.
    """
    first_bearing = torch.tensor([3, 0, 781] if grids else [700, 0, 700])
    given = {
        "first_pixel": torch.tensor([0, 5, 705]),
        "first_bearing": first_bearing,
        "bearings": torch.randn(801, 3, generator=generator),
        "poses": torch.randn(3, 4, 4, generator=generator),
        "colours": torch.randint(256, (725, channels), generator=generator, dtype=torch.uint8),
        "chosen": torch.randint(725, (count,), generator=generator),
    }
    if grids:
        given["widths"] = torch.tensor([[4, 10], [70, 71], [5, 5]])
        given["corners"] = torch.tensor([[0.25, 0.35, 0.15, 0.25], [0.5, 0.5, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
    return given


def pixel_rays(module: ModuleType, given: Inputs) -> Inputs:
    grids = BearingGrids(given["widths"], given["corners"]) if "widths" in given else None
    table = {name: given[name] for name in ("first_pixel", "first_bearing", "bearings", "poses", "colours")}
    found = module.pixel_rays(given["chosen"], PixelTable(**table, grids=grids))
    return dict(zip(("origins", "directions", "colours"), found, strict=True))


def rays_through_cells(count: int, generator: torch.Generator) -> Inputs:
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return {
        "origins": -1.5 * directions + 0.3 * torch.randn(count, 3, generator=generator),
        "directions": directions,
        "jitter": torch.rand(count, generator=generator),
        "edges": torch.linspace(0.55, 2.0, 44).square(),
        "occupied": torch.rand(8, 8, 8, generator=generator) > 0.4,
    }


def occupied_samples(contraction: str, module: ModuleType, given: Inputs) -> Inputs:
    rays = Rays(given["origins"], given["directions"], given["jitter"])
    march = March(given["edges"], given["occupied"], contraction, 7.0)
    starts, ends, coordinates, offsets = module.occupied_samples(rays, march)
    index = module.ray_indices(offsets)
    return {"starts": starts, "ends": ends, "coordinates": coordinates, "offsets": offsets, "rays": index}


def cases() -> Iterator[Case]:
    for magnitude in (1e-10, 1e-3, 1.0, 30.0, 1e10):
        name, inputs = f"composite, densities to {magnitude:g}", partial(samples_along, magnitude, 0.0)
        yield Case(name, inputs, composite, ("density", "rgb"))
    for magnitude, far in ((1e-12, 0.0), (1.0, 0.0), (1.0, 1e4), (1e6, 0.0)):
        name = f"distortion, weights to {magnitude:g} at {far:g}"
        yield Case(name, partial(weights_along, magnitude, far), distortion, ("weights",))
    for magnitude in (1e-10, 0.01, 3.0, 100.0, 1e6):
        for fractions in ((), (0.9, 0.05, 0.5)):
            yield Case(
                f"ray_termination, densities to {magnitude:g}, {len(fractions)} quantiles",
                partial(samples_along, magnitude, 0.5), partial(ray_termination, fractions),
                relative=2e-5 if ON_GPU else 5e-6, each=True,
            )  # fmt: skip
    for magnitude, faded in ((1e-6, False), (1.0, True), (1.0, False), (1e6, True)):
        name = f"hash_encode, features to {magnitude:g}{', fading' if faded else ''}"
        yield Case(name, partial(points_and_table, magnitude, faded), hash_encode, ("points", "table"))
    # At 0.4 the input of the sigmoid reaches 20 to 40, and its rounding of 2e-6 carries through; exp(log density) turns
    # the rounding of a logarithm of up to 15 into a relative error 15 times as large.
    for magnitude in (1e-4, 0.2, 0.4):
        leaves = ("encoded", "harmonics", *(f"layer {i}" for i in range(5)))
        yield Case(
            f"radiance, weights to {magnitude:g}", partial(codes_and_layers, magnitude), radiance, leaves,
            relative=5 * RELATIVE, on_gpu=False,
        )  # fmt: skip
    for contraction in kernels.CONTRACTIONS:
        for reach in (1e-3, 2.0, 1e6, 1e12):
            name, run = f"ray_gradients, {contraction}, to {reach:g}", partial(ray_gradients, contraction)
            yield Case(name, partial(rays_and_steps, reach), run, relative=2e-5 if ON_GPU else RELATIVE)
        name, run = f"occupied_samples, {contraction}", partial(occupied_samples, contraction)
        yield Case(name, rays_through_cells, run, sizes=(0, 1, 5, 123))
    for magnitude, decay in ((1e-12, 0.0), (1.0, 0.0), (1.0, 0.1), (1e6, 1e5)):
        name = f"adam_rows, gradients to {magnitude:g}, decay {decay:g}"
        yield Case(name, partial(rows_and_moments, magnitude), partial(adam_rows, decay), sizes=(0, 1, 5, 123))
    for channels, grids in ((3, False), (4, False), (3, True)):
        name = f"pixel_rays, {channels} channels{', between bearings' if grids else ''}"
        yield Case(name, partial(photos, channels, grids), pixel_rays)


@pytest.fixture(params=THREADS, ids=lambda count: f"{count} threads")
def threads(request: pytest.FixtureRequest) -> None:
    torch.set_num_threads(request.param)


def outcome(case: Case, module: ModuleType, given: Inputs) -> Outcome:
    """Run a case, and find the gradient of a randomly weighted sum of its results."""
    leaves = {name: given[name].detach().clone().requires_grad_() for name in case.leaves}
    values = case.run(module, {**given, **leaves})
    generator, total = torch.Generator().manual_seed(1), torch.zeros(())
    for name, value in values.items():
        weights = torch.randn(value.shape, generator=generator).to(value.device, value.dtype)
        if value.requires_grad:
            total = (value * (1.0 if name == "weighted" else weights)).sum() + total.to(value)
    gradients: Any = torch.autograd.grad(total, list(leaves.values())) if leaves else ()
    return Outcome({name: x.detach() for name, x in values.items()}, dict(zip(leaves, gradients, strict=True)))


def assert_close(
    found: Tensor | None, wanted: Tensor | None, name: str, *, relative: float = RELATIVE, each: bool = False
) -> None:
    """Compare the numbers of a result with the answers: to the last bit if they are whole."""
    assert found is not None, name
    assert wanted is not None, name
    assert found.shape == wanted.shape, name
    found, wanted = (x.detach().cpu() for x in (found, wanted))
    if not wanted.is_floating_point():
        assert torch.equal(found, wanted), name
        return
    found, wanted = found.double(), wanted.double()
    if each:
        atol = 1e-7 if ON_GPU else torch.finfo(torch.float32).tiny
        torch.testing.assert_close(
            found, wanted, rtol=relative, atol=atol, equal_nan=True, msg=lambda text: f"{name}: {text}"
        )
    elif wanted.numel():
        assert found.isfinite().all(), name
        error = found - wanted
        # Where a sigmoid saturates, 1 - value in float64 ends at 1e-16, and the kernel goes on below.
        floor = 1e-15 if "layer" in name or name in ("encoded", "harmonics") else 1e-30
        assert error.norm() <= relative * wanted.norm() + floor, (name, float(error.norm() / wanted.norm()))
        assert error.abs().max() <= relative * wanted.abs().max() + floor, name


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(
    ("case", "size"),
    [
        pytest.param(case, size, id=f"{case.name}, {size}")
        for case in cases()
        for size in case.sizes
        if case.on_gpu or not ON_GPU
    ],
)
def test_kernels_agree_with_the_definition_in_float64(case, size, generator):
    given = case.inputs(size, generator)
    wanted = outcome(case, reference, {name: exact(x) for name, x in given.items()})
    found = outcome(case, FAST, {name: x.to(DEVICE) for name, x in given.items()})
    for results, answers in ((found.values, wanted.values), (found.gradients, wanted.gradients)):
        for name, answer in answers.items():
            assert results[name].dtype == (torch.float32 if answer.is_floating_point() else answer.dtype)
            assert_close(results[name], answer, name, relative=case.relative, each=case.each)


@pytest.mark.parametrize("module", [FAST, reference], ids=["fast", "definition"])
def test_hash_encode_reads_no_row_that_is_no_vertex(module):
    table = torch.full((1, 512, 4), torch.nan)
    table[0, :125] = 1.0
    points = torch.tensor([[1.0, 1.0, 1.0], [0.0, 1.0, 0.5], [7.0, -3.0, 1.0]])
    assert torch.equal(module.hash_encode(points.to(DEVICE), table.to(DEVICE), (4,)).cpu(), torch.ones(3, 4))


def test_no_rays_at_all():
    given = {name: values.to(DEVICE) for name, values in samples_along(1.0, 0.0, 0, torch.Generator()).items()}
    none = {**given, "offsets": given["offsets"][:1], "background": given["background"][:0]}
    wanted = composite(reference, {name: exact(x) for name, x in none.items()})
    assert {name: len(values) for name, values in composite(FAST, none).items()} == dict.fromkeys(wanted, 0)
