"""What training meets: densities at overflow, Adam's first steps, draws from a histogram, a grid poisoned by NaN."""

import math
import time
from collections.abc import Iterator
from fractions import Fraction
from itertools import pairwise

import torch
from torch import Tensor

from nerfcli.kernels.activations import LOG_DENSITY_LIMIT, density_from_log
from nerfcli.render.occupancy import Occupancy
from nerfcli.render.sampling import inverse_cdf
from nerfcli.selftest import textbook
from nerfcli.selftest.measure import Errors, Precision, Row, largest_error

# Numbers of bfloat16, to beyond where exp overflows in every precision.
LOGARITHMS = (-1000.0, -89.0, -15.0, -1.0, 2.0**-20, 1.0, 14.5, 15.0, 16.0, 89.0, 720.0, 3e38)
RATE, BETAS, EPS = 0.01, (0.9, 0.99), 1e-15


def rows(precisions: tuple[Precision, ...]) -> Iterator[Row]:
    """Rows of everything about learning."""
    for precision in precisions:
        yield _density_row(precision)
        if precision.dtype == torch.float32:
            yield _adam_row(precision)
        if not precision.compiled:
            yield from _draw_rows(precision)
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
        hard_cases=(1,),
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
    """Densities by the compiled networks, of which one path for each sign carries the number through."""
    shapes = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
    weights = tuple(precision.tensor([[0.0] * n] * m) for m, n in shapes)
    weights[0][0, 0], weights[0][1, 0], weights[1][0, 0], weights[1][0, 1] = 1.0, -1.0, 1.0, -1.0
    encoded = torch.nn.functional.pad(logarithms[:, None], (0, 31))
    rays = torch.zeros(len(logarithms), dtype=torch.int64)
    return precision.parts.radiance(encoded, precision.tensor([[0.0] * 16]), rays, weights)[0]


def _adam_row(precision: Precision) -> Row:
    """The first step on rows with gradients from 1e-17 to 1e10: one step of the rate, whatever the gradient's size."""
    sizes = [10.0**e for e in (-17, -15, -12, -8, -4, 0, 4, 10)]
    gradient = precision.tensor([[g, -g, g / 2, g] for g in sizes])
    # m / (1 - b1) = g and sqrt(v / (1 - b2)) = |g|: the step is rate g / (|g| + eps).
    wanted = [[-RATE * g / (abs(g) + EPS) for g in row] for row in gradient.double().tolist()]
    table, first, second = (torch.zeros_like(gradient) for _ in range(3))
    module = precision.parts
    start = time.perf_counter()
    module.adam_rows(table, gradient.clone(), first, second, step=1, rate=RATE, betas=BETAS, eps=EPS)
    seconds = time.perf_counter() - start
    half = gradient.half()
    moment, square = (0.1 * half), (0.01 * half * half)
    plain = -RATE * (moment / 0.1) / ((square / 0.01).sqrt() + EPS)
    return Row(
        hard_cases=(10,),
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


# Name, weights of 8 bins, hard cases.
_HISTOGRAMS: tuple[tuple[str, tuple[float, ...], tuple[int, ...]], ...] = (
    ("flat", (1.0,) * 8, (7, 8)),
    ("zero", (0.0,) * 8, (7, 8)),
    ("one spike among empty bins", (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0), (7, 8)),
    ("spikes of small mass", (0.0, 1e-12, 0.0, 3e-12, 0.0, 1e-12, 1e-20, 0.0), (7, 8)),
    ("from 1e-30 to 1", (1e-30, 1.0, 1e-8, 0.0, 1e-30, 0.5, 1e-3, 1e-30), (7, 8)),
    ("sum beyond float32", (3e38, 0.0, 1e38, 3e38, 3e38, 0.0, 2e38, 1e38), (7, 8)),
    ("sum below float32's full digits", (1e-42, 0.0, 2e-42, 0.0, 0.0, 4e-42, 1e-42, 0.0), (7, 8)),
)
_EDGES = (1.0, 1.5, 2.0, 2.0625, 2.0625, 3.0, 7.0, 7.5, 11.0)  # the fourth bin from the left has no length
_DRAWS = (0.0, 1.0, 0.5, 0.25, 0.75, 2.0**-23, 1.0 - 2.0**-24, 0.9, 0.1, 0.5)  # neither sorted nor different


def _draw_rows(precision: Precision) -> Iterator[Row]:
    for name, masses, cases in _HISTOGRAMS:
        edges, draws = precision.tensor([_EDGES]), precision.tensor([_DRAWS])
        weights = torch.tensor([masses], dtype=torch.float32).to(precision.device, precision.dtype)
        start = time.perf_counter()
        got = inverse_cdf(edges, weights, uniform=draws)
        seconds = time.perf_counter() - start

        def error(places: Tensor, weights: Tensor = weights, draws: Tensor = draws) -> float:
            pairs = zip(draws[0].tolist(), places[0].tolist(), strict=True)
            return max(_share_off(weights[0].tolist(), share, place) for share, place in pairs)

        yield Row(
            hard_cases=cases,
            case=f"draws at u = 0, 1 and unsorted between: {name}",
            operation="inverse_cdf",
            precision=precision.name,
            errors=Errors(error(got)),
            bounds=Errors(32 * precision.unit),
            reason="4 u for each of 8 bins, of the share of mass below the draw; infinite in an empty bin",
            formula="weights padded by 1e-5",
            textbook=Errors(error(textbook.inverse_cdf(edges, weights, uniform=draws))),
            seconds=seconds,
        )


def _share_off(weights: list[float], share: float, place: float) -> float:
    """How far the share of mass below a place is from the one asked for; infinite where there is no mass."""
    if not math.isfinite(place):
        return math.inf
    exact = [Fraction(w) for w in weights]
    if not sum(exact):
        exact = [Fraction(b) - Fraction(a) for a, b in pairwise(_EDGES)]
    below, total, point = Fraction(0), sum(exact), Fraction(place)
    low, high = None, Fraction(0)
    for mass, left, right in zip(exact, _EDGES[:-1], _EDGES[1:], strict=True):
        if mass > 0 and left <= point <= right:
            inside = (point - Fraction(left)) / (Fraction(right) - Fraction(left)) if right > left else None
            first = below if inside is None else below + mass * inside
            last = below + mass if inside is None else first
            low, high = first if low is None else min(low, first), max(high, last)
        below += mass
    if low is None:
        return math.inf
    wanted = Fraction(share) * total
    return float(max(low - wanted, wanted - high, Fraction(0)) / total)


def _poison_row(precision: Precision) -> Row:
    """Cells whose optical depth is NaN are looked into, where the loss finds the NaN; they are not taken for empty."""
    start = time.perf_counter()
    grid = Occupancy(4, torch.device(precision.device))
    grid.optical_depth = precision.tensor([[[0.0, 1.0, math.nan, math.inf]] * 4] * 4)
    open_cells = grid.above(0.5)
    seconds = time.perf_counter() - start
    wanted = torch.tensor([False, True, True, True]).expand(4, 4, 4)
    return Row(
        hard_cases=(21,),
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
