"""Weights, colours and distortion of hard rays, with gradients, in every precision."""

import functools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from hard_cases import exact
from hard_cases.exact import Composited
from nerfcli.kernels.selftest import textbook
from nerfcli.kernels.selftest.cases import FAR_SURFACE, MEANINGLESS, Group, Segments, deepest_ray, groups
from nerfcli.kernels.selftest.measure import Errors, Precision, Row, largest_error

# A bfloat16 sum of more terms than this has no correct digits.
MOST_IN_BFLOAT16 = 16
BACKGROUND = [1.0, 0.5, 0.25]
COLOUR_GRADIENT = [1.0, 0.5, 0.25]
TRANSMITTANCE_GRADIENT = 0.5

COMPILED_BOUND = "8 roundings u of the result: sums in float64; of a gradient 16, relative to its terms"
REFERENCE_BOUND = (
    "u (8 + (n + 2) (1 + tau)): sums of n terms, and exp turns the error of tau into one of the result; n and tau as "
    "far as light comes; twice for a gradient, relative to its terms"
)
NERF = "1 - exp, cumulative product, 1 - sum of weights"


@dataclass(frozen=True)
class _Packed:
    """Rays in the layout that the kernels expect."""

    density: Tensor
    rgb: Tensor
    lengths: Tensor
    offsets: Tensor
    background: Tensor
    weights_gradient: Tensor


def rows(precisions: tuple[Precision, ...]) -> Iterator[Row]:
    """Yield the rows of compositing and distortion."""
    for group in groups():
        answers = [_exact(ray) for ray in group.rays]
        for precision in precisions:
            yield from _composite_row(group, answers, precision)
    yield from _subtraction_rows(precisions)
    for precision in precisions:
        if precision.dtype != torch.bfloat16:
            yield _distortion_row(precision)


def _rgb(samples: int) -> list[list[float]]:
    return [[(k % 5 + 1) / 8, (k % 3 + 1) / 4, (k % 7 + 1) / 8] for k in range(samples)]


def _weights_gradient(samples: int) -> list[float]:
    return [(k % 3 - 1) / 2 for k in range(samples)]


@functools.cache
def _exact(ray: Segments) -> Composited:
    samples = len(ray.density)
    return exact.composited(
        ray,
        _rgb(samples),
        BACKGROUND,
        colour_gradient=COLOUR_GRADIENT,
        transmittance_gradient=TRANSMITTANCE_GRADIENT,
        weights_gradient=_weights_gradient(samples),
    )


def _packed(rays: list[Segments], precision: Precision) -> _Packed:
    density, lengths, rgb, gradient, offsets = [], [], [], [], [0]
    for ray in rays:
        density += ray.density
        lengths += ray.lengths
        rgb += _rgb(len(ray.density))
        gradient += _weights_gradient(len(ray.density))
        offsets.append(len(density))
    return _Packed(
        density=precision.tensor(density).requires_grad_(),
        rgb=precision.tensor(rgb).reshape(-1, 3).requires_grad_(),
        lengths=precision.tensor(lengths),
        offsets=torch.tensor(offsets, device=precision.device),
        background=precision.tensor([BACKGROUND] * len(rays)),
        weights_gradient=precision.tensor(gradient),
    )


def _bounds(rays: list[Segments], precision: Precision) -> tuple[Errors, str]:
    if precision.compiled:
        return Errors(8 * precision.unit, 16 * precision.unit), COMPILED_BOUND
    samples, depth = deepest_ray(rays, precision)
    bound = precision.unit * (8 + (samples + 2) * (1 + depth))
    return Errors(bound, 2 * bound), REFERENCE_BOUND


def _composite_row(group: Group, answers: list[Composited], precision: Precision) -> Iterator[Row]:
    most = MOST_IN_BFLOAT16 if precision.dtype == torch.bfloat16 else math.inf
    chosen = [(ray, answer) for ray, answer in zip(group.rays, answers, strict=True) if len(ray.density) <= most]
    if not chosen:
        return
    rays, wanted = [ray for ray, _ in chosen], [answer for _, answer in chosen]
    module = precision.parts
    errors, seconds = _composite_errors(module.composite, rays, wanted, precision=precision)
    bounds, reason = _bounds(rays, precision)
    if bounds.value > MEANINGLESS:
        return
    yield Row(
        case=group.name,
        operation="composite",
        precision=precision.name,
        errors=errors,
        bounds=bounds,
        reason=reason,
        formula=NERF,
        textbook=None
        if precision.compiled
        else _composite_errors(textbook.composite, rays, wanted, precision=precision)[0],
        seconds=seconds,
    )


def _composite_errors(operation, rays, wanted, *, precision):  # type: ignore[no-untyped-def]
    packed = _packed(rays, precision)
    start = time.perf_counter()
    colour, transmittance, weights = operation(
        packed.density, packed.rgb, packed.lengths, offsets=packed.offsets, background=packed.background
    )
    loss = (colour * precision.tensor(COLOUR_GRADIENT)).sum() + TRANSMITTANCE_GRADIENT * transmittance.sum()
    (loss + (packed.weights_gradient * weights).sum()).backward()
    seconds = time.perf_counter() - start
    assert packed.density.grad is not None
    assert packed.rgb.grad is not None
    all_weights = [w for answer in wanted for w in answer.weights]
    tiny = precision.tiny
    value = max(
        largest_error(weights, all_weights, tiny=tiny),
        largest_error(transmittance, [answer.transmittance for answer in wanted], tiny=tiny),
        largest_error(colour, [answer.colour for answer in wanted], tiny=tiny),
    )
    longest = max((length for ray in rays for length in ray.lengths), default=0.0)
    gradient = max(
        largest_error(
            packed.density.grad,
            [g for answer in wanted for g in answer.density_gradient],
            tiny=tiny * max(1.0, longest),
            scale=[s for answer in wanted for s in answer.density_gradient_size],
        ),
        largest_error(packed.rgb.grad, [[w * g for g in COLOUR_GRADIENT] for w in all_weights], tiny=tiny),
    )
    return Errors(value, gradient), seconds


def _subtraction_rows(precisions: tuple[Precision, ...]) -> Iterator[Row]:
    """Measure the gradient behind an opaque interval, which is lost in colour minus a running sum from the front."""
    ray = Segments((2.0**-4,) * 64 + (32.0, 16.0, 8.0, 4.0), (2.0**-6,) * 64 + (1.0,) * 4)
    values = [(k % 5 + 1) / 8 for k in range(len(ray.density))]
    wanted = exact.composited(
        ray,
        [[v] for v in values],
        [0.0],
        colour_gradient=[1.0],
        transmittance_gradient=0.0,
        weights_gradient=[0.0] * len(values),
    )
    for precision in precisions:
        if precision.dtype == torch.bfloat16:
            continue
        module = precision.parts
        density, lengths = precision.tensor(ray.density).requires_grad_(), precision.tensor(ray.lengths)
        rgb, offsets = precision.tensor([[v] * 3 for v in values]), torch.tensor([0, len(values)]).to(precision.device)
        start = time.perf_counter()
        colour, _, _ = module.composite(
            density, rgb, lengths, offsets=offsets, background=precision.tensor([[0.0] * 3])
        )
        colour[0, 0].backward()
        seconds = time.perf_counter() - start
        assert density.grad is not None
        with torch.no_grad():
            subtracted = _gradient_by_subtraction(density, lengths, rgb[:, 0], colour[0, 0])

        def error(gradient: Tensor, tiny: float = precision.tiny) -> float:
            return largest_error(gradient, wanted.density_gradient, tiny=tiny, scale=wanted.density_gradient_size)

        bounds, reason = _bounds([ray], precision)
        yield Row(
            case="gradient where hardly any light is left",
            operation="composite",
            precision=precision.name,
            errors=Errors(largest_error(colour[0], [wanted.colour[0]] * 3, tiny=precision.tiny), error(density.grad)),
            bounds=bounds,
            reason=reason,
            formula="colour less the running sum",
            textbook=None if precision.compiled else Errors(0.0, error(subtracted)),
            seconds=seconds,
        )


def _distortion_row(precision: Precision) -> Row:
    """Measure the distortion of the light of a distant surface."""
    starts, ends, values = FAR_SURFACE.values()
    count = len(values)
    wanted, wanted_gradient = exact.distortion(values, starts, ends)
    module = precision.parts
    first, last, offsets = precision.tensor(starts), precision.tensor(ends), torch.tensor([0, count])
    weights = precision.tensor(values).requires_grad_()
    start = time.perf_counter()
    answer = module.distortion(weights, first, last, offsets.to(precision.device))
    answer.sum().backward()
    seconds = time.perf_counter() - start
    plain = precision.tensor(values).requires_grad_()
    of_textbook = textbook.distortion(plain, first, last, offsets)
    of_textbook.backward()

    def errors(value: Tensor, gradient: Tensor | None) -> Errors:
        return Errors(
            largest_error(value.reshape(1), [wanted], tiny=precision.tiny),
            largest_error(gradient, wanted_gradient, tiny=precision.tiny),
        )

    bound = precision.unit * (8 if precision.compiled else 3 * count)
    return Row(
        case="distortion of a far, thin surface",
        operation="distortion",
        precision=precision.name,
        errors=errors(answer, weights.grad),
        bounds=Errors(bound, bound),
        reason="3 n u: sums of n terms that are all positive; compiled 8 u: sums in float64",
        formula="difference of running sums",
        textbook=None if precision.compiled else errors(of_textbook, plain.grad),
        seconds=seconds,
    )


def _gradient_by_subtraction(density: Tensor, lengths: Tensor, values: Tensor, colour: Tensor) -> Tensor:
    """Return d colour / d density of one ray, with the light behind a sample as the colour minus the running sum."""
    weights = textbook.weights_of_ray(density, lengths)
    after = torch.exp(-(density * lengths).cumsum(0))
    return lengths * (after * values - (colour - (weights * values).cumsum(0)))
