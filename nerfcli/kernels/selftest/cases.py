"""Hard cases as data, for `nerfcli selftest` and for the tests.

Rays are hard for rounding: thin and opaque, empty and dense, short and very long. Points are on borders and far away.

Densities and interval lengths of `groups` are exact in bfloat16, so that every precision gets the same rays and errors
come from the arithmetic alone.
"""

import math
from dataclasses import dataclass

import torch

from nerfcli.kernels.selftest.measure import Precision

# The largest bfloat16 number, which is also exact in float32.
LARGEST = 3.3895313892515355e38
# Cases with a bound above this are meaningless: bfloat16 has no digit of exp(-tau) for tau above 100.
MEANINGLESS = 0.25


@dataclass(frozen=True)
class Ray:
    """Densities, and the distances at which the intervals start and end."""

    name: str
    density: list[float]
    starts: list[float]
    ends: list[float]


@dataclass(frozen=True)
class Segments:
    """Densities and lengths of the intervals of one ray."""

    density: tuple[float, ...]
    lengths: tuple[float, ...]


def coarse(value: float) -> float:
    """Round to the nearest bfloat16 number."""
    return torch.tensor(value, dtype=torch.float64).to(torch.bfloat16).item()


def fog(optical_depth: float, samples: int) -> Segments:
    """Return intervals of about the same optical depth, with varying densities and lengths."""
    densities = [coarse(optical_depth * 64 * (3 + k) / 4) for k in range(5)]
    return Segments(tuple(densities[k % 5] for k in range(samples)), tuple(2.0 ** -(6 + k % 3) for k in range(samples)))


def groups() -> dict[str, tuple[Segments, ...]]:
    """Return the rays for weights, colours and their gradients, by what makes them hard."""
    counts = (1, 2, 64, 1024, 4096)
    return {
        **{
            f"optical depth {x:g} per interval, 1 to 4096": tuple(fog(x, n) for n in counts)
            for x in (1e-12, 1e-9, 1e-6, 1e-3, 0.1, 1.0, 30.0, 1e6)
        },
        "no intervals": (Segments((), ()), Segments((), ())),
        "zero weights: empty intervals": (Segments((0.0,) * 5, (0.5,) * 5), Segments((0.0,), (4.0,))),
        "duplicate edges: intervals of length 0": (
            Segments((1.0, 2.0, 4.0), (0.0, 0.5, 0.0)),
            Segments((LARGEST, 1.0, 0.0), (0.0, 0.25, 0.0)),
            Segments((1.0, 1.0), (0.0, 0.0)),
        ),
        "first interval opaque": (
            Segments((2.0**20, 1.0, 2.0), (1.0, 0.5, 0.5)),
            Segments((2.0**100, 0.0, 2.0**100), (1.0, 1.0, 1.0)),
        ),
        "thin fog, then an opaque interval": (
            Segments((2.0**-30,) * 64 + (2.0**20,), (2.0**-6,) * 65),
            Segments((2.0**-20,) * 64 + (16.0, 2.0**20, 4.0), (2.0**-6,) * 64 + (1.0, 1.0, 1.0)),
        ),
        "last interval very long, up to 1e38": (
            Segments((0.5, 2.0**-40), (1.0, 2.0**40)),
            Segments((0.5, 0.0), (1.0, 2.0**126)),
            Segments((0.5, 1.0), (1.0, 2.0**126)),
            Segments((0.5, 2.0**-126), (1.0, 2.0**126)),
        ),
        "densities at overflow, product beyond float32": (
            Segments((LARGEST,), (2.0**-6,)),
            Segments((1.0, LARGEST, 1.0), (0.5, 4.0, 0.5)),
            Segments((LARGEST, LARGEST, LARGEST), (4.0, 4.0, 4.0)),
            Segments((LARGEST, LARGEST), (0.0, 0.0)),
        ),
        "two surfaces, shells and slabs": (
            Segments((44.5, 0.0, 2.0**14), (2.0**-6, 4.0, 2.0**-6)),
            Segments((0.0, 2.0**13, 0.0), (2.0, 2.0**-13, 4.0)),
            Segments((0.5, 1.0, 2.0), (1.0, 1.0, 1.0)),
        ),
    }


def deepest_ray(rays: list[Segments], precision: Precision) -> tuple[int, float]:
    """Return the largest number of intervals on a ray that light reaches, and the largest optical depth it passes."""
    counts, depths, deepest = [0], [0.0], precision.deepest
    for ray in rays:
        depth, count = 0.0, 0
        for sigma, length in zip(ray.density, ray.lengths, strict=True):
            if depth > deepest:
                break
            depth, count = depth + sigma * length, count + 1
        counts.append(count)
        depths.append(min(depth, deepest))
    return max(counts), max(depths)


def even(name: str, density: list[float], near: float, length: float) -> Ray:
    """Return a ray of adjacent intervals of equal length."""
    edges = [near + length * i for i in range(len(density) + 1)]
    return Ray(name, density, edges[:-1], edges[1:])


def depth_rays() -> list[Ray]:
    """Return the rays for depths."""
    ln2 = math.log(2)
    optical_depths = (1e-12, 1e-6, 1e-3, 0.1, 1.0, 30.0, 1e6)
    return [
        even("three slabs (worked example)", [ln2, ln2, 2 * ln2], 0.0, 1.0),
        even("empty, cut in 4", [0.0] * 4, 1.0, 0.5),
        Ray("empty, not cut", [], [], []),
        *(even(f"one interval of optical depth {x:g}", [x / 0.25], 2.0, 0.25) for x in optical_depths),
        *(even(f"fog of optical depth {x:g} in 256", [x / 4] * 256, 1.0, 1 / 64) for x in optical_depths),
        *(even(f"thin shell 1e-4 at 3, density {x:g}", [x], 3.0, 1e-4) for x in (1.0, 1e4, 1e8)),
        Ray("two surfaces at 1 and 5, half each", [ln2 * 128, 1e4], [1.0, 5.0], [1.0078125, 5.0078125]),
        Ray("two surfaces in fog of 1e-9", [40.0, 1e-9, 1e5], [1.0, 1.015625, 5.0], [1.015625, 5.0, 5.25]),
        even("opaque first sample", [1e6, 1.0, 1.0], 0.5, 0.25),
        even("ever denser, 1e-9 to 1e5", [10.0**e for e in range(-9, 6)], 0.25, 0.125),
        even("far: fog of 1 from 200 to 300", [0.01] * 100, 200.0, 1.0),
    ]


def thick_and_thin(precision: Precision) -> list[Segments]:
    """Return fog in as many intervals as the precision can add up, and walls next to thin fog."""
    counts = (1, 16) if precision.dtype == torch.bfloat16 else (1, 16, 1024, 4096)
    walls = [Segments((2.0**-10, 2.0**27, 1.0), (1.0,) * 3), Segments((2.0**-30, 2.0**-30, 2.0**40), (1.0, 0.0, 1.0))]
    return [fog(x, n) for x in (1e-12, 1e-3, 1.0, 1e6) for n in counts] + [*walls, Segments((), ())]


# Weights of a far surface: all within 1e-3, from 0.984 of the way to infinity.
FAR_SURFACE = {
    "starts": [0.984375 + k * 2.0**-16 for k in range(64)],
    "ends": [0.984375 + (k + 1) * 2.0**-16 for k in range(64)],
    "weights": [(k % 7 + 1) / 256 for k in range(64)],
}

Point = tuple[float, float, float]
# Points on borders and corners of cells, and outside the cube; multiplied by a power of two, all are exact in float32.
BORDERS: tuple[Point, ...] = (
    *((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1.0, 0.0, 0.5), (-0.5, 2.0, 0.3125), (0.25, 0.5, 0.75)),
    *((1 - 2.0**-24, 2.0**-30, 2.0**-100), (0.5, 0.5 - 2.0**-12, 0.5 + 2.0**-12), (-(2.0**-100), 2.0**100, 0.0)),
)
BETWEEN: tuple[Point, ...] = tuple(((k * 0.37) % 1, (k * 0.61 + 0.2) % 1, (k * 0.83 + 0.4) % 1) for k in range(64))
# Cells per axis at each level of the hash grids.
EXACT_GRIDS, FINE_GRIDS = (4, 16, 64, 1024), (5, 41, 700, 2048)
ROWS, FEATURES = 512, 4
# Gradients of the loss by each feature; half precision rounds the last to 0.
GAINS = (1.0, 2.0**-6, -(2.0**-12), 2.0**-26)


def hash_table(levels: int) -> list[list[list[float]]]:
    """Return features of many magnitudes and either sign, down to 2^-14, all exact in half precision."""
    return [
        [
            [((7 * row + 3 * j) % 17 - 8) * 2.0 ** -(3 + (row + level) % 12) for j in range(FEATURES)]
            for row in range(ROWS)
        ]
        for level in range(levels)
    ]


# Directions with coordinates that every precision holds exactly; their length need not be 1.
DIRECTIONS = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.5, -0.75, 1.0), (-1.0, 0.25, 2.0**-10))
CONTRACTED = (
    ("contraction at its centre and its border", (0.0, 2.0**-100, 2.0**-10, 0.5, 1.0, 1.25, 2.0)),
    ("contraction far away, radius 1e3 to 1e37", (2.0**10, 2.0**33, 2.0**60, 2.0**66, 2.0**122)),
)
# Numbers exact in bfloat16, up to beyond where exp overflows in every precision.
LOGARITHMS = (-1000.0, -89.0, -15.0, -1.0, 2.0**-20, 1.0, 14.5, 15.0, 16.0, 89.0, 720.0, 3e38)
GRADIENTS = tuple(10.0**e for e in (-17, -15, -12, -8, -4, 0, 4, 10))

# Largest line integrals of a small volume: thin ones must keep all their digits, thick ones must not overflow.
THICKNESSES = (1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e6)
VOLUME_SHAPE, VOLUME_FIRST, VOXEL = (6, 7, 9), (-2.0, -1.5, -1.25), 0.5
# Points on lines and directions: along axes, through voxel centres and between them, oblique, past the volume, and from
# a source 4e6 voxels away, whose position float32 holds to a quarter of a voxel.
LINES: tuple[tuple[Point, Point], ...] = (
    *(((0.0, 0.0, 0.0), d) for d in ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 2.0))),
    *(((0.125, -0.25, 0.375), d) for d in ((1.0, 0.25, -0.125), (0.5, -1.0, 0.75), (-0.25, 0.125, -1.0))),
    *(((0.25, 9.0, 0.25), (1.0, 0.0, 0.0)), ((-2.0, -1.5, -1.25), (1.0, 1.0, 1.0))),
    ((0.1 - 2e6, 0.2 + 0.3 * 2e6, 0.3 - 0.1 * 2e6), (1.0, -0.3, 0.1)),
)


def attenuations(thickness: float) -> list[list[list[float]]]:
    """Return a volume (Z, Y, X) whose line integrals are at most about `thickness`."""
    z, y, x = VOLUME_SHAPE
    largest = thickness / (x * VOXEL)
    values = [((3 * i + 5 * j + 7 * k) % 13 + 1) / 13 for k in range(z) for j in range(y) for i in range(x)]
    return torch.tensor(values, dtype=torch.float64).mul(largest).view(VOLUME_SHAPE).tolist()
