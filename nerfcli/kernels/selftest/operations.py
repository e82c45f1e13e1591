"""The operations on hard cases: inputs, answers, errors and bounds.

The answers come from the definitions in float64, on exactly the numbers of the tested precision. The tests run the same
operations on the same inputs, also on random ones, and compare the definitions with answers of 60 digits.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import ModuleType

import torch
from torch import Tensor

from nerfcli.kernels import AdamStep, HashGrid, March, PixelTable, Rays, reference
from nerfcli.kernels.activations import density_from_log
from nerfcli.kernels.selftest import cases
from nerfcli.kernels.selftest.cases import MEANINGLESS, Ray, Segments, deepest_ray
from nerfcli.kernels.selftest.measure import Errors, Precision, largest_error

BACKGROUND = COLOUR_GRADIENT = (1.0, 0.5, 0.25)
TRANSMITTANCE_GRADIENT = 0.5
QUANTILES = {"median": 0.5, "0.05": 0.05, "0.95": 0.95}
RATE, BETAS, EPS = 0.01, (0.9, 0.99), 1e-15
# From this pixel number on, float32 cannot distinguish neighbouring numbers.
MANY = 2**24

Inputs = dict[str, Tensor]


@dataclass(frozen=True)
class Outcome:
    """Result of an operation, by names.

    Args:
        values, gradients: outputs of the operation, and gradients of a weighted sum of them, if any.
        sizes: magnitudes that errors of some of the gradients are relative to; those of others, to their own.
        value_sizes: the same for values.
    """

    values: Inputs
    gradients: Inputs = field(default_factory=dict)
    sizes: Inputs = field(default_factory=dict)
    value_sizes: Inputs = field(default_factory=dict)


def exact(given: Tensor) -> Tensor:
    """Return a tensor on the CPU, in float64 if it is floating-point."""
    return given.detach().cpu().double() if given.is_floating_point() else given.cpu()


def errors(got: Outcome, wanted: Outcome, *, tiny: float) -> Errors:
    """Measure the largest errors of the values and the gradients."""
    value = _largest(got.values, wanted.values, wanted.value_sizes, tiny=tiny)
    if not got.gradients:
        return Errors(value)
    return Errors(value, _largest(got.gradients, wanted.gradients, wanted.sizes, tiny=tiny))


def _largest(got: Inputs, wanted: Inputs, sizes: Inputs, *, tiny: float) -> float:
    return max(largest_error(got[name], wanted[name], tiny=tiny, scale=sizes.get(name)) for name in got)


def both(roundings: float, precision: Precision) -> Errors:
    """Bound values and gradients by a number of roundings."""
    return Errors(roundings * precision.unit, roundings * precision.unit)


def gradients_of(function: Callable[[Tensor], Tensor], given: Tensor) -> Outcome:
    """Evaluate a function of numbers or points, and its gradient, of points relative to the largest component."""
    given = given.detach().requires_grad_()
    values = function(given)
    weights = torch.tensor(COLOUR_GRADIENT if given.ndim == 2 else 1.0).to(values)
    (gradient,) = torch.autograd.grad((values * weights).sum(), given)
    size = gradient.abs().amax(-1, keepdim=True).expand_as(gradient) if given.ndim == 2 else gradient
    return Outcome({"values": values.detach()}, {"gradient": gradient}, {"gradient": size})


def _offsets(counts: Sequence[int], precision: Precision) -> Tensor:
    return torch.tensor([0, *itertools.accumulate(counts)], device=precision.device)


def intervals(rays: Sequence[Segments], precision: Precision) -> Inputs:
    """Pack the densities and lengths of rays."""
    return {
        "density": precision.tensor([x for ray in rays for x in ray.density]),
        "lengths": precision.tensor([x for ray in rays for x in ray.lengths]),
        "offsets": _offsets([len(ray.density) for ray in rays], precision),
    }


def light_inputs(rays: Sequence[Segments], precision: Precision) -> Inputs:
    """Pack rays with colours and the gradients of the loss by each output."""
    if precision.dtype == torch.bfloat16:  # a sum of more than 16 terms has no digits left
        rays = [ray for ray in rays if len(ray.density) <= 16]
    numbers = [k for ray in rays for k in range(len(ray.density))]
    return {
        **intervals(rays, precision),
        "rgb": precision.tensor([[(k % 5 + 1) / 8, (k % 3 + 1) / 4, (k % 7 + 1) / 8] for k in numbers]).reshape(-1, 3),
        "background": precision.tensor([BACKGROUND] * len(rays)),
        "weights_gradient": precision.tensor([(k % 3 - 1) / 2 for k in numbers]),
        "colour_gradient": precision.tensor(COLOUR_GRADIENT),
    }


def light_bound(rays: Sequence[Segments], precision: Precision) -> Errors:
    """Bound the errors of colours and weights of rays."""
    if precision.compiled:
        return Errors(8 * precision.unit, 16 * precision.unit)
    if precision.dtype == torch.bfloat16:
        rays = [ray for ray in rays if len(ray.density) <= 16]
    if not rays:
        return Errors(math.inf)
    samples, depth = deepest_ray(list(rays), precision)
    bound = precision.unit * (8 + (samples + 2) * (1 + depth))
    return Errors(bound, 2 * bound)


def composite(module: ModuleType, given: Inputs) -> Outcome:
    """Composite rays; errors of the gradient by density are relative to the magnitudes of its terms."""
    density, rgb = given["density"].detach().requires_grad_(), given["rgb"].detach().requires_grad_()
    colour, transmittance, weights = module.composite(
        density, rgb, given["lengths"], offsets=given["offsets"], background=given["background"]
    )
    values = {"colour": colour.detach(), "transmittance": transmittance.detach(), "weights": weights.detach()}
    loss = (colour * given["colour_gradient"]).sum() + TRANSMITTANCE_GRADIENT * transmittance.sum()
    gradients = torch.autograd.grad(loss + (given["weights_gradient"] * weights).sum(), (density, rgb))
    counts = given["offsets"].diff().tolist()
    gains = ((rgb * given["colour_gradient"]).sum(1) + given["weights_gradient"]).detach()
    behind = (given["background"] @ given["colour_gradient"] + TRANSMITTANCE_GRADIENT) * transmittance.detach()
    sizes = []
    columns = (
        x.split(counts) for x in (density.detach() * given["lengths"], given["lengths"], gains, weights.detach())
    )
    for (own, lengths, value, weight), last in zip(zip(*columns, strict=True), behind, strict=True):
        seen = (weight * value).abs()
        sizes.append(lengths * ((-own.cumsum(0)).exp() * value.abs() + seen.flip(0).cumsum(0).flip(0) - seen + last))
    return Outcome(
        values,
        dict(zip(("by density", "by rgb"), gradients, strict=True)),
        {"by density": torch.cat(sizes) if sizes else density},
    )


def before(module: ModuleType, given: Inputs) -> Outcome:
    """Compute the optical depths in front of intervals."""
    return Outcome(
        {"before": module.optical_depth_before(given["density"], given["lengths"], offsets=given["offsets"])}
    )


def distortion(module: ModuleType, given: Inputs) -> Outcome:
    """Compute the distortion of one ray."""
    weights = given["weights"].detach().requires_grad_()
    offsets = torch.tensor([0, len(weights)], device=weights.device)
    value = module.distortion(weights, given["starts"], given["ends"], offsets)
    (gradient,) = torch.autograd.grad(value.sum(), weights)
    return Outcome({"distortion": value.detach().reshape(1)}, {"by weights": gradient})


def optical_depth(ray: Ray) -> float:
    """Return the optical depth of a ray."""
    return sum(sigma * (end - start) for sigma, start, end in zip(ray.density, ray.starts, ray.ends, strict=True))


def depth_inputs(rays: Sequence[Ray], precision: Precision) -> Inputs:
    """Pack rays for depths, and mark as settled the quantiles that rounding does not move far."""
    columns = ([r.density for r in rays], [r.starts for r in rays], [r.ends for r in rays])
    density, starts, ends = (precision.tensor([x for values in column for x in values]) for column in columns)
    offsets = _offsets([len(ray.density) for ray in rays], precision)
    off = min(0.5, depth_bound(rays, 1, precision).value)
    near = [1 - (1 - fraction) ** (1 + x) for x in (-off, off) for fraction in QUANTILES.values()]
    spans = map(exact, (density, starts, ends))
    low, high = reference.ray_termination(*spans, offsets=offsets.cpu(), fractions=tuple(near)).quantiles.split(
        3, dim=1
    )
    settled = (low.isnan() & high.isnan()) | ((high - low).abs() <= 8 * off * low)
    return {"density": density, "starts": starts, "ends": ends, "offsets": offsets, "settled": settled}


def meaningful(rays: Sequence[Ray], precision: Precision) -> list[Ray]:
    """Choose the rays whose depths have correct digits in a precision."""
    return [ray for ray in rays if depth_bound([ray], 1, precision).value <= MEANINGLESS]


def depth_bound(rays: Sequence[Ray], factor: float, precision: Precision) -> Errors:
    """Bound the errors of the depths of rays."""
    if precision.compiled:
        return Errors(16 * factor * precision.unit)
    lengths = (tuple(end - start for start, end in zip(ray.starts, ray.ends, strict=True)) for ray in rays)
    intervals = [Segments(tuple(ray.density), length) for ray, length in zip(rays, lengths, strict=True)]
    samples, depth = deepest_ray(intervals, precision)
    return Errors(factor * precision.unit * (16 + (samples + 2) * (1 + depth)))


def depths(module: ModuleType, given: Inputs) -> Inputs:
    """Compute all depths of rays."""
    spans, offsets = (given["density"], given["starts"], given["ends"]), given["offsets"]
    seen = module.ray_termination(*spans, offsets=offsets, fractions=tuple(QUANTILES.values()))
    named = {"opacity": seen.opacity, "transmittance": seen.transmittance, "spread": seen.spread}
    named |= {"conditional": seen.mean, "max-weight": seen.peak}
    named |= dict(zip(QUANTILES, seen.quantiles.unbind(1), strict=True))
    if "settled" in given:
        settled = dict(zip(QUANTILES, given["settled"].to(offsets.device).unbind(1), strict=True))
        named |= {name: torch.where(settled[name], named[name], 0.0) for name in QUANTILES}
    return named


def ray_termination(columns: tuple[str, ...], module: ModuleType, given: Inputs) -> Outcome:
    """Compute the depths of rays that `columns` names."""
    every = depths(module, given)
    return Outcome({name: every[name] for name in columns})


def grid_inputs(points: Sequence[cases.Point], grids: tuple[int, ...], rounded: int, precision: Precision) -> Inputs:
    """Return points, a table of features, cells per axis of its levels, and whether scaled places are rounded there."""
    places = torch.tensor(points).tolist()  # the numbers that float32 holds
    return {
        "points": precision.tensor(places),
        "table": precision.tensor(cases.hash_table(len(grids))),
        "gains": precision.tensor(cases.GAINS),
        "grids": torch.tensor(grids),
        "rounded": rounded * torch.tensor(grids),
    }


def encode(module: ModuleType, given: Inputs) -> Outcome:
    """Interpolate features between the vertices of hash grids."""
    points, table, grids = given["points"], given["table"].detach().requires_grad_(), given["grids"].tolist()
    encoded = module.hash_encode(points, table, tuple(grids)).view(len(points), len(grids), -1)
    (gradient,) = torch.autograd.grad((encoded * given["gains"]).sum(), table)
    blur = 1.0 + given["rounded"].double()
    sizes = blur[:, None] * given["table"].abs().amax((1, 2)).cpu()[:, None].double()
    largest = (blur[:, None, None] * gradient.abs().amax(1, keepdim=True).cpu().double()).expand_as(gradient)
    return Outcome(
        {"encoded": encoded.detach()},
        {"by table": gradient},
        {"by table": largest},
        {"encoded": sizes.expand_as(encoded)},
    )


def pixel_inputs(precision: Precision) -> Inputs:
    """Return first, last and only pixels of photos of 16 megapixels, of one pixel, and of six pixels."""
    photos = torch.zeros(MANY + 7, 3, dtype=torch.uint8)
    photos[MANY:] = torch.arange(1, 22, dtype=torch.uint8).reshape(7, 3) * 12
    return {
        "chosen": torch.tensor([0, 7, MANY, MANY + 1, MANY + 3, MANY + 6], device=precision.device),
        "first_pixel": torch.tensor([0, MANY, MANY + 1], device=precision.device),
        "first_bearing": torch.tensor([0, 8, 9], device=precision.device),
        "bearings": precision.tensor([[math.sin(k), math.cos(k) / 2, 1.0] for k in range(15)]),
        "poses": precision.tensor(
            [[[math.cos(9 * p + 5 * i + j) for j in range(4)] for i in range(4)] for p in range(3)]
        ),
        "photos": photos.to(precision.device),
    }


def pixel_rays(module: ModuleType, given: Inputs) -> Outcome:
    """Compute the rays and colours of chosen pixels."""
    table = PixelTable(given["first_pixel"], given["first_bearing"], given["bearings"], given["poses"], given["photos"])
    origins, directions, colours = module.pixel_rays(given["chosen"], table)
    values = {"origins": origins, "directions": directions, "colours": colours}
    return Outcome(values, value_sizes={"directions": torch.ones_like(directions)})


def density(module: ModuleType, given: Inputs) -> Outcome:
    """Compute densities from logarithms; compiled, by networks with one path for each sign of the number."""
    logarithms = given["logarithms"]
    if module is reference:
        return gradients_of(density_from_log, logarithms)
    weights = _layers(logarithms)
    weights[0][0, 0], weights[0][1, 0], weights[1][0, 0], weights[1][0, 1] = 1.0, -1.0, 1.0, -1.0
    rays, harmonics = torch.zeros(len(logarithms), dtype=torch.int64), logarithms.new_zeros(1, 16)

    def through_networks(numbers: Tensor) -> Tensor:
        return module.radiance(torch.nn.functional.pad(numbers[:, None], (0, 31)), harmonics, rays, weights)[0]

    return gradients_of(through_networks, logarithms)


def _layers(like: Tensor) -> tuple[Tensor, ...]:
    return tuple(like.new_zeros(shape) for shape in ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32)))


def adam(module: ModuleType, given: Inputs) -> Outcome:
    """Compute Adam's first step."""
    table, first, second = (torch.zeros_like(given["gradients"]) for _ in range(3))
    module.adam_rows(table, given["gradients"].clone(), first, second, step=AdamStep(1, RATE, BETAS, EPS))
    return Outcome({"table": table})


def contract_inputs(radii: Sequence[float], precision: Precision) -> Inputs:
    """Return points at some radii in a few directions."""
    points = [tuple(r * x for x in d) for r in radii for d in cases.DIRECTIONS]
    return {"points": precision.tensor(points)}


def march_inputs(full: bool, precision: Precision) -> Inputs:
    """Return rays along axes through a cube of side 2, some in the plane of a face or of cell borders."""
    make = torch.ones if full else torch.zeros
    return {
        "origins": precision.tensor(
            [[-2.0, 0.25, 0.125], [0.25, 2.0, 0.0], [0.5, -0.5, -3.0], [-2.0, -1.0, 1.0], [0.0, 0.0, 0.0]]
        ),
        "directions": precision.tensor(
            [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
        ),
        "edges": precision.tensor([k * 2.0**-7 for k in range(5 * 2**7)]),
        "occupied": make(16, 16, 16, dtype=torch.bool, device=precision.device),
    }


def chords(module: ModuleType, given: Inputs) -> Outcome:
    """Compute the length of each ray that is kept, in a cube whose network has all weights 0."""
    origins = given["origins"]
    rays = Rays(origins, given["directions"], origins.new_zeros(len(origins)))
    march = March(given["edges"], given["occupied"], "none", 1e9)
    samples = module.visible_samples(rays, march, HashGrid(origins.new_zeros(8, 16, 4), (2,) * 8, _layers(origins)))
    return Outcome({"chords": reference.sum_along_rays(samples.ends - samples.starts, samples.offsets)})


def volume_inputs(thickness: float, precision: Precision) -> Inputs:
    """Return a volume, lines in float64, and the gradients of the loss by each line integral."""
    lines = torch.tensor(cases.LINES, dtype=torch.float64, device=precision.device)
    return {
        "volume": precision.tensor(cases.attenuations(thickness)),
        "origins": lines[:, 0].contiguous(),
        "directions": lines[:, 1].contiguous(),
        "gains": precision.tensor([(k % 4 + 1) / 4 for k in range(len(lines))]),
    }


def project(module: ModuleType, given: Inputs) -> Outcome:
    """Compute line integrals and their transpose."""
    lines, grid = (given["origins"], given["directions"]), {"first": cases.VOLUME_FIRST, "size": cases.VOXEL}
    integrals = module.project(given["volume"], *lines, **grid)
    back = module.back_project(given["gains"], *lines, shape=cases.VOLUME_SHAPE, **grid)
    sizes = {"transpose": back.abs().max().expand_as(back)}
    return Outcome({"integrals": integrals, "transpose": back}, value_sizes=sizes)
