"""Backends: whole operations on rays against the reference in float64, in every branch; and which backend is taken."""

import importlib
import math
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest
import torch
from present import present
from torch import Tensor

from nerfcli import kernels
from nerfcli.field.fourier_field import FourierFieldSettings
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.field.interface import Field, FieldSettings
from nerfcli.field.kinds import fresh_field
from nerfcli.field.voxel_field import VoxelFieldSettings
from nerfcli.kernels import (
    Backend,
    HashGrid,
    March,
    Rays,
    RaysSeen,
    RaySums,
    Targets,
    TraceOptions,
    numba_cpu,
    reference,
)
from nerfcli.kernels.contraction import cube_widths
from nerfcli.kernels.numba_cpu.backend import NumbaBackend

CPU = torch.device("cpu")
COMPILED = HashFieldSettings(contraction="l2", log2_rows=8, coarsest=4, finest=16)
MEDIA: dict[str, FieldSettings] = {
    "compiled sizes": COMPILED,
    "pixels of some width": replace(COMPILED, antialias=True),
    "no hash grid": VoxelFieldSettings(contraction="l2", view_degree=1, log2_vertices=9),
    "no rows": FourierFieldSettings(contraction="none", octaves=2, width=16, layers=2),
}


def field_of(settings: FieldSettings, backend: Backend, dtype: torch.dtype, device: torch.device = CPU) -> Field:
    """Return a random field, of numbers that float16 holds, in which GPU kernels read them."""
    torch.manual_seed(0)
    field = fresh_field(settings)
    with torch.no_grad():
        if (rows := field.rows()) is not None:
            rows.normal_(0.0, 0.5)
        for parameter in field.parameters():
            parameter.copy_(parameter.half())
    field = field.to(device, dtype)
    field.backend = backend
    return field


def rays_and_march(
    count: int, dtype: torch.dtype, device: torch.device = CPU, *, contraction: str = "l2", empty: bool = False
) -> tuple[Rays, March]:
    g = torch.Generator().manual_seed(count)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=-1)
    origins = -1.5 * directions + 0.3 * torch.randn(count, 3, generator=g)
    jitter, cones = torch.rand(count, generator=g), 0.05 * torch.rand(count, generator=g)
    occupied = torch.rand(8, 8, 8, generator=g) > (1.0 if empty else 0.4)
    edges = torch.linspace(0.3, 4.0, 40).to(device, dtype)
    rays = Rays(*(values.to(device, dtype) for values in (origins, directions, jitter, cones)))
    return rays, March(edges, occupied.to(device), contraction, 7.0)


def wide(rays: Rays) -> Rays:
    """Return the rays with pixels wider than the cells of the grids."""
    return rays._replace(cones=30 * present(rays.cones))


def learned(field: Field, count: int, *, targets: Targets, with_sink: bool) -> dict[str, Tensor]:
    """Return what a training step gets from some rays, and the gradients of a randomly weighted sum of it."""
    rows, first = field.rows(), next(field.parameters())
    like = {"dtype": first.dtype, "device": first.device}
    rays, march = rays_and_march(count, **like, contraction=field.settings.contraction)
    rays = wide(rays)._replace(origins=rays.origins.requires_grad_(), directions=rays.directions.requires_grad_())
    g = torch.Generator().manual_seed(9)
    background = torch.rand(count, 3, generator=g).to(**like)
    # Gradients are added to the ones that the sink already contains.
    if with_sink and rows is not None:
        field.table_grad = torch.ones_like(rows, requires_grad=False)
    distances = None if targets.distances is None else targets.distances[:count].to(**like)
    targets = targets._replace(distances=distances)
    seen = field.backend.render_rays(rays, march, field.medium(), targets, background=background)
    total = torch.zeros((), **like)
    for values in seen[:4]:
        total = total + (values * torch.randn(values.shape, generator=g).to(**like)).sum()
    total.backward()
    gradients = {f"gradient of {key}": value.grad for key, value in field.named_parameters() if value is not rows}
    gradients |= {"gradient of origins": rays.origins.grad, "gradient of directions": rays.directions.grad}
    if rows is not None:
        assert (rows.grad is None) == with_sink or not len(rays.origins)
        gradients["gradient of rows"] = rows.grad if field.table_grad is None else field.table_grad - 1.0
    return {**seen._asdict(), **{key: value for key, value in gradients.items() if value is not None}}


def assert_agree(fast: dict[str, Tensor], exact: dict[str, Tensor], *, relative: float) -> None:
    assert fast.keys() == exact.keys()
    for name, value in fast.items():
        wanted = exact[name].double()
        assert value.shape == wanted.shape, name
        error = (value.double() - wanted).norm()
        assert error <= relative * wanted.norm() + 1e-12, (name, float(error / wanted.norm()))


BRANCHES = {
    "colours alone": Targets(),
    "near": Targets(near=1.0),
    "distortion": Targets(distortion=True),
    "distances": Targets(distances=torch.tensor([2.0, 1.5, 1.7])),
    "all": Targets(0.7, True, torch.tensor([1.2, 1.5])),
}


@pytest.mark.parametrize("name", MEDIA)
@pytest.mark.parametrize("count", [0, 1, 5, 123])
@pytest.mark.parametrize("branch", BRANCHES)
def test_a_training_gets_what_the_reference_gives_in_float64(name, count, branch):
    """Sums along rays, and gradients of rays, layers and rows, with a sink for the rows or without one."""
    with_sink = branch in ("near", "all")
    targets = BRANCHES[branch]
    given = {"targets": targets, "with_sink": with_sink}
    exact = learned(field_of(MEDIA[name], Backend(CPU), torch.float64), count, **given)
    for backend in (NumbaBackend(CPU), Backend(CPU)):
        fast = learned(field_of(MEDIA[name], backend, torch.float32), count, **given)
        assert torch.equal(fast["samples"], exact["samples"])  # no sample is kept by only one for these seeds
        # float32 coordinates are off by 1e-7, which is 1e-6 of a cell of 1/16; the slope of log density adds more.
        assert_agree(fast, exact, relative=1e-3)


@pytest.mark.parametrize("name", MEDIA)
@pytest.mark.parametrize("count", [0, 1, 5, 123])
def test_a_picture_is_what_the_reference_gives_in_float64(name, count):
    def seen(backend: Backend, dtype: torch.dtype) -> RaysSeen:
        field = field_of(MEDIA[name], backend, dtype)
        rays, march = rays_and_march(count, dtype, contraction=field.settings.contraction)
        background = torch.tensor([0.25, 0.5, 1.0], dtype=dtype)
        options = TraceOptions((0.25, 0.5), 1e-3)
        return field.backend.trace_rays(rays, march, field.medium(), options, background=background)

    exact = seen(Backend(CPU), torch.float64)
    for backend in (NumbaBackend(CPU), Backend(CPU)):
        fast = seen(backend, torch.float32)
        assert torch.equal(fast.intervals.offsets, exact.intervals.offsets)
        pairs = {"rgb": (fast.rgb, exact.rgb), "error": (fast.truncation_error, exact.truncation_error)}
        for key in ("opacity", "transmittance", "mean", "spread", "quantiles"):
            pairs[key] = (getattr(fast.ends, key), getattr(exact.ends, key))
        for key, (value, expected) in pairs.items():
            torch.testing.assert_close(
                value.double(), expected, rtol=1e-3, atol=2e-5, equal_nan=True, msg=f"{key}: {value}, {expected}"
            )


@pytest.mark.parametrize("negligible", [1e-3, 0.05, 0.5])
def test_compiled_pictures_stay_within_their_bound(negligible):
    """More rays than a thread handles at a time; some of these rays traced alone give the same bits."""
    field = field_of(COMPILED, NumbaBackend(CPU), torch.float32)
    rays, march = rays_and_march(700, torch.float32)
    background = torch.rand(700, 3, generator=torch.Generator().manual_seed(1))
    seen, whole = (
        field.backend.trace_rays(
            rays, march._replace(max_optical_depth=depth), field.medium(), options, background=background
        )
        for depth, options in ((2.0, TraceOptions(negligible=negligible)), (1e9, TraceOptions()))
    )
    apart = (seen.rgb - whole.rgb).abs().amax(-1)
    assert (apart <= seen.truncation_error * (1 + 1e-4) + 1e-6).all()
    assert float(apart.max()) > 0.1 * negligible  # something is left out
    behind = torch.maximum(background, 1.0 - background).amax(-1)
    assert (seen.truncation_error <= 0.5 * negligible + seen.ends.transmittance * behind + 1e-6).all()
    some = Rays(*(values[300:310] for values in rays if values is not None))
    alone = field.backend.trace_rays(
        some, march._replace(max_optical_depth=2.0), field.medium(), TraceOptions(negligible=negligible),
        background=background[300:310],
    )  # fmt: skip
    assert torch.equal(alone.rgb, seen.rgb[300:310])
    assert torch.equal(alone.truncation_error, seen.truncation_error[300:310])


def test_compiled_pictures_leave_out_no_more_of_a_ray_than_they_may():
    """Samples in steps so short that each may be left out: all of them together may not."""
    field, negligible = field_of(COMPILED, NumbaBackend(CPU), torch.float32), 0.05
    rays, march = rays_and_march(100, torch.float32)
    march = march._replace(edges=torch.linspace(0.3, 4.0, 600), max_optical_depth=1e9)
    options = TraceOptions(negligible=negligible)
    seen = field.backend.trace_rays(rays, march, field.medium(), options, background=torch.zeros(3))
    assert 0.99 * negligible < 2.0 * float(seen.truncation_error.max()) <= negligible * (1 + 1e-6)


UNEVEN = torch.linspace(0.55, 2.0, 40, dtype=torch.float64).square()


@torch.no_grad()
def samples_by_hand(field: Field, rays: Rays, march: March) -> list[list[tuple[float, float]]]:
    """Return the intervals of each ray that light reaches, found one after the other in float64."""
    plain = rays.detached()
    starts, ends, places, offsets = reference.occupied_samples(plain, march)
    medium = field.medium()
    if isinstance(medium, HashGrid):
        widths = widths_by_hand(plain, starts, ends, offsets) if medium.antialias else None
        code = reference.hash_encode(places, medium.table, medium.resolutions, widths)
        density = reference.density(code, medium.layers)
    else:
        density = medium.density(places)
    kept: list[list[tuple[float, float]]] = []
    for ray in range(len(plain.origins)):
        kept.append([])
        depth = 0.0
        for k in range(int(offsets[ray]), int(offsets[ray + 1])):
            if depth < march.max_optical_depth:
                kept[-1].append((float(starts[k]), float(ends[k])))
            depth += float(density[k] * (ends[k] - starts[k]))
    return kept


def widths_by_hand(rays: Rays, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
    index, middles = kernels.ray_indices(offsets), (starts + ends) / 2
    places = rays.origins[index] + rays.directions[index] * middles[:, None]
    return cube_widths(places, present(rays.cones)[index] * middles, "l2")


def radiance_by_hand(field: Field, rays: Rays, kept: list[list[tuple[float, float]]]) -> tuple[Tensor, ...]:
    """Return densities, colours, starts, ends and rays of all intervals, from single operations."""
    flat = [span for spans in kept for span in spans]
    starts, ends = torch.tensor(flat, dtype=torch.float64).reshape(-1, 2).unbind(1)
    index = torch.tensor([ray for ray, spans in enumerate(kept) for _ in spans], dtype=torch.int64)
    offsets = torch.tensor([0, *torch.tensor([len(spans) for spans in kept]).cumsum(0).tolist()])
    places = rays.origins[index] + rays.directions[index] * ((starts + ends) / 2)[:, None]
    coordinates = kernels.grid_coordinates(places, field.settings.contraction)
    medium = field.medium()
    if isinstance(medium, HashGrid):
        widths = widths_by_hand(rays.detached(), starts, ends, offsets) if medium.antialias else None
        code = reference.hash_encode(coordinates, medium.table, medium.resolutions, widths)
        harmonics = kernels.spherical_harmonics(rays.directions, medium.view_degree)
        density, rgb = reference.radiance(code, harmonics, index, medium.layers)
    else:
        density, rgb = medium.radiance(coordinates, rays.directions, index)
    return density, rgb, starts, ends, index


@pytest.mark.parametrize("near", [None, 1.0, 1.3])
@pytest.mark.parametrize("name", MEDIA)
def test_rays_of_a_training_are_single_operations_one_after_the_other(name, near):
    """Values and gradients by loops, independent of `kernels.composition`, which both backends share."""
    field = field_of(MEDIA[name], Backend(CPU), torch.float64)
    rays, march = rays_and_march(4, torch.float64, contraction=field.settings.contraction)
    rays = wide(rays)._replace(origins=rays.origins + 1.2 * rays.directions)
    march = march._replace(edges=UNEVEN, max_optical_depth=0.4)
    background = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    kept = samples_by_hand(field, rays, march)
    distances = torch.tensor([1.1 * spans[0][0] for spans in kept[2:]], dtype=torch.float64)  # near the first samples

    def gradients(sums: Sequence[Tensor], given: Rays) -> list[Tensor | None]:
        colour, passing, apart, off = sums
        loss = (colour * background.flip(0)).sum() + passing.square().sum() + apart.sum() + off.square().sum()
        wanted = (given.origins, given.directions, *field.parameters())
        return list(torch.autograd.grad(loss, wanted, allow_unused=True))

    def learnable() -> Rays:
        origins, directions = (x.detach().clone().requires_grad_() for x in (rays.origins, rays.directions))
        return rays._replace(origins=origins, directions=directions)

    given = learnable()
    targets = Targets(near, True, distances)
    sums = field.backend.render_rays(given, march, field.medium(), targets, background=background)
    found = gradients(sums[:4], given)

    given = learnable()
    density, rgb, starts, ends, index = radiance_by_hand(field, given, kept)
    if near is not None:
        scale = (starts / near).square().clamp_max(1.0)
        assert (scale < 1).any()
        density = scale * density + (1 - scale) * density.detach()
        rgb = scale[:, None] * rgb + (1 - scale[:, None]) * rgb.detach()
    near_ends, far_ends = (torch.where(t <= 1, t / 2, 1 - 1 / (2 * t)) for t in (starts, ends))
    middles = (near_ends + far_ends) / 2
    colours, passing, apart, off = [], [], [], []
    for ray in range(4):
        left, colour, weighted = torch.ones((), dtype=torch.float64), torch.zeros(3, dtype=torch.float64), []
        for k in (index == ray).nonzero()[:, 0]:
            through = torch.exp(-density[k] * (ends[k] - starts[k]))
            weighted.append((left * (1 - through), k))
            colour = colour + left * (1 - through) * rgb[k]
            left = left * through
        colours.append(colour + left * background[ray])
        passing.append(left)
        pairs = sum(w * v * abs(middles[k] - middles[i]) for w, k in weighted for v, i in weighted)
        apart.append(pairs + sum(w * w * (far_ends[k] - near_ends[k]) for w, k in weighted) / 3)
        if ray >= 2:
            distance = distances[ray - 2]
            misses = [abs((starts[k] + ends[k]) / 2 - distance) / (0.25 * distance) for _, k in weighted]
            off.append(left + sum(w * min(miss, 1.0) for (w, _), miss in zip(weighted, misses, strict=True)))
    by_hand = [torch.stack(values) for values in (colours, passing, apart, off)]
    assert int(sums.samples) == sum(map(len, kept)) > 10
    for value, wanted in zip(sums[:4], by_hand, strict=True):
        torch.testing.assert_close(value, wanted, rtol=1e-9, atol=1e-12)
    for value, wanted in zip(found, gradients(by_hand, given), strict=True):
        assert (value is None) == (wanted is None)
        if value is not None and wanted is not None:
            torch.testing.assert_close(value, wanted, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("name", MEDIA)
def test_rays_of_a_picture_are_single_operations_one_after_the_other(name):
    """Colours of negligible samples are replaced by grey; the bound covers the error of that and of the early stop."""
    field = field_of(MEDIA[name], Backend(CPU), torch.float64)
    rays, march = rays_and_march(6, torch.float64, contraction=field.settings.contraction)
    rays, march, negligible = wide(rays), march._replace(edges=UNEVEN, max_optical_depth=0.4), 0.3
    background = torch.rand(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    options = TraceOptions(negligible=negligible)
    seen = field.backend.trace_rays(rays, march, field.medium(), options, background=background)
    with torch.no_grad():
        kept = samples_by_hand(field, rays, march)
        density, rgb, starts, ends, index = radiance_by_hand(field, rays, kept)
    greys = stops = 0
    for ray in range(6):
        left, colour, error = 1.0, torch.zeros(3, dtype=torch.float64), 0.0
        for k in (index == ray).nonzero()[:, 0]:
            depth = float(density[k] * (ends[k] - starts[k]))
            weight = left * -math.expm1(-depth)
            grey = weight <= negligible / len(kept[ray])
            greys += grey
            colour += weight * (0.5 if grey else rgb[k])
            error += 0.5 * weight * grey
            left *= math.exp(-depth)
        behind = float(torch.maximum(background[ray], 1 - background[ray]).max())
        if left <= math.exp(-march.max_optical_depth) * (1 + 1e-5):
            stops += 1
            error += left * behind
        torch.testing.assert_close(seen.rgb[ray], colour + left * background[ray], rtol=1e-9, atol=1e-12)
        assert float(seen.truncation_error[ray]) == pytest.approx(error, rel=1e-9)
        # The error of everything that marching left out is within the bound.
        everything = march._replace(max_optical_depth=1e9)
        whole = field.backend.trace_rays(rays, everything, field.medium(), background=background)
        assert (whole.rgb[ray] - seen.rgb[ray]).abs().max() <= error * (1 + 1e-9) + 1e-12
    assert greys > 0
    assert stops > 0


@pytest.mark.parametrize("backend", [NumbaBackend(CPU), Backend(CPU)], ids=lambda backend: backend.name)
def test_rays_that_meet_nothing_see_the_background(backend):
    field = field_of(COMPILED, backend, torch.float32)
    rays, march = rays_and_march(5, torch.float32, empty=True)
    background = torch.rand(5, 3)
    targets = Targets(1.0, True, torch.tensor([1.0]))
    sums: RaySums = field.backend.render_rays(rays, march, field.medium(), targets, background=background)
    assert torch.equal(sums.rgb, background)
    assert sums.transmittance.tolist() == [1.0] * 5
    assert sums.distortion.tolist() == [0.0] * 5
    assert sums.depth_loss.tolist() == [1.0]
    assert int(sums.samples) == 0
    seen = field.backend.trace_rays(rays, march, field.medium(), background=background)
    assert torch.equal(seen.rgb, background)
    assert seen.truncation_error.tolist() == [0.0] * 5


def test_what_marching_has_computed_is_not_computed_again(monkeypatch):
    """The step with gradients reuses the codes of samples from marching."""
    field = field_of(COMPILED, NumbaBackend(CPU), torch.float32)
    rays, march = rays_and_march(5, torch.float32)
    rays = rays._replace(origins=rays.origins.requires_grad_())
    handed: list[bool] = []
    encode = numba_cpu.hash_encode

    def encoding(points: Tensor, table: Tensor, *rest: Any) -> Tensor:
        handed.append(rest[2] is not None)
        return encode(points, table, *rest)

    monkeypatch.setattr(numba_cpu, "hash_encode", encoding)
    field.backend.render_rays(rays, march, field.medium(), background=torch.zeros(5, 3))
    assert handed == [True]


@pytest.fixture
def without_numba(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine on which the compiled kernels cannot be imported."""
    kernels._numba_cpu.cache_clear()
    monkeypatch.delattr(kernels, "numba_cpu")
    monkeypatch.setitem(sys.modules, "nerfcli.kernels.numba_cpu", None)
    yield
    kernels._numba_cpu.cache_clear()


def one_warning_for_the_reference(recwarn: pytest.WarningsRecorder, device: str, *dtypes: torch.dtype) -> str:
    """Return the only warning with which the reference is taken several times."""
    names = {kernels.backend_for(torch.device(device), dtype).name for dtype in dtypes}
    assert names == {"reference"}
    (warning,) = recwarn
    return str(warning.message)


def test_without_numba_the_reference_is_taken_with_one_warning(without_numba, recwarn):
    said = one_warning_for_the_reference(recwarn, "cpu", *[torch.float32] * 3)
    assert "Numba does not work on this machine" in said


@pytest.mark.parametrize("swallowed", [ImportError, None])
def test_ctrl_c_while_numba_is_imported_is_not_lost(swallowed, monkeypatch, recwarn):
    """Numba's C code may clear the exception of an interrupt, or fail for it and be taken for a broken installation."""
    imported = importlib.import_module

    def interrupted(name: str) -> ModuleType:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if swallowed is not None:
                raise swallowed from None
        return imported(name)

    kernels._numba_cpu.cache_clear()
    monkeypatch.setattr(importlib, "import_module", interrupted)
    with pytest.raises(KeyboardInterrupt):
        kernels.backend_for(CPU, torch.float32)
    monkeypatch.setattr(importlib, "import_module", imported)
    assert kernels.backend_for(CPU, torch.float32).name == "numba_cpu"
    assert not recwarn.list


@pytest.fixture
def with_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine on which torch reports a CUDA device."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    caches = kernels._why_not_triton, kernels._warn_of_slow_gpu
    for cache in caches:
        cache.cache_clear()
    yield
    for cache in caches:
        cache.cache_clear()


def test_a_gpu_without_working_kernels_takes_the_reference_with_one_warning(with_gpu, monkeypatch, recwarn):
    monkeypatch.setattr(kernels, "_why_not_triton", lambda index: f"no launch on {index}")
    for name in ("cuda", "cuda:1", "cuda:1"):
        assert kernels.backend_for(torch.device(name), torch.float32).name == "reference"
    assert kernels.backend_for(torch.device("cuda"), torch.float64).name == "reference"  # the default for float64
    slow = "the GPU kernels cannot be used (no launch on {}); using plain torch, which is many times slower"
    assert [str(warning.message) for warning in recwarn] == [slow.format(index) for index in (0, 1)]


def test_without_triton_the_reference_is_taken_with_one_warning(with_gpu, monkeypatch, recwarn):
    monkeypatch.setitem(sys.modules, "nerfcli.kernels.triton_cuda", None)
    said = one_warning_for_the_reference(recwarn, "cuda", *[torch.float32] * 3)
    assert "Triton does not work on this machine" in said


def test_a_gpu_with_working_kernels_takes_them(with_gpu, monkeypatch):
    pytest.importorskip("triton")
    monkeypatch.setattr(kernels, "_why_not_triton", lambda index: None)
    backend = kernels.backend_for(torch.device("cuda:1"), torch.float32)
    assert (backend.name, backend.deterministic) == ("triton_cuda", False)
    assert kernels.backend_for(CPU, torch.float32).name == "numba_cpu"


def test_half_precision_on_a_gpu_takes_the_reference_with_one_warning(with_gpu, monkeypatch, recwarn):
    monkeypatch.setattr(kernels, "_why_not_triton", lambda index: None)
    said = one_warning_for_the_reference(recwarn, "cuda", torch.float16, torch.float16, torch.float64)
    assert "the GPU kernels cannot be used (float32 is supported, not float16)" in said


def test_without_a_gpu_its_kernels_say_why_they_do_not_work():
    if torch.cuda.is_available():
        pytest.skip("there is one")
    assert kernels.backend_for(torch.device("cuda"), torch.float32).name == "reference"
    for device, reason in (("cuda", "torch finds no CUDA device"), ("cpu", "they are for CUDA devices")):
        assert kernels.triton_unavailable_reason(torch.device(device)) == reason


def test_what_repeats_bit_for_bit_says_so():
    assert all(kernels.backend_for(CPU, dtype).deterministic for dtype in (torch.float32, torch.float64))
    assert not kernels.backend_for(torch.device("cuda"), torch.float32).deterministic


@pytest.mark.parametrize("size", [{"levels": 3}, {"width": 16}, {"width": 64}, {"levels": 16, "features": 2}])
def test_a_field_of_a_size_without_compiled_kernels_takes_the_reference(size):
    assert HashField(replace(COMPILED, **size)).backend.name == "reference"


def test_a_field_takes_another_backend_where_it_goes():
    field = HashField(COMPILED)
    assert field.backend.name == "numba_cpu"
    assert field.backend is field.backend
    assert field.double().backend.name == "reference"
    assert field.float().backend.name == "numba_cpu"
    field.backend = Backend(CPU)
    assert field.backend.name == "reference"


def test_the_definition_of_contracted_distance():
    distance = torch.tensor([0.0, 0.5, 1.0, 2.0, math.inf], dtype=torch.float64)
    assert reference.contracted_distance(distance).tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
