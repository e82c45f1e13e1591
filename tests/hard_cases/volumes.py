"""Line integrals through thin and thick voxels, against 60-digit closed forms and against their transpose."""

import time
from collections.abc import Iterator
from decimal import Decimal, localcontext

import torch

from hard_cases.exact import DIGITS
from nerfcli.kernels.selftest import operations
from nerfcli.kernels.selftest.cases import THICKNESSES, VOLUME_FIRST, VOXEL
from nerfcli.kernels.selftest.measure import Errors, Precision, Row, largest_error

# Number of layers along x, and the width in y and z, wide enough that sloped lines stay far from the sides.
LAYERS, WIDE = 10, 33
SLOPES = ((0.0, 0.0), (0.125, 0.0), (0.5, -0.25), (-0.75, 0.9375))


def rows(precisions: tuple[Precision, ...]) -> Iterator[Row]:
    """Yield the rows of projection and back-projection."""
    for precision in precisions:
        if precision.dtype == torch.bfloat16:
            continue
        for thickness in THICKNESSES:
            yield _slab_row(thickness, precision)
            yield _adjoint_row(thickness, precision)


def _slab_row(thickness: float, precision: Precision) -> Row:
    """Measure lines along (1, b, c) through uniform layers: size sqrt(1 + b^2 + c^2) sum of values."""
    values = precision.tensor([thickness * (k + 1) / LAYERS**2 for k in range(LAYERS)])
    volume = values.expand(WIDE, WIDE, LAYERS).contiguous()
    directions = torch.tensor([(1.0, b, c) for b, c in SLOPES], dtype=torch.float64, device=precision.device)
    middle = torch.tensor([VOXEL * (LAYERS - 1) / 2, 0.0, 0.0], dtype=torch.float64, device=precision.device)
    first = (0.0, -VOXEL * (WIDE - 1) / 2, -VOXEL * (WIDE - 1) / 2)
    start = time.perf_counter()
    got = precision.parts.project(
        volume, middle.expand_as(directions).contiguous(), directions, first=first, size=VOXEL
    )
    seconds = time.perf_counter() - start
    with localcontext() as context:
        context.prec = DIGITS
        total = sum((Decimal(value) for value in values.double().tolist()), Decimal(0))
        wanted = [float(Decimal(VOXEL) * (1 + Decimal(b) ** 2 + Decimal(c) ** 2).sqrt() * total) for b, c in SLOPES]
    return Row(
        case=f"layers of thickness {thickness:g}, crossed at slopes",
        operation="project",
        precision=precision.name,
        errors=Errors(largest_error(got, wanted, tiny=precision.tiny)),
        bounds=Errors((4 if precision.compiled else 4 * LAYERS + 4) * precision.unit),
        reason="(4 n + 4) u: sums over n planes of 4 voxels, all positive; compiled 4 u: sums in float64",
        seconds=seconds,
    )


def _adjoint_row(thickness: float, precision: Precision) -> Row:
    """Measure <A x, y> = <x, A^T y> for `project` and `back_project`, with both products in float64."""
    given = operations.volume_inputs(thickness, precision)
    grid = {"first": VOLUME_FIRST, "size": VOXEL}
    lines = (given["origins"], given["directions"])
    start = time.perf_counter()
    forward = precision.parts.project(given["volume"], *lines, **grid)
    back = precision.parts.back_project(given["gains"], *lines, shape=tuple(given["volume"].shape), **grid)
    seconds = time.perf_counter() - start
    one, other = ((a.double() * b.double()).sum() for a, b in ((forward, given["gains"]), (given["volume"], back)))
    planes = max(given["volume"].shape)
    return Row(
        case=f"projector and transpose, line integrals up to {thickness:g}",
        operation="project",
        precision=precision.name,
        errors=Errors(largest_error(one, other, tiny=precision.tiny)),
        bounds=Errors((8 if precision.compiled else 8 * planes) * precision.unit),
        reason="the roundings of both: 8 n u, n planes; compiled 8 u",
        seconds=seconds,
    )
