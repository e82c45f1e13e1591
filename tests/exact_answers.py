"""Answers to the cases of the selftest in 60 decimal digits, exact fractions or closed form, by the definitions alone.

Each function of `ANSWERS` takes the inputs of an operation, and gives its exact answer from exactly these numbers.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from decimal import Decimal, localcontext
from fractions import Fraction
from functools import cache

import torch
from torch import Tensor

from nerfcli.kernels.activations import LOG_DENSITY_LIMIT
from nerfcli.kernels.selftest.operations import COLOUR_GRADIENT, EPS, RATE, TRANSMITTANCE_GRADIENT, Inputs, Outcome

DIGITS = 60
Numbers = tuple[float, ...]


def numbers(tensor: Tensor) -> list:
    return tensor.detach().cpu().double().tolist()


def tensor(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def rays(given: Inputs, *names: str) -> Iterator[tuple[Tensor, ...]]:
    """Yield what belongs to each ray."""
    return zip(*(given[name].detach().cpu().split(given["offsets"].diff().tolist()) for name in names), strict=True)


@cache
def composited(density: Numbers, lengths: Numbers, rgb: tuple[Numbers, ...], by_weight: Numbers, behind: Numbers):
    """Return weights, transmittance, colour, and the gradient of a ray by density with the size of its terms.

    loss = sum_c gc_c colour_c + gt T + sum_i gw_i w_i, with the gradient
    d loss / d density_k = length_k (T_(k+1) v_k - sum_(i>k) w_i v_i - T (gc . background + gt)),
    v_i = gc . rgb_i + gw_i. The rounding error of the gradient is proportional to the same sum of absolute values.
    """
    with localcontext() as context:
        context.prec = DIGITS
        passing, weights, after = Decimal(1), [], []
        for sigma, length in zip(density, lengths, strict=True):
            through = (-Decimal(sigma) * Decimal(length)).exp()
            weights.append(passing * (1 - through))
            passing *= through
            after.append(passing)
        columns = list(zip(*rgb, strict=True)) or [()] * len(behind)
        colour = [
            sum((w * Decimal(c) for w, c in zip(weights, column, strict=True)), passing * Decimal(b))
            for column, b in zip(columns, behind, strict=True)
        ]
        gains = [Decimal(g) for g in COLOUR_GRADIENT]
        values = [
            sum((g * Decimal(c) for g, c in zip(gains, pixel, strict=True)), Decimal(own))
            for pixel, own in zip(rgb, by_weight, strict=True)
        ]
        last = sum((g * Decimal(b) for g, b in zip(gains, behind, strict=True)), Decimal(TRANSMITTANCE_GRADIENT))
        rest, size, gradient, sizes = passing * last, passing * abs(last), [], []
        for k in range(len(weights) - 1, -1, -1):
            length = Decimal(lengths[k])
            gradient.append(float(length * (after[k] * values[k] - rest)))
            sizes.append(float(length * (abs(after[k] * values[k]) + size)))
            rest += weights[k] * values[k]
            size += abs(weights[k] * values[k])
        return [float(w) for w in weights], float(passing), [float(c) for c in colour], gradient[::-1], sizes[::-1]


def composite(given: Inputs) -> Outcome:
    """Composite rays in 60 digits."""
    found: list[list] = [[], [], [], [], []]
    by_ray = zip(
        rays(given, "density", "lengths", "rgb", "weights_gradient"), numbers(given["background"]), strict=True
    )
    for (density, lengths, rgb, by_weight), behind in by_ray:
        of_ray = (numbers(density), numbers(lengths), map(tuple, numbers(rgb)), numbers(by_weight), behind)
        weights, transmittance, colour, gradient, size = composited(*(tuple(part) for part in of_ray))
        for into, value in zip(found, (weights, [transmittance], [colour], gradient, size), strict=True):
            into += value
    weights, transmittance, colour, gradient, sizes = map(tensor, found)
    return Outcome(
        {"colour": colour, "transmittance": transmittance, "weights": weights},
        {"by density": gradient, "by rgb": weights[:, None] * tensor(COLOUR_GRADIENT)},
        # A gradient is a length times what may be below the smallest number.
        {
            "by density": sizes.clamp_min(
                torch.finfo(given["density"].dtype).tiny * max([1.0, *numbers(given["lengths"])])
            )
        },
    )


def optical_depth_before(given: Inputs) -> Outcome:
    """Add optical depths in 60 digits."""
    depths: list[float] = []
    with localcontext() as context:
        context.prec = DIGITS
        for density, lengths in rays(given, "density", "lengths"):
            own = [Decimal(d) * Decimal(n) for d, n in zip(numbers(density), numbers(lengths), strict=True)]
            depths += map(float, itertools.accumulate(own[:-1], initial=Decimal(0)) if own else ())
    return Outcome({"before": tensor(depths)})


def distortion(given: Inputs) -> Outcome:
    """Return sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 length_i / 3 of one ray, and its gradient by the weights."""
    with localcontext() as context:
        context.prec = DIGITS
        w, starts, ends = (list(map(Decimal, numbers(given[name]))) for name in ("weights", "starts", "ends"))
        middles = [(a + b) / 2 for a, b in zip(starts, ends, strict=True)]
        lengths = [b - a for a, b in zip(starts, ends, strict=True)]
        apart = [sum((wj * abs(m - mj) for wj, mj in zip(w, middles, strict=True)), Decimal(0)) for m in middles]
        value = sum((wi * (a + wi * n / 3) for wi, a, n in zip(w, apart, lengths, strict=True)), Decimal(0))
        gradient = [float(2 * (a + wi * n / 3)) for wi, a, n in zip(w, apart, lengths, strict=True)]
    return Outcome({"distortion": tensor([float(value)])}, {"by weights": tensor(gradient)})


def corners(point: Numbers, resolution: int, rows: int) -> Iterator[tuple[int, Fraction]]:
    """Yield the table row and the weight of each of the eight vertices around a point."""
    scaled = [min(max(Fraction(x), Fraction(0)), Fraction(1)) * resolution for x in point]
    cell = [min(math.floor(x), resolution - 1) for x in scaled]
    side = resolution + 1
    for corner in itertools.product((0, 1), repeat=3):
        x, y, z = (c + d for c, d in zip(cell, corner, strict=True))
        hashed = (x ^ y * 2654435761 ^ z * 805459861) % 2**32 % rows
        fractions = [s - c if d else 1 - (s - c) for s, c, d in zip(scaled, cell, corner, strict=True)]
        yield (z * side + y) * side + x if side**3 <= rows else hashed, math.prod(fractions, start=Fraction(1))


def hash_encode(given: Inputs) -> Outcome:
    """Interpolate in exact fractions; sizes are sums of absolute values, and of what rounding places may add."""
    points, table, gains = (numbers(given[name]) for name in ("points", "table", "gains"))
    rows, features = len(table[0]), len(gains)
    encoded = torch.zeros(len(points), len(table), features, dtype=torch.float64)
    sums = [[[Fraction(0), Fraction(0)] for _ in range(rows)] for _ in table]
    sizes = torch.zeros_like(encoded)
    for (i, point), (level, resolution) in itertools.product(enumerate(points), enumerate(given["grids"].tolist())):
        found, blur = list(corners(point, resolution, rows)), int(given["rounded"][level])
        for j in range(features):
            terms = [weight * Fraction(table[level][row][j]) for row, weight in found]
            encoded[i, level, j] = float(sum(terms))
            sizes[i, level, j] = float(sum(map(abs, terms))) + blur * max(abs(x) for row in table[level] for x in row)
        for row, weight in found:
            sums[level][row][0] += weight
            sums[level][row][1] += weight + blur
    by_table, size = tensor([[[float(x) for x in row] for row in level] for level in sums])[..., None].unbind(2)
    upstream = tensor(gains)
    return Outcome(
        {"encoded": encoded}, {"by table": by_table * upstream}, {"by table": size * upstream.abs()}, {"encoded": sizes}
    )


def pixel_rays(given: Inputs) -> Outcome:
    """Find each pixel by its number, and turn its bearing in exact fractions."""
    first, poses, bearings = given["first_pixel"].tolist(), numbers(given["poses"]), numbers(given["bearings"])
    origins, directions, sizes = [], [], []
    for number in given["chosen"].tolist():
        photo = max(p for p, start in enumerate(first) if start <= number)
        bearing = bearings[int(given["first_bearing"][photo]) + number - first[photo]]
        terms = [[Fraction(a) * Fraction(b) for a, b in zip(row[:3], bearing, strict=True)] for row in poses[photo][:3]]
        origins.append([row[3] for row in poses[photo][:3]])
        directions.append([float(sum(row)) for row in terms])
        sizes.append([float(sum(map(abs, row))) for row in terms])
    colours = given["photos"][given["chosen"]].double() / 255
    values = {"origins": tensor(origins), "directions": tensor(directions), "colours": colours}
    return Outcome(values, value_sizes={"directions": tensor(sizes)})


def density_from_log(given: Inputs) -> Outcome:
    """Return exp of the limited logarithm, which is also its gradient."""
    limited = (min(max(x, -LOG_DENSITY_LIMIT), LOG_DENSITY_LIMIT) for x in numbers(given["logarithms"]))
    density = tensor([math.exp(x) for x in limited])
    return Outcome({"values": density}, {"gradient": density})


def adam_rows(given: Inputs) -> Outcome:
    """Return the first step: m / (1 - b1) = g and sqrt(v / (1 - b2)) = |g|, so that it is rate g / (|g| + eps)."""
    return Outcome(
        {"table": tensor([[-RATE * g / (abs(g) + EPS) for g in row] for row in numbers(given["gradients"])])}
    )


def contract(given: Inputs) -> Outcome:
    """Return the contracted point, the gradient of its product with COLOUR_GRADIENT, and the size of its terms."""
    points, gradients, sizes = [], [], []
    for point in numbers(given["points"]):
        norm = math.hypot(*point)
        if norm <= 1.0:
            points.append(point)
            gradients.append(list(COLOUR_GRADIENT))
            sizes.append([1.0] * 3)
            continue
        unit = [x / norm for x in point]
        along = math.fsum(x * g for x, g in zip(unit, COLOUR_GRADIENT, strict=True))
        size = math.fsum(abs(x * g) for x, g in zip(unit, COLOUR_GRADIENT, strict=True))
        first, bend = (2 - 1 / norm) / norm, (-2 + 2 / norm) / norm  # d contracted = first dx + bend u (u . dx)
        points.append([(2 - 1 / norm) * x for x in unit])
        gradients.append([first * g + bend * along * x for x, g in zip(unit, COLOUR_GRADIENT, strict=True)])
        sizes.append([first * abs(g) + abs(bend) * size for g in COLOUR_GRADIENT])
    return Outcome({"values": tensor(points)}, {"gradient": tensor(gradients)}, {"gradient": tensor(sizes)})


def visible_samples(given: Inputs) -> Outcome:
    """Return chords of a cube of side 2; the last ray starts in its middle."""
    return Outcome({"chords": tensor([2.0, 2.0, 2.0, 2.0, 1.0]) * bool(given["occupied"].all())})


ANSWERS: dict[str, Callable[[Inputs], Outcome]] = {
    "composite": composite,
    "optical_depth_before": optical_depth_before,
    "distortion": distortion,
    "hash_encode": hash_encode,
    "pixel_rays": pixel_rays,
    "density_from_log": density_from_log,
    "adam_rows": adam_rows,
    "contract": contract,
    "visible_samples": visible_samples,
}
