"""Depths, depth quantiles and optical depths of hard rays, against 60-digit answers."""

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from hard_cases import exact, exact_depths
from hard_cases.exact_depths import FRACTIONS, quantile_name
from nerfcli.kernels import RayTermination
from nerfcli.kernels.selftest import textbook
from nerfcli.kernels.selftest.cases import (
    MEANINGLESS,
    Ray,
    Segments,
    deepest_ray,
    depth_rays,
    thick_and_thin,
)
from nerfcli.kernels.selftest.measure import Errors, Precision, Row, largest_error

# Rays with at most this many intervals form the coarse group; all others form the fine one.
FEW = 15
GRADIENT_BOUND = 3
_FRACTIONS = {quantile_name(fraction): fraction for fraction in FRACTIONS}
VALUE_ONLY = "the compiled kernel has none: where one is wanted, plain torch gives both"


def rows(precisions: tuple[Precision, ...]) -> Iterator[Row]:
    """Yield the rows of all depth operations."""
    for precision in precisions:
        yield _before_row(precision)
        rays = [_rounded(ray, precision) for ray in depth_rays()]
        yield from _depth_rows([ray for ray in rays if len(ray.density) <= FEW], precision, cut="1 to 15")
        yield from _depth_rows([ray for ray in rays if len(ray.density) > FEW], precision, cut="100 or 256")


# The depths, grouped by what makes them hard: name of the group, columns.
_DEPTHS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("opacity and transmittance from 1e-12 to opaque", ("opacity", "transmittance")),
    ("mean depth, of next to no light and of none", ("conditional",)),
    ("spread of depth, of shells and fog", ("spread",)),
    ("mean depth of the interval that stops most light", ("max-weight",)),
    (
        "median and quantiles, not reached and inside intervals (no gradient where they jump over a gap)",
        tuple(quantile_name(fraction) for fraction in FRACTIONS),
    ),
)


@dataclass(frozen=True)
class _Measured:
    """The error of a depth and the bound on it, for the ray that comes nearest to its bound."""

    errors: Errors
    bounds: Errors


def _depth_rows(rays: list[Ray], precision: Precision, *, cut: str) -> Iterator[Row]:
    if precision.dtype == torch.bfloat16:
        rays = [ray for ray in rays if _bound(ray, precision) <= MEANINGLESS]
    if not rays:
        return
    wanted = [exact_depths.ray_termination(ray) for ray in rays]
    density, starts, ends, offsets = _packed(rays, precision)
    density.requires_grad_(not precision.compiled)
    module = precision.parts
    start = time.perf_counter()
    seen = _columns(module.ray_termination(density, starts, ends, offsets=offsets, fractions=FRACTIONS))
    slopes = _gradients(seen, density)
    seconds = time.perf_counter() - start
    plain = textbook.depth(density, starts, ends, offsets=offsets)
    plain_slopes = _gradients(plain, density)

    for name, columns in _DEPTHS:

        def nearest(
            values: dict[str, Tensor], slopes: dict[str, Tensor], columns: tuple[str, ...] = columns
        ) -> _Measured:
            """Return the error and bound of the ray whose error is the largest fraction of its bound."""
            shown = [column for column in columns if column in values]
            return _nearest(rays, wanted, columns=shown, values=values, slopes=slopes, offsets=offsets, at=precision)

        ours = nearest(seen, slopes)
        yield Row(
            case=f"{name}; {cut} intervals",
            operation="ray_termination",
            precision=precision.name,
            errors=ours.errors,
            bounds=ours.bounds,
            reason="of the ray nearest to its bound: b = u (16 + (n + 2) (1 + tau)), compiled 16 u; of a spread times "
            "1 + the mean, from where most light ends, over the spread; of a gradient by density 3 b relative to its "
            "terms: weights, their sum, and the sums of the backward pass",
            no_gradient=VALUE_ONLY if precision.compiled else "",
            formula="weights by 1 - exp at midpoints, their sum clamped at 1e-10",
            textbook=None
            if precision.compiled or not plain.keys() & set(columns)
            else nearest(plain, plain_slopes).errors,
            seconds=seconds,
        )


def _nearest(
    rays: list[Ray],
    wanted: list[exact_depths.RayTermination],
    *,
    columns: list[str],
    values: dict[str, Tensor],
    slopes: dict[str, Tensor],
    offsets: Tensor,
    at: Precision,
) -> _Measured:
    found: list[list[tuple[float, float]]] = [[], []]
    parts = offsets.tolist()
    for i, (ray, answer) in enumerate(zip(rays, wanted, strict=True)):
        for column in columns:
            bound, depth = _bound(ray, at), answer.depths[column]
            if column in _FRACTIONS and not exact_depths.is_settled(ray, _FRACTIONS[column], within=bound):
                continue
            if column == "spread" and depth.value > 0:
                bound *= 1 + abs(answer.depths["conditional"].value - answer.anchor) / depth.value
            found[0].append((largest_error(values[column][i : i + 1], [depth.value], tiny=at.tiny), bound))
            if column in slopes and GRADIENT_BOUND * bound <= MEANINGLESS:
                slope = slopes[column][parts[i] : parts[i + 1]]
                error = largest_error(slope, depth.gradient, tiny=at.tiny, scale=depth.size)
                found[1].append((error, GRADIENT_BOUND * bound))
    value, gradient = (max(pairs, key=lambda pair: pair[0] / pair[1], default=None) for pairs in found)
    assert value is not None
    return _Measured(
        Errors(value[0], gradient[0] if gradient else None), Errors(value[1], gradient[1] if gradient else None)
    )


def _gradients(columns: dict[str, Tensor], density: Tensor) -> dict[str, Tensor]:
    """Return the density gradient of each column's sum without its NaNs, or {} if `density` requires no gradient."""
    if not density.requires_grad:
        return {}
    sums = {name: torch.where(values.isnan(), 0.0, values).sum() for name, values in columns.items()}
    return {
        name: torch.autograd.grad(total, density, retain_graph=True)[0] if total.requires_grad else density * 0.0
        for name, total in sums.items()
    }


def _packed(rays: list[Ray], precision: Precision) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return density, starts, ends and offsets."""
    density, starts, ends = (
        precision.tensor([x for values in column for x in values])
        for column in ([r.density for r in rays], [r.starts for r in rays], [r.ends for r in rays])
    )
    return density, starts, ends, _offsets([len(ray.density) for ray in rays], precision)


def _offsets(counts: list[int], precision: Precision) -> Tensor:
    return torch.tensor([0, *itertools.accumulate(counts)], device=precision.device)


def _bound(ray: Ray, precision: Precision) -> float:
    """Return the bound on the relative error of a ray's depth; see `_depth_rows`."""
    if precision.compiled:
        return 16 * precision.unit
    lengths = tuple(end - start for start, end in zip(ray.starts, ray.ends, strict=True))
    samples, depth = deepest_ray([Segments(tuple(ray.density), lengths)], precision)
    return precision.unit * (16 + (samples + 2) * (1 + depth))


def _columns(seen: RayTermination) -> dict[str, Tensor]:
    named = {"opacity": seen.opacity, "transmittance": seen.transmittance, "spread": seen.spread}
    named |= {"conditional": seen.mean, "max-weight": seen.peak}
    return named | {quantile_name(fraction): seen.quantiles[:, i] for i, fraction in enumerate(FRACTIONS)}


def _rounded(ray: Ray, precision: Precision) -> Ray:
    """Return the ray with its numbers rounded so that both float32 and the precision hold them exactly."""
    dtype = torch.bfloat16 if precision.dtype == torch.bfloat16 else torch.float32
    columns = (torch.tensor(v, dtype=dtype).double().tolist() for v in (ray.density, ray.starts, ray.ends))
    return Ray(ray.name, *columns)


def _flat(rays: list[Segments], precision: Precision) -> tuple[Tensor, Tensor, Tensor]:
    """Return density, lengths and offsets."""
    density = precision.tensor([x for ray in rays for x in ray.density])
    lengths = precision.tensor([x for ray in rays for x in ray.lengths])
    return density, lengths, _offsets([len(ray.density) for ray in rays], precision)


def _by_density(answers: Tensor, density: Tensor, upstream: list[float]) -> Tensor | None:
    """Return the density gradient of a weighted sum of answers, or None if `density` requires no gradient."""
    if not density.requires_grad:
        return None
    (gradient,) = torch.autograd.grad(answers, density, grad_outputs=torch.tensor(upstream).to(answers))
    return gradient


def _before_row(precision: Precision) -> Row:
    rays = thick_and_thin(precision)
    wanted = [x for ray in rays for x in exact.optical_depths(ray)[:-1]]
    upstream = [(k % 3 + 1) / 4 for ray in rays for k in range(len(ray.density))]
    density, lengths, offsets = _flat(rays, precision)
    density.requires_grad_(not precision.compiled)
    module = precision.parts
    start = time.perf_counter()
    got = module.optical_depth_before(density, lengths, offsets)
    slope = _by_density(got, density, upstream)
    seconds = time.perf_counter() - start
    plain = textbook.optical_depth_before(density, lengths, offsets=offsets)
    slopes = []
    for ray in rays:
        behind = list(itertools.accumulate(((k % 3 + 1) / 4 for k in reversed(range(len(ray.lengths)))), initial=0.0))
        slopes += [length * upstream for length, upstream in zip(ray.lengths, behind[-2::-1], strict=True)]

    def errors(values: Tensor, slope: Tensor | None) -> Errors:
        tiny = precision.tiny
        return Errors(
            largest_error(values, wanted, tiny=tiny), None if slope is None else largest_error(slope, slopes, tiny=tiny)
        )

    bound = precision.unit * (2 if precision.compiled else max(len(ray.density) for ray in rays) + 1)
    return Row(
        case="optical depth in front of an interval that is 1e11 times as thick, 1 to 4096",
        operation="optical_depth_before",
        precision=precision.name,
        errors=errors(got, slope),
        bounds=Errors(bound, None if precision.compiled else bound),
        reason="(n + 1) u: sums of n terms that are all positive; compiled 2 u: sums in float64",
        no_gradient=VALUE_ONLY if precision.compiled else "",
        formula="cumulative sum less the own part",
        textbook=None if precision.compiled else errors(plain, _by_density(plain, density, upstream)),
        seconds=seconds,
    )
