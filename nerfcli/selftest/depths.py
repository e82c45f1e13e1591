"""Where light ends, and how much lies before: depths, optical depths and line integrals of hard rays."""

import itertools
import math
import time
from collections.abc import Iterator

import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.kernels import depth as depth_reference
from nerfcli.kernels import reference
from nerfcli.kernels.depth import LightEnds
from nerfcli.render.transmission import line_integral
from nerfcli.selftest import exact, textbook
from nerfcli.selftest.measure import Errors, Precision, Row, largest_error
from nerfcli.selftest.rays import Intervals, Ray, depth_rays, even, fog, lit

FAR = 300.0
# Rays of the depths are either cut a few times or finely.
FEW = 15


def rows(precisions: tuple[Precision, ...]) -> Iterator[Row]:
    """Rows of everything about depth."""
    for precision in precisions:
        yield _before_row(precision)
        if not precision.compiled:
            yield _integral_row(precision)
        if precision.dtype != torch.bfloat16:
            rays = [_single(ray) for ray in depth_rays()]
            yield from _depth_rows([ray for ray in rays if len(ray.density) <= FEW], precision, cut="1 to 15")
            yield from _depth_rows([ray for ray in rays if len(ray.density) > FEW], precision, cut="100 or 256")
            yield _mixture_row(precision)


# The depths, by what is hard about them: name of the group, cases, columns.
_DEPTHS: tuple[tuple[str, tuple[int, ...], tuple[str, ...]], ...] = (
    ("opacity and transmittance from 1e-12 to opaque", (2, 3), ("opacity", "transmittance")),
    ("mean depth, of next to no light and of none", (5, 23), ("conditional",)),
    ("spread of depth, of shells and fog", (23,), ("spread",)),
    ("median and quantiles, not reached and inside intervals", (6,), ("median", "quantile:0.05", "quantile:0.95")),
)


def _depth_rows(rays: list[Ray], precision: Precision, *, cut: str) -> Iterator[Row]:
    wanted = [exact.light_ends(ray, far=FAR) for ray in rays]
    density, starts, ends, offsets = _packed(rays, precision)
    module = kernels if precision.compiled else depth_reference
    start = time.perf_counter()
    seen = module.light_ends(density, starts, ends, offsets=offsets, shares=exact.SHARES)
    seconds = time.perf_counter() - start
    plain = textbook.depth(density, starts, ends, offsets=offsets)
    for name, cases, columns in _DEPTHS:
        allowed = [_depth_bound(*pair, precision, wide="spread" in columns) for pair in zip(rays, wanted, strict=True)]

        def nearest(
            answers: dict[str, Tensor], columns: tuple[str, ...] = columns, allowed: list[float] = allowed
        ) -> tuple[float, float]:
            """Error and bound of the ray that comes nearest to its bound, or is farthest beyond."""
            shown = [column for column in columns if column in answers]
            errors = [
                max(largest_error(answers[c][i : i + 1], [one[c]], tiny=precision.tiny) for c in shown)
                for i, one in enumerate(wanted)
            ]
            ratios = [error / bound for error, bound in zip(errors, allowed, strict=True)]
            worst = ratios.index(max(ratios))
            return errors[worst], allowed[worst]

        error, bound = nearest(_columns(seen))
        yield Row(
            hard_cases=cases,
            case=f"{name}; {cut} intervals",
            operation="light_ends",
            precision=precision.name,
            errors=Errors(error),
            bounds=Errors(bound),
            reason="of the ray nearest to its bound: u (16 + (n + 2) (1 + tau)), of a spread times 1 + the mean, from "
            "where most light ends, over the spread; compiled 16 u",
            formula="weights by 1 - exp at midpoints, their sum clamped at 1e-10",
            textbook=None if precision.compiled else Errors(nearest({**plain, "conditional": plain["mean"]})[0]),
            seconds=seconds,
        )


def _packed(rays: list[Ray], precision: Precision) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Density, starts, ends and offsets."""
    density, starts, ends = (
        precision.tensor([x for values in column for x in values])
        for column in ([r.density for r in rays], [r.starts for r in rays], [r.ends for r in rays])
    )
    return density, starts, ends, _offsets([len(ray.density) for ray in rays], precision)


def _offsets(counts: list[int], precision: Precision) -> Tensor:
    return torch.tensor([0, *itertools.accumulate(counts)], device=precision.device)


def _depth_bound(ray: Ray, answer: dict[str, float], precision: Precision, *, wide: bool) -> float:
    if precision.compiled:
        return 16 * precision.unit
    lengths = tuple(end - start for start, end in zip(ray.starts, ray.ends, strict=True))
    samples, depth = lit([Intervals(tuple(ray.density), lengths)], precision)
    bound = precision.unit * (16 + (samples + 2) * (1 + depth))
    if wide and answer["spread"] > 0:
        bound *= 1 + abs(answer["conditional"] - answer["anchor"]) / answer["spread"]
    return bound


def _columns(seen: LightEnds) -> dict[str, Tensor]:
    named = {"opacity": seen.opacity, "transmittance": seen.transmittance, "spread": seen.spread}
    named |= {"conditional": seen.mean, "median": seen.quantiles[:, 0]}
    return named | {f"quantile:{share:g}": seen.quantiles[:, i] for i, share in enumerate(exact.SHARES) if i}


def _single(ray: Ray) -> Ray:
    """The ray with the numbers that float32 holds."""
    columns = (torch.tensor(v, dtype=torch.float32).tolist() for v in (ray.density, ray.starts, ray.ends))
    return Ray(ray.name, *columns)


# Pixels of two rays each: what hits something and what does not, near and far, thin and opaque.
_PIXELS: tuple[tuple[Ray, Ray], ...] = (
    (even("wall", [2.0**20], 1.0, 0.5), even("wall", [2.0**20], 3.0, 0.5)),
    (even("fog", [0.125] * 8, 1.0, 0.125), Ray("nothing", [], [], [])),
    (even("shell", [2.0**27], 3.0, 2.0**-13), even("thin fog", [0.25] * 256, 1.0, 0.015625)),
    (even("far fog", [0.015625] * 100, 200.0, 1.0), even("far wall", [2.0**10], 250.0, 1.0)),
    (even("thick", [64.0, 0.0, 64.0], 0.25, 0.25), even("empty", [0.0] * 3, 0.25, 0.25)),
)
_PIXEL_SHARES = (0.04, 0.25, 0.75)


def _mixture_row(precision: Precision) -> Row:
    """Quantiles of the light of two rays together; no share lies where the light of one has ended and none begins."""
    rays = [_single(ray) for pixel in _PIXELS for ray in pixel]
    density, starts, ends, offsets = _packed(rays, precision)
    module = kernels if precision.compiled else depth_reference
    got, means, wanted = [], [], []
    start = time.perf_counter()
    for share in _PIXEL_SHARES:
        pixels = {"offsets": offsets, "rays_per_pixel": 2, "share": share}
        got.append(module.mixture_quantile(density, starts, ends, **pixels))
    seconds = time.perf_counter() - start
    for share in _PIXEL_SHARES:
        alone = module.light_ends(density, starts, ends, offsets=offsets, shares=(share,)).quantiles
        means.append(alone.view(-1, 2).mean(1))
        wanted += [exact.mixture_quantile(rays[i : i + 2], share) for i in range(0, len(rays), 2)]
    return Row(
        hard_cases=(6,),
        case="quantiles of several rays of a pixel, of which some hit nothing",
        operation="mixture_quantile",
        precision=precision.name,
        errors=Errors(largest_error(torch.cat(got), wanted, tiny=precision.tiny)),
        bounds=Errors(4 * precision.unit + 2.0**-depth_reference.BISECTIONS * _farthest(rays, wanted)),
        reason="4 u, and the last bracket of the bisection over the smallest answer",
        formula="mean of the rays' quantiles",
        textbook=None if precision.compiled else Errors(largest_error(torch.cat(means), wanted, tiny=precision.tiny)),
        seconds=seconds,
    )


def _farthest(rays: list[Ray], wanted: list[float]) -> float:
    """The largest share of a pixel's farthest distance by its answer."""
    ends = [max((*a.ends, *b.ends)) for a, b in zip(rays[::2], rays[1::2], strict=True)]
    return max(ends[i % len(ends)] / place for i, place in enumerate(wanted) if not math.isnan(place))


def _thick_and_thin(precision: Precision) -> list[Intervals]:
    """Fog in as many intervals as the precision can add up, and a wall between thin fogs."""
    counts = (1, 16) if precision.dtype == torch.bfloat16 else (1, 16, 1024, 4096)
    walls = [Intervals((2.0**-10, 2.0**27, 1.0), (1.0,) * 3), Intervals((2.0**-30, 2.0**-30, 2.0**40), (1.0, 0.0, 1.0))]
    return [fog(x, n) for x in (1e-12, 1e-3, 1.0, 1e6) for n in counts] + [*walls, Intervals((), ())]


def _flat(rays: list[Intervals], precision: Precision) -> tuple[Tensor, Tensor, Tensor]:
    """Density, lengths and offsets."""
    density = precision.tensor([x for ray in rays for x in ray.density])
    lengths = precision.tensor([x for ray in rays for x in ray.lengths])
    return density, lengths, _offsets([len(ray.density) for ray in rays], precision)


def _before_row(precision: Precision) -> Row:
    rays = _thick_and_thin(precision)
    wanted = [x for ray in rays for x in exact.optical_depths(ray)[:-1]]
    density, lengths, offsets = _flat(rays, precision)
    module = kernels if precision.compiled else reference
    start = time.perf_counter()
    got = module.optical_depth_before(density, lengths, offsets)
    seconds = time.perf_counter() - start
    plain = textbook.optical_depth_before(density, lengths, offsets=offsets)
    return Row(
        hard_cases=(3, 4),
        case="optical depth in front of an interval that is 1e11 times as thick, 1 to 4096",
        operation="optical_depth_before",
        precision=precision.name,
        errors=Errors(largest_error(got, wanted, tiny=precision.tiny)),
        bounds=Errors(precision.unit * (2 if precision.compiled else max(len(ray.density) for ray in rays) + 1)),
        reason="(n + 1) u: sums of n terms that are all positive; compiled 2 u: sums in float64",
        formula="cumulative sum less the own part",
        textbook=None if precision.compiled else Errors(largest_error(plain, wanted, tiny=precision.tiny)),
        seconds=seconds,
    )


def _integral_row(precision: Precision) -> Row:
    """What a transmission picture measures; the same code runs with and without the compiled kernels."""
    rays = _thick_and_thin(precision)
    wanted = [exact.optical_depths(ray)[-1] for ray in rays]
    attenuation, lengths, offsets = _flat(rays, precision)
    start = time.perf_counter()
    got = line_integral(attenuation, lengths, offsets)
    seconds = time.perf_counter() - start
    plain = textbook.line_integral(attenuation, lengths, offsets=offsets)
    return Row(
        hard_cases=(2, 3),
        case="line integral of what lets all or nothing pass, 0 to 4096 intervals",
        operation="line_integral",
        precision=precision.name,
        errors=Errors(largest_error(got, wanted, tiny=precision.tiny)),
        bounds=Errors(precision.unit * (max(len(ray.density) for ray in rays) + 1)),
        reason="(n + 1) u: sums of n terms that are all positive",
        formula="-log of the product of what each interval lets pass",
        textbook=Errors(largest_error(plain, wanted, tiny=precision.tiny)),
        seconds=seconds,
    )
