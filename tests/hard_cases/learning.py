"""Hard cases of training: densities at overflow, Adam's first steps, NaN in the occupancy grid."""

import math
import time
from collections.abc import Iterator

import torch
from torch import Tensor

from nerfcli.kernels import AdamStep
from nerfcli.kernels.activations import LOG_DENSITY_LIMIT, density_from_log
from nerfcli.kernels.selftest.cases import GRADIENTS, LOGARITHMS
from nerfcli.kernels.selftest.measure import Errors, Precision, Row, largest_error
from nerfcli.training.open_cells import Occupancy

RATE, BETAS, EPS = 0.01, (0.9, 0.99), 1e-15


def rows(precisions: tuple[Precision, ...]) -> Iterator[Row]:
    """Yield the rows of all training operations."""
    for precision in precisions:
        yield _density_row(precision)
        if precision.dtype == torch.float32:
            yield _adam_row(precision)
        if precision.dtype != torch.bfloat16 and not precision.compiled:
            yield _poison_row(precision)


def _density_row(precision: Precision) -> Row:
    given = precision.tensor(LOGARITHMS).requires_grad_()
    wanted = [math.exp(min(max(x, -LOG_DENSITY_LIMIT), LOG_DENSITY_LIMIT)) for x in given.detach().double().tolist()]
    start = time.perf_counter()
    density = _through_networks(given, precision) if precision.compiled else density_from_log(given)
    density.sum().backward()
    seconds = time.perf_counter() - start
    plain = precision.tensor(LOGARITHMS).requires_grad_()
    of_textbook = torch.exp(plain)
    of_textbook.sum().backward()

    def errors(value: Tensor, gradient: Tensor | None) -> Errors:
        tiny = precision.tiny
        return Errors(largest_error(value, wanted, tiny=tiny), largest_error(gradient, wanted, tiny=tiny))

    bound = (8 if precision.compiled else 4) * precision.unit
    return Row(
        case="density of a logarithm from -1000 to 3e38",
        operation="radiance" if precision.compiled else "density_from_log",
        precision=precision.name,
        errors=errors(density, given.grad),
        bounds=Errors(bound, bound),
        reason="4 u of exp within 15, compiled 8 u; constant beyond, with a gradient that does not vanish",
        formula="exp",
        textbook=None if precision.compiled else errors(of_textbook, plain.grad),
        seconds=seconds,
    )


def _through_networks(logarithms: Tensor, precision: Precision) -> Tensor:
    """Return densities from the compiled networks, with weights that pass each logarithm through unchanged.

    One hidden unit carries positive numbers, another negative ones.
    """
    shapes = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
    weights = tuple(precision.tensor([[0.0] * n] * m) for m, n in shapes)
    weights[0][0, 0], weights[0][1, 0], weights[1][0, 0], weights[1][0, 1] = 1.0, -1.0, 1.0, -1.0
    encoded = torch.nn.functional.pad(logarithms[:, None], (0, 31))
    rays = torch.zeros(len(logarithms), dtype=torch.int64)
    return precision.parts.radiance(encoded, precision.tensor([[0.0] * 16]), rays, weights)[0]


def _adam_row(precision: Precision) -> Row:
    """Measure the first step for gradients from 1e-17 to 1e10: its size is the rate for any gradient far above eps."""
    gradient = precision.tensor([[g, -g, g / 2, g] for g in GRADIENTS])
    # m / (1 - b1) = g and sqrt(v / (1 - b2)) = |g|: the step is rate g / (|g| + eps).
    wanted = [[-RATE * g / (abs(g) + EPS) for g in row] for row in gradient.double().tolist()]
    table, first, second = (torch.zeros_like(gradient) for _ in range(3))
    module = precision.parts
    start = time.perf_counter()
    module.adam_rows(table, gradient.clone(), first, second, step=AdamStep(1, RATE, BETAS, EPS))
    seconds = time.perf_counter() - start
    half = gradient.half()
    moment, square = (0.1 * half), (0.01 * half * half)
    plain = -RATE * (moment / 0.1) / ((square / 0.01).sqrt() + EPS)
    return Row(
        case="Adam's first step, gradients 1e-17 to 1e10",
        operation="adam_rows",
        precision=precision.name,
        errors=Errors(largest_error(table, wanted, tiny=precision.tiny)),
        bounds=Errors(16 / (1 - BETAS[1]) * precision.unit),
        reason="16 u / (1 - beta2): 1 - beta2 of a rounded beta2; eps = 1e-15 counts, as the state is float32",
        formula="state in float16",
        textbook=None if precision.compiled else Errors(largest_error(plain, wanted, tiny=precision.tiny)),
        seconds=seconds,
    )


def _poison_row(precision: Precision) -> Row:
    """Check that cells with a NaN optical depth stay open, so that samples there carry the NaN into the loss."""
    start = time.perf_counter()
    grid = Occupancy(4, torch.device(precision.device))
    grid.optical_depth = precision.tensor([[[0.0, 1.0, math.nan, math.inf]] * 4] * 4)
    open_cells = grid.above(0.5)
    seconds = time.perf_counter() - start
    wanted = torch.tensor([False, True, True, True]).expand(4, 4, 4)
    return Row(
        case="NaN in the occupancy grid",
        operation="Occupancy.above",
        precision=precision.name,
        errors=Errors((open_cells.cpu() != wanted).double().mean().item()),
        bounds=Errors(0.0),
        reason="share of cells that are wrongly open or closed",
        formula="optical depth > threshold",
        textbook=Errors(((grid.optical_depth > 0.5).cpu() != wanted).double().mean().item()),
        seconds=seconds,
    )
