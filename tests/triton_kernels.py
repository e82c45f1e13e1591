"""What the GPU kernels have beside the operations of `test_kernels`, against the reference in float64.

`test_triton` runs both files in a separate process, this one first: in Triton's interpreter on the CPU, or on a GPU.
"""

# pyrefly: ignore-errors[bad-argument-count]
# Pyrefly does not know how many tensors `on_device` returns.

import inspect
import json
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from present import present
from test_backends import COMPILED, CPU, field_of, learned, rays_and_march
from test_kernels import DEVICE, RELATIVE, SIZES, assert_close, points_and_table
from torch import Tensor
from triton.language import core
from triton.language.semantic import TritonSemantic
from triton.runtime import interpreter

from nerfcli import kernels
from nerfcli.kernels import AdamStep, Backend, HashGrid, March, Rays, Targets, TraceOptions, reference
from nerfcli.kernels.contraction import contract
from nerfcli.kernels.interface import Samples
from nerfcli.kernels.selftest.measure import MET, Precision
from nerfcli.kernels.selftest.table import OF_GPU, checks, row_of
from nerfcli.kernels.triton_cuda import compositing, hash_grid, launch, marching, networks
from nerfcli.kernels.triton_cuda.backend import TritonBackend
from nerfcli.kernels.triton_cuda.launch import seen
from nerfcli.kernels.triton_cuda.warm_up import warm_up

# Relative tolerances: of float32, and of values that pass through float16 (11 bits) and sums of them.
SINGLE, HALF = RELATIVE, 6e-3


@cache
def first_builtin(language: Any) -> str | None:
    """Return the name of the first operation of Triton's language that its interpreter replaces, or None."""
    return next((name for name, member in inspect.getmembers(language) if interpreter.tl.core.is_builtin(member)), None)


@pytest.fixture(scope="session", autouse=True)
def _interpreted_fast() -> Iterator[None]:
    """Spare Triton's interpreter what it does again at each call or operation, and what it computes and then drops.

    It patches Triton's language at each call of a function, builds a table of all types at each operation, describes
    the shape of each result anew, and finds out whether integers overflow, but would tell only if it debugged.
    """
    with pytest.MonkeyPatch.context() as patch:
        replace_all, dtype_of = interpreter._patch_builtin, interpreter._get_np_dtype
        new_tensor, new_type = core.tensor.__init__, core.block_type.__init__
        broadcast = TritonSemantic.broadcast_impl_value
        builder, dtypes = interpreter.interpreter_builder, dict[str, Any]()
        types, shapes = dict[Any, dict[str, Any]](), dict[str, tuple[Any, Any]]()

        def replace_once(language: Any, *others: Any) -> None:
            name = first_builtin(language)
            if name is not None and interpreter.tl.core.is_builtin(getattr(language, name)):
                replace_all(language, *others)

        def known_dtype(of: Any) -> Any:
            name = of.scalar.name
            if name not in dtypes:
                dtypes[name] = dtype_of(of)
            return dtypes[name]

        def known_type(self: Any, element_ty: Any, shape: Any) -> None:
            key = (element_ty.name, *(getattr(size, "value", size) for size in shape))
            if key not in types:
                new_type(self, element_ty, shape)
                types[key] = vars(self).copy()
            vars(self).update(types[key])

        def known_shape(self: Any, handle: Any, of: Any) -> None:
            key = of.name
            if key not in shapes:
                new_tensor(self, handle, of)
                shapes[key] = self.shape, self.numel
            self.handle, self.type, self.dtype = handle, of, of.scalar
            self.shape, self.numel = shapes[key]

        def broadcast_if_different(self: Any, left: Any, right: Any) -> tuple[Any, Any]:
            same = left.handle.data.shape == right.handle.data.shape and left.type.is_block() == right.type.is_block()
            return (left, right) if same else broadcast(self, left, right)

        assert not builder.options.debug
        patch.setattr(interpreter, "_patch_builtin", replace_once)
        patch.setattr(interpreter, "_get_np_dtype", known_dtype)
        patch.setattr(core.block_type, "__init__", known_type)
        patch.setattr(core.tensor, "__init__", known_shape)
        patch.setattr(TritonSemantic, "broadcast_impl_value", broadcast_if_different)
        patch.setattr(builder, "options", replace(builder.options, sanitize_overflow=False))
        yield


def on_device(*tensors: Tensor) -> Any:
    return tuple(tensor.to(DEVICE) for tensor in tensors)


@pytest.mark.parametrize("faded", [False, True])
def test_hash_encode_fills_a_sink_and_writes_half_precision(faded, generator):
    given = points_and_table(1.0, faded, 123, generator)
    points, table, gradient = on_device(given["points"], given["table"], given["gradient"])
    widths = given["widths"].to(DEVICE) if faded else None
    resolutions, sink = (4, 7, 0, 40, 70), torch.ones_like(table)
    encoded = hash_grid.hash_encode(points, table.requires_grad_(), resolutions, None, widths)
    (wanted,) = torch.autograd.grad(encoded, table, gradient)
    hash_grid.hash_encode(points, table, resolutions, sink, widths).backward(gradient)
    assert_close(sink - 1, wanted, "sink")
    half = hash_grid.encode(points, table.detach().half(), resolutions, widths=widths, dtype=torch.float16)
    assert_close(half.float(), encoded, "float16", relative=1e-3)


def layers_of(hidden: int, generator: torch.Generator) -> list[Tensor]:
    shapes = ((hidden, 32), (16, hidden), (hidden, 32), (hidden, hidden), (3, hidden))
    # Rounded to float16, in which the kernels read them.
    return [(torch.randn(s, generator=generator) * s[1] ** -0.5).half().float() for s in shapes]


@pytest.mark.parametrize("samples", SIZES)
@pytest.mark.parametrize(("hidden", "degree"), [(32, 3), (64, 1), (32, 0)])
def test_networks(samples, hidden, degree, generator):
    layers = layers_of(hidden, generator)
    code = torch.randn(samples, 32, generator=generator).half()
    directions = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator), dim=-1)
    rays = torch.randint(9, (samples,), generator=generator).sort()[0]
    by_density, by_rgb = torch.randn(samples, generator=generator), torch.randn(samples, 3, generator=generator)
    by_density, by_rgb = by_density * 1e-7, by_rgb * 1e-6  # as of a mean over many rays
    inputs = [x.double().requires_grad_() for x in (code, directions[rays], *layers)]
    each = torch.arange(samples)
    exact = reference.radiance(inputs[0], kernels.spherical_harmonics(inputs[1], degree), each, tuple(inputs[2:]))
    ((exact[0] * by_density).sum() + (exact[1] * by_rgb).sum()).backward()
    given = on_device(code, directions, rays)
    weights = on_device(*layers)
    density, rgb = networks.radiance(*given, weights, degree=degree)
    assert_close(density, exact[0], "density", relative=HALF)
    assert_close(networks.density(given[0], weights), exact[0], "density alone", relative=HALF)
    assert_close(rgb, exact[1], "rgb", relative=HALF)
    by_code, scale, by_direction, of_layers = networks.radiance_gradients(
        *given, weights, degree=degree, density=density, by_density=by_density.to(DEVICE), by_rgb=by_rgb.to(DEVICE),
        rays_learn=True,
    )  # fmt: skip
    found = (by_code.float() / scale, by_direction, *of_layers)
    names = ("code", "directions", *(f"layer {i}" for i in range(5)))
    for name, a, b in zip(names, found, inputs, strict=True):
        assert_close(a, b.grad if samples else torch.zeros_like(b), name, relative=4 * HALF)


@pytest.mark.parametrize(("weights", "gradient"), [(300.0, 1e-6), (1.0, 1e-42), (1.0, 0.0)])
def test_gradients_of_networks_stay_finite(weights, gradient, generator):
    """Layers that amplify the gradients beyond float16, and gradients too small to be scaled into it."""
    layers = layers_of(32, generator)
    for part in (layers[0], layers[1], layers[2][:, :16]):
        part *= weights
    layers[1][0] = 0.0  # densities stay as they are
    code = (torch.rand(123, 32, generator=generator) / weights**2).half()
    given = on_device(code, torch.nn.functional.normalize(torch.ones(1, 3), dim=-1), torch.zeros(123).long())
    density, _ = networks.radiance(*given, on_device(*layers), degree=3)
    by_code, scale, by_direction, of_layers = networks.radiance_gradients(
        *given, on_device(*layers), degree=3, density=density, by_density=torch.zeros(123, device=DEVICE),
        by_rgb=torch.full((123, 3), gradient, device=DEVICE), rays_learn=True,
    )  # fmt: skip
    for found in (by_code.float() / scale, by_direction, *of_layers):
        assert found.isfinite().all()
    assert (of_layers[4].abs().max() > 0) == (gradient > 1e-30)


def test_densities_end_where_their_logarithms_do():
    layers = [torch.zeros(s) for s in ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))]
    layers[0][0, 0], layers[0][1, 0], layers[1][0, 0], layers[1][0, 1] = 1.0, -1.0, 1.0, -1.0
    code = torch.zeros(5, 32)
    code[:, 0] = torch.tensor([-60.0, -16.0, 16.0, 60.0, torch.nan])
    found = networks.density(code.half().to(DEVICE), on_device(*layers)).cpu()
    wanted = torch.tensor([-15.0, -15.0, 15.0, 15.0, torch.nan]).exp()
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=0, equal_nan=True)


def exactly(rays: Rays, march: March) -> tuple[Rays, March]:
    """Return the same rays and march in float64 on the CPU."""
    plain = Rays(*(None if x is None else x.detach().cpu().double() for x in rays))  # type: ignore[arg-type]
    return plain, march._replace(edges=march.edges.cpu().double(), occupied=march.occupied.cpu())


def random_grid(rows: int, contrast: float, generator: torch.Generator, *, antialias: bool = False) -> HashGrid:
    table = (contrast * torch.randn(8, rows, 4, generator=generator)).half().float()
    return HashGrid(table, tuple(range(4, 12)), tuple(layers_of(32, generator)), antialias=antialias)


def in_double(grid: HashGrid) -> HashGrid:
    return grid._replace(table=grid.table.double(), layers=tuple(x.double() for x in grid.layers))


def seen_on_device(rays: Rays, march: March, grid: HashGrid, **options: Any) -> Samples:
    """Return the samples by the GPU kernel, from half of the table's precision."""
    options = {"capacity": marching.Capacity(), **options}
    table = grid.table.half().to(DEVICE)
    return marching.visible_samples(rays, march, grid._replace(layers=on_device(*grid.layers)), table=table, **options)


@pytest.mark.parametrize(("count", "room", "faded"), [(0, 0, False), (1, 0, True), (5, 1, True), (60, 2000, False)])
def test_visible_samples(count, room, faded, generator):
    """With no, too little and too much room for candidates."""
    rays, march = rays_and_march(count, torch.float32, DEVICE)
    march, grid = march._replace(max_optical_depth=1.0), random_grid(64, 0.7, generator, antialias=faded)
    exact = reference.visible_samples(*exactly(rays, march), in_double(grid))
    fast = seen_on_device(rays, march, grid, capacity=marching.Capacity(room))
    assert torch.equal(fast.offsets.cpu(), exact.offsets)  # for these seeds both keep the same samples
    assert torch.equal(present(fast.rays).cpu(), reference.ray_indices(exact.offsets))
    for name, relative in (("starts", SINGLE), ("ends", SINGLE), ("coordinates", SINGLE), ("encoded", HALF)):
        assert_close(getattr(fast, name).float(), getattr(exact, name), name, relative=relative)
    assert_close(fast.density, exact.density, "density", relative=HALF)


@pytest.mark.parametrize(("least", "fraction"), [(0.0, 1.0), (0.02, 0.9), (0.08, 0.6), (2.0, 1.0)])
def test_faint_samples_are_left_out_but_counted_for_visits_and_never_all(least, fraction, generator):
    """With 0, none is left out; with 0.02, a tenth or more; with 0.08, 40 %; with 2, all are kept."""
    rays, march = rays_and_march(60, torch.float32, DEVICE)
    march, grid = march._replace(max_optical_depth=3.0, least_weight=least), random_grid(64, 0.7, generator)
    expected_visits, cell_depths = torch.zeros(8, 8, 8, dtype=torch.float64), torch.zeros(8, 8, 8, device=DEVICE)
    exact = reference.visible_samples(*exactly(rays, march), in_double(grid), expected_visits)
    fast = seen_on_device(rays, march, grid, cell_depths=cell_depths)
    every = reference.visible_samples(*exactly(rays, march._replace(least_weight=0.0)), in_double(grid))
    assert len(exact.starts) <= fraction * len(every.starts)
    assert torch.equal(fast.offsets.cpu(), exact.offsets)  # for this seed both keep the same samples
    assert_close(fast.starts, exact.starts, "starts")
    assert_close(fast.density, exact.density, "density", relative=HALF)
    assert_close(cell_depths, expected_visits, "visits", relative=HALF)
    assert least != 0.08 or ((cell_depths > 0) & (cell_depths < least)).any()  # cells in which all samples are left out


def test_visits_leave_out_densities_that_are_not_a_number(generator):
    rays, march = rays_and_march(60, torch.float32, DEVICE)
    grid = random_grid(64, 0.7, generator)
    grid.table[0, ::16] = torch.nan
    cell_depths = torch.full((8, 8, 8), -1.0, device=DEVICE)
    seen = seen_on_device(rays, march, grid, cell_depths=cell_depths)
    assert seen.density.isnan().any()
    assert not cell_depths.isnan().any()
    assert (cell_depths >= 0).any()


@pytest.mark.parametrize("samples", SIZES)
def test_contracted_distances(samples, generator):
    """At the camera, beside the place where the formula changes, and at the largest numbers."""
    starts = 10.0 ** (4.0 * torch.rand(samples, generator=generator) - 2.0)
    starts[::7], starts[1::7], starts[2::7], starts[3::7] = 0.0, 1.0, 1e30, math.inf
    ends = (1.5 * starts).clamp_min(1e-20)
    found = compositing.contracted_distances(*on_device(starts, ends))
    for distances, contracted in zip((starts, ends), found, strict=True):
        assert_close(contracted, reference.contracted_distance(distances.double()), "contracted distances")


@pytest.mark.parametrize(("count", "with_sink"), [(0, False), (1, True), (5, False), (23, True)])
def test_a_training_gets_what_the_reference_gives_in_float64(count, with_sink):
    """Colours, distortion and gradients of rays, layers and rows, with and without a sink and fading levels."""
    settings = replace(COMPILED, width=64 if with_sink else 32, antialias=with_sink)
    given = {"targets": Targets(1.0, True, torch.linspace(0.7, 1.7, 11)[: count // 2]), "with_sink": with_sink}
    exact = learned(field_of(settings, Backend(CPU), torch.float64), count, **given)
    fast = learned(field_of(settings, TritonBackend(DEVICE), torch.float32, DEVICE), count, **given)
    assert int(fast["samples"]) == int(exact["samples"])
    assert fast.keys() == exact.keys()
    for name, value in fast.items():
        if name != "samples":
            assert_close(value, exact[name], name, relative=5 * HALF)


def test_a_picture_is_what_the_reference_gives_in_float64(generator):
    rays, march = rays_and_march(23, torch.float32, DEVICE)
    grid, background = random_grid(256, 0.5, generator), torch.tensor([0.25, 0.5, 1.0])
    options = TraceOptions((0.25, 0.5), 0.3)
    here = grid._replace(table=grid.table.to(DEVICE), layers=on_device(*grid.layers))
    fast = TritonBackend(DEVICE).trace_rays(rays, march, here, options, background=background.to(DEVICE))
    exact = Backend(CPU).trace_rays(*exactly(rays, march), in_double(grid), options, background=background.double())
    assert torch.equal(fast.intervals.offsets.cpu(), exact.intervals.offsets)
    assert_close(fast.rgb, exact.rgb, "rgb", relative=HALF)
    assert_close(fast.truncation_error, exact.truncation_error, "error", relative=HALF)
    for name in ("opacity", "transmittance", "mean", "quantiles"):
        defined = getattr(exact.ends, name).isfinite()
        assert torch.equal(getattr(fast.ends, name).cpu().isfinite(), defined), name
        assert_close(getattr(fast.ends, name).cpu()[defined], getattr(exact.ends, name)[defined], name, relative=HALF)


def test_the_half_copy_follows_the_table(generator):
    """After a step of Adam, which writes the copy, and after other changes, such as loading a checkpoint."""
    backend = TritonBackend(DEVICE)
    table = torch.randn(1, 16, 4, generator=generator).to(DEVICE)
    gradient, first, second = torch.ones_like(table), torch.zeros_like(table), torch.zeros_like(table)
    backend.adam_rows(table, gradient, first, second, step=AdamStep(1, 0.1, (0.9, 0.99), 1e-15))
    assert torch.equal(backend._half.of(table), table.half())
    with torch.no_grad():
        table.copy_(torch.zeros_like(table))
    assert torch.equal(backend._half.of(table), table.half())


def test_far_points_contract_as_in_the_reference(generator):
    """Out to distances whose squares overflow float32."""
    points = torch.randn(40, 3, generator=generator) * torch.logspace(-3, 36, 40)[:, None]
    rays = Rays(*on_device(points, torch.zeros(40, 3), torch.zeros(40)))
    march = March(*on_device(torch.tensor([0.0, 1.0, 2.0]), torch.ones(2, 2, 2, dtype=torch.bool)), "l2", 1.0)
    found = marching.occupied_samples(rays, march)[2]
    assert_close(found, contract(points.double()) / 4 + 0.5, "coordinates")
    assert math.isfinite(float(found.sum()))


def test_all_branches_are_compiled_before_a_budget_begins(monkeypatch):
    launched: dict[Any, None] = {}
    monkeypatch.setattr(launch, "seen", launched)
    monkeypatch.setattr(launch, "INTERPRETED", True)  # elsewhere, `launch` notes no variants
    warm_up(DEVICE)
    seen.update(launched)
    found = {(variant.kernel.fn.__name__, *item) for variant in launched for item in variant.constants}
    values = {"VISITS": (False, True), "FADES": (False, True), "GRIDS": (False, True), "CHANNELS": (3, 4)}
    values |= {"DEGREE": (0, 3), "RAYS_LEARN": (False, True), "CONTRACTION": (0, 1)}
    branches = {(kernel, name) for kernel, name, _ in found if name in values}
    wanted = {(kernel, name, value) for kernel, name in branches for value in values[name]}
    assert wanted <= found


OF_SELFTEST = Precision(OF_GPU, torch.float32, str(DEVICE), for_gpu=True)


def hard_cases() -> Iterator[Any]:
    """Yield the rows of `nerfcli selftest --device cuda`; rays of 4096 samples take seconds in the interpreter."""
    for check in checks():
        if check.is_for(OF_SELFTEST):
            takes_long = "1 to 4096" in check.case and "depth 1 per" not in check.case
            yield pytest.param(check, id=check.case, marks=pytest.mark.slow if takes_long else ())


@pytest.mark.parametrize("check", list(hard_cases()))
def test_hard_cases_are_within_the_bounds_of_float32(check):
    with np.errstate(over="ignore", invalid="ignore"):  # the interpreter is NumPy
        row = row_of(check, OF_SELFTEST)
    assert row.verdict == MET, row


@pytest.fixture(scope="session", autouse=True)
def _variants() -> Iterator[None]:
    """Write the launched kernel variants to a file, for the test that compiles them."""
    yield
    if path := os.environ.get("NERFCLI_VARIANTS"):
        listed = [(variant.kernel.fn.__module__, variant.kernel.fn.__name__, *variant[1:]) for variant in seen]
        Path(path).write_text(json.dumps(listed))
