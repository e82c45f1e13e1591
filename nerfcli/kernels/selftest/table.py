"""The table of hard cases: operation, inputs and bounds of each; all rows of the selftest."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import torch

from nerfcli import kernels
from nerfcli.kernels import reference
from nerfcli.kernels.selftest import cases, operations
from nerfcli.kernels.selftest.measure import Errors, Precision, Row

SINGLE, HALF, COMPILED, OF_GPU = "float32", "bfloat16", "compiled", "GPU kernels"
# Operations that the GPU kernels compute in float32 themselves, without the reference.
OPERATIONS_OF_GPU = (
    *("composite", "optical_depth_before", "distortion", "ray_termination"),
    *("hash_encode", "pixel_rays", "adam_rows", "visible_samples"),
)


@dataclass(frozen=True)
class Check:
    """One hard case of one operation.

    Args:
        inputs: returns the inputs, rounded to a precision, on which `run` operates.
        bound: returns the bounds of values and gradients in a precision, which `reason` derives.
        precisions: names of the precisions to test.
    """

    case: str
    operation: str
    inputs: Callable[[Precision], operations.Inputs]
    run: Callable[[ModuleType, operations.Inputs], operations.Outcome]
    bound: Callable[[Precision], Errors]
    reason: str
    precisions: tuple[str, ...] = (SINGLE, HALF, COMPILED)

    def is_for(self, precision: Precision) -> bool:
        """Return True if the case is tested in a precision and has correct digits there."""
        tried = self.operation in OPERATIONS_OF_GPU if precision.for_gpu else precision.name in self.precisions
        return tried and self.bound(precision).value <= cases.MEANINGLESS


def row_of(check: Check, precision: Precision) -> Row:
    """Measure the errors and time of one check in one precision."""
    inputs = check.inputs(precision)
    wanted = check.run(reference, {name: operations.exact(given) for name, given in inputs.items()})
    start = time.perf_counter()
    got = check.run(precision.parts, inputs)
    if precision.device != "cpu":
        torch.cuda.synchronize(precision.device)
    seconds = time.perf_counter() - start
    return Row(
        case=check.case,
        operation=check.operation,
        precision=precision.name,
        errors=operations.errors(got, wanted, tiny=precision.tiny),
        bounds=check.bound(precision),
        reason=check.reason,
        seconds=seconds,
    )


def checks() -> Iterator[Check]:
    """Yield every hard case."""
    yield from light_checks()
    for cut, thick in (("thin", False), ("thick", True)):
        rays = [ray for ray in cases.depth_rays() if (operations.optical_depth(ray) > 1) is thick]
        for name, columns in DEPTHS:
            yield depth_check(f"{name}; {cut} rays", columns, rays)
    yield from look_up_checks()
    yield from step_checks()
    for thickness in cases.THICKNESSES:
        yield volume_check(thickness)


def light_checks() -> Iterator[Check]:
    """Yield the cases of compositing, optical depths and distortion."""
    for name, rays in cases.groups().items():
        yield Check(
            name,
            "composite",
            partial(operations.light_inputs, rays),
            operations.composite,
            partial(operations.light_bound, rays),
            "u (8 + (n + 2) (1 + tau)), n and tau as far as light comes, compiled 8 u; twice for a gradient, relative "
            "to its terms",
        )
    yield Check(
        "optical depth in front of an interval that is 1e11 times as thick, 1 to 4096",
        "optical_depth_before",
        lambda precision: operations.intervals(cases.thick_and_thin(precision), precision),
        operations.before,
        lambda precision: Errors(
            (2 if precision.compiled else 17 if precision.name == HALF else 4097) * precision.unit
        ),
        "(n + 1) u: sums of n terms that are all positive, 16 in bfloat16; compiled 2 u: sums in float64",
    )
    yield Check(
        "distortion of a far, thin surface",
        "distortion",
        lambda precision: {name: precision.tensor(values) for name, values in cases.FAR_SURFACE.items()},
        operations.distortion,
        lambda precision: operations.both(8 if precision.compiled else 192, precision),
        "3 n u: sums of n terms that are all positive; compiled 8 u: sums in float64",
        (SINGLE, COMPILED),
    )


# The depths, grouped by what makes them hard.
DEPTHS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("opacity and transmittance", ("opacity", "transmittance")),
    ("mean depth, of next to no light and of none", ("conditional",)),
    ("spread of depth, of shells and fog", ("spread",)),
    ("mean depth of the interval that stops most light", ("max-weight",)),
    ("median and quantiles, not reached and inside intervals", tuple(operations.QUANTILES)),
)


def depth_check(case: str, columns: tuple[str, ...], rays: list[cases.Ray]) -> Check:
    """Return the case of some depths of rays."""
    factor = 4 if columns == ("spread",) else 1
    return Check(
        case,
        "ray_termination",
        lambda precision: operations.depth_inputs(operations.meaningful(rays, precision), precision),
        partial(operations.ray_termination, columns),
        lambda precision: operations.depth_bound(operations.meaningful(rays, precision), factor, precision),
        "u (16 + (n + 2) (1 + tau)), compiled 16 u; of a spread 4 times that",
    )


def look_up_checks() -> Iterator[Check]:
    """Yield the cases of features of hash grids and of rays of pixels."""
    for name, points, grids, rounded in (
        ("hash grid on borders and corners of cells, and outside", cases.BORDERS, cases.EXACT_GRIDS, 0),
        ("hash grid of up to 2048 cells, between vertices", cases.BETWEEN, cases.FINE_GRIDS, 1),
    ):
        yield Check(
            name,
            "hash_encode",
            partial(operations.grid_inputs, points, grids, rounded),
            operations.encode,
            lambda precision, n=len(points): Errors(16 * precision.unit, (16 + n) * precision.unit),
            "16 u, of a gradient 16 + n, relative to the largest of the level; where places are rounded as they are "
            "counted in cells, times the resolution",
            (SINGLE, COMPILED),
        )
    yield Check(
        "pixels beyond number 2^24, first, last and only ones of their photos",
        "pixel_rays",
        operations.pixel_inputs,
        operations.pixel_rays,
        lambda precision: Errors(4 * precision.unit),
        "4 u: a sum of three products, relative to its terms",
        (SINGLE, COMPILED),
    )


def step_checks() -> Iterator[Check]:
    """Yield the cases of densities, Adam, contraction and marching."""
    yield Check(
        "density of a logarithm from -1000 to 3e38",
        "density_from_log",
        lambda precision: {"logarithms": precision.tensor(cases.LOGARITHMS)},
        operations.density,
        lambda precision: operations.both(8, precision),
        "8 u: exp within 15; constant beyond, with a gradient that does not vanish",
    )
    yield Check(
        "Adam's first step, gradients 1e-17 to 1e10",
        "adam_rows",
        lambda precision: {"gradients": precision.tensor([[g, -g, g / 2, g] for g in cases.GRADIENTS])},
        operations.adam,
        lambda precision: Errors(16 / (1 - operations.BETAS[1]) * precision.unit),
        "16 u / (1 - beta2): 1 - beta2 of a rounded beta2; eps = 1e-15 counts, as the state is float32",
        (SINGLE, COMPILED),
    )
    for name, radii in cases.CONTRACTED:
        yield Check(
            name,
            "contract",
            partial(operations.contract_inputs, radii),
            lambda module, given: operations.gradients_of(kernels.contract, given["points"]),
            lambda precision: Errors(8 * precision.unit, 64 * precision.unit),
            "8 roundings u; of the gradient 64, relative to the largest of its point",
            (SINGLE, HALF),
        )
    for name, full in (("rays along axes, and in the plane of a side", True), ("empty occupancy", False)):
        yield Check(
            name,
            "visible_samples",
            partial(operations.march_inputs, full),
            operations.chords,
            lambda precision: Errors(0.0),
            "exact: steps of 2^-7 are kept or not by their middles; nothing is divided by a direction",
            (SINGLE, COMPILED),
        )


def volume_check(thickness: float) -> Check:
    """Return the case of line integrals through a volume."""
    planes = max(cases.VOLUME_SHAPE)
    return Check(
        f"line integrals up to {thickness:g} and their transpose, source near and 4e6 voxels away",
        "project",
        partial(operations.volume_inputs, thickness),
        operations.project,
        lambda precision: Errors((4 if precision.compiled else 4 * planes + 4) * precision.unit),
        "(4 n + 4) u: sums over n planes of 4 voxels, all positive; compiled 4 u: sums in float64",
        (SINGLE, COMPILED),
    )


def precisions(device: str) -> tuple[Precision, ...]:
    """List the precisions to test on a device, with the compiled CPU kernels if they work on this machine."""
    plain = tuple(
        Precision(name, dtype, device) for name, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16))
    )
    compiled = (Precision("compiled", torch.float32, "cpu", compiled=True),) if kernels.has_compiled() else ()
    has_gpu_kernels = kernels.triton_unavailable_reason(torch.device(device)) is None
    of_gpu = (Precision(OF_GPU, torch.float32, device, for_gpu=True),) if has_gpu_kernels else ()
    return plain + of_gpu + compiled


def rows(device: str, notify: Callable[[str], None]) -> Iterator[Row]:
    """Measure and yield the rows one by one."""
    kernels.prepare(notify)
    if device != "cpu":
        kernels.prepare(notify, device)
    for check in checks():
        for precision in precisions(device):
            if check.is_for(precision):
                yield row_of(check, precision)
