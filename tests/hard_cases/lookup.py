"""Hard cases of table look-ups: hash-grid features, also in half precision, and pixels of many photos."""

import functools
import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.kernels import PixelTable, reference
from nerfcli.kernels.selftest.cases import (
    BETWEEN,
    BORDERS,
    EXACT_GRIDS,
    FEATURES,
    FINE_GRIDS,
    GAINS,
    ROWS,
    Point,
    hash_table,
)
from nerfcli.kernels.selftest.measure import Errors, Precision, Row, largest_error

# 16 samples in one grid cell, each repeated 256 times: gradient sums are far larger than any of their terms.
CROWD: tuple[Point, ...] = tuple((0.5 + 2.0**-9 * (k % 8), 0.25, 0.125 * (1 + k // 8)) for k in range(16))
CROWD_SIZE = 256
HALF_GRIDS = (4, 16)


def rows(precisions: tuple[Precision, ...]) -> Iterator[Row]:
    """Yield the rows of all look-ups."""
    for precision in precisions:
        if precision.dtype == torch.bfloat16:
            yield _half_row(torch.bfloat16, precision.device)
            yield _half_row(torch.float16, precision.device)
            continue
        yield _encode_row("hash grid on borders and corners of cells, and outside", BORDERS, precision, grids=EXACT)
        yield _encode_row("hash grid of up to 2048 cells, between vertices", BETWEEN, precision, grids=FINE)
        yield _pixel_row(precision)


@dataclass(frozen=True)
class _Grids:
    """Cells per axis of each level, and whether (1 or 0) scaling positions to cell units rounds them."""

    resolutions: tuple[int, ...]
    rounded: int


EXACT, FINE = _Grids(EXACT_GRIDS, 0), _Grids(FINE_GRIDS, 1)


@dataclass(frozen=True)
class _Encoded:
    """Features and table gradient, each with the size to which its rounding error is proportional."""

    features: list[list[float]]
    features_size: list[list[float]]
    gradient: list[list[list[float]]]
    gradient_size: list[list[list[float]]]


@functools.cache
def _exact(points: tuple[Point, ...], grids: _Grids, *, times: int) -> _Encoded:
    """Interpolate trilinearly in exact fractions; the gradient counts every point `times` times."""
    table = hash_table(len(grids.resolutions))
    largest = [max(abs(value) for row in level for value in row) for level in table]
    sums = [[[Fraction(0)] * 2 for _ in range(ROWS)] for _ in table]
    features: list[list[float]] = []
    sizes: list[list[float]] = []
    for point in points:
        features.append([])
        sizes.append([])
        for level, resolution in enumerate(grids.resolutions):
            corners = _corners(point, resolution)
            blur = grids.rounded * resolution
            for j in range(FEATURES):
                terms = [weight * Fraction(table[level][row][j]) for row, weight in corners]
                features[-1].append(float(sum(terms)))
                sizes[-1].append(float(sum(map(abs, terms))) + blur * largest[level])
            for row, weight in corners:
                sums[level][row][0] += times * weight
                sums[level][row][1] += times * (weight + blur)
    gradient, gradient_size = (
        [[[float(row[k]) * (gain if k == 0 else abs(gain)) for gain in GAINS] for row in level] for level in sums]
        for k in (0, 1)
    )
    return _Encoded(features, sizes, gradient, gradient_size)


def _corners(point: Point, resolution: int) -> list[tuple[int, Fraction]]:
    """Return the table row and the weight of each of the eight vertices around a point."""
    scaled = [min(max(Fraction(x), Fraction(0)), Fraction(1)) * resolution for x in point]
    cell = [min(math.floor(x), resolution - 1) for x in scaled]
    side, found = resolution + 1, []
    for corner in itertools.product((0, 1), repeat=3):
        x, y, z = (c + d for c, d in zip(cell, corner, strict=True))
        hashed = (x ^ y * 2654435761 ^ z * 805459861) % 2**32 % ROWS
        fractions = [s - c if d else 1 - (s - c) for s, c, d in zip(scaled, cell, corner, strict=True)]
        found.append(((z * side + y) * side + x if side**3 <= ROWS else hashed, math.prod(fractions)))
    return found


def _errors(encoded: Tensor, gradient: Tensor | None, wanted: _Encoded, *, tiny: float, times: int = 1) -> Errors:
    return Errors(
        largest_error(encoded, wanted.features * times, tiny=tiny, scale=wanted.features_size * times),
        largest_error(gradient, wanted.gradient, tiny=tiny, scale=wanted.gradient_size),
    )


def _in_half(
    points: Tensor, table: Tensor, resolutions: tuple[int, ...], *, half: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Return features and table gradient, both computed in half precision."""
    given = table.detach().to(half).requires_grad_()
    encoded = reference.hash_encode(points.to(half), given, resolutions)
    (encoded.view(len(points), -1, FEATURES) * torch.tensor(GAINS, dtype=half, device=points.device)).sum().backward()
    assert given.grad is not None
    return encoded, given.grad


def _encode_row(case: str, points: tuple[Point, ...], precision: Precision, *, grids: _Grids) -> Row:
    points = tuple(tuple(torch.tensor(point).tolist()) for point in points)  # the numbers that float32 holds
    wanted = _exact(points, grids, times=1)
    module = precision.parts
    places, table = precision.tensor(points), precision.tensor(hash_table(len(grids.resolutions))).requires_grad_()
    start = time.perf_counter()
    encoded = module.hash_encode(places, table, grids.resolutions)
    (encoded.view(len(points), -1, FEATURES) * precision.tensor(GAINS)).sum().backward()
    seconds = time.perf_counter() - start
    bound = (16 + len(points)) * precision.unit
    half = None
    if not precision.compiled:
        half = _errors(*_in_half(places, table, grids.resolutions, half=torch.float16), wanted, tiny=precision.tiny)
    return Row(
        case=case,
        operation="hash_encode",
        precision=precision.name,
        errors=_errors(encoded, table.grad, wanted, tiny=precision.tiny),
        bounds=Errors(16 * precision.unit, bound),
        reason="16 u, of a gradient 16 + n, relative to their terms; where places are rounded as they are counted in "
        "cells, relative to the resolution times the largest feature",
        formula="places, table and sums in float16",
        textbook=half,
        seconds=seconds,
    )


def _half_row(half: torch.dtype, device: str) -> Row:
    """Measure a half-precision table whose gradients are summed in a float32 sink, as in training."""
    single = Precision("float32", torch.float32, device)
    grids = _Grids(HALF_GRIDS, 0)
    wanted = _exact(CROWD, grids, times=CROWD_SIZE)
    points = single.tensor(CROWD).repeat(CROWD_SIZE, 1)
    table = single.tensor(hash_table(2)).to(half).requires_grad_()
    table_grad = torch.zeros_like(table, dtype=torch.float32)
    start = time.perf_counter()
    backend = kernels.backend_for(table.device, half)
    encoded = backend.hash_encode(points, table, grids.resolutions, table_grad=table_grad)
    (encoded.view(len(points), -1, FEATURES) * single.tensor(GAINS)).sum().backward()
    seconds = time.perf_counter() - start
    plain = _in_half(points, table, grids.resolutions, half=half)
    return Row(
        case=f"table in half precision, {len(points)} gradients of 1 to 1e-8 in a cell",
        operation="hash_encode",
        precision=str(half).removeprefix("torch."),
        errors=_errors(encoded, table_grad, wanted, tiny=single.tiny, times=CROWD_SIZE),
        bounds=Errors(16 * single.unit, (16 + len(points)) * single.unit),
        reason="16 u of float32, of a gradient 16 + n: the table alone is of half precision, sums are not",
        formula="places, table and sums in half precision",
        textbook=_errors(*plain, wanted, tiny=single.tiny, times=CROWD_SIZE),
        seconds=seconds,
    )


# Pixels in the first photo. From this number on, float32 cannot distinguish consecutive integers.
MANY = 2**24


@functools.cache
def _photos() -> Tensor:
    """Return the pixels of three photos (16 megapixels, one pixel, six pixels); all but the last seven are black."""
    photos = torch.zeros(MANY + 7, 3, dtype=torch.uint8)
    photos[MANY:] = torch.arange(1, 22, dtype=torch.uint8).reshape(7, 3) * 12
    return photos


def _pixel_row(precision: Precision) -> Row:
    """Measure the rays of the first, last and only pixels of photos, with pixel numbers beyond 2^24."""
    chosen = torch.tensor([0, 7, MANY, MANY + 1, MANY + 3, MANY + 6])
    photo, place = (0, 0, 1, 2, 2, 2), (0, 7, 8, 9, 11, 14)
    first_pixel, first_bearing = torch.tensor([0, MANY, MANY + 1]), torch.tensor([0, 8, 9])
    bearings = [[math.sin(k), math.cos(k) / 2, 1.0] for k in range(15)]
    poses = [[[math.cos(3 * p + 5 * i + j) for j in range(4)] for i in range(4)] for p in range(3)]
    bearings, poses = (torch.tensor(x, dtype=torch.float32).tolist() for x in (bearings, poses))
    photos = _photos()
    turned = [
        [[Fraction(a) * Fraction(b) for a, b in zip(poses[p][i][:3], bearings[k], strict=True)] for i in range(3)]
        for p, k in zip(photo, place, strict=True)
    ]
    wanted = (
        [[poses[p][i][3] for i in range(3)] for p in photo],
        [[float(sum(terms)) for terms in rows_of] for rows_of in turned],
        [[value / 255 for value in photos[number].tolist()] for number in chosen.tolist()],
    )
    sizes = (wanted[0], [[float(sum(map(abs, terms))) for terms in rows_of] for rows_of in turned], wanted[2])
    module = precision.parts

    def error(answers: tuple[Tensor, ...]) -> float:
        found = zip(answers, wanted, sizes, strict=True)
        return max(largest_error(a, w, tiny=precision.tiny, scale=s) for a, w, s in found)

    first_pixel, first_bearing, photos = (x.to(precision.device) for x in (first_pixel, first_bearing, photos))
    pixels = PixelTable(first_pixel, first_bearing, precision.tensor(bearings), precision.tensor(poses), photos)
    start = time.perf_counter()
    rays = module.pixel_rays(chosen.to(precision.device), pixels)
    seconds = time.perf_counter() - start
    plain = None
    if not precision.compiled:
        plain = Errors(error(module.pixel_rays(chosen.float().long().to(precision.device), pixels)))
    return Row(
        case="pixels beyond number 2^24, first, last and only ones of their photos",
        operation="pixel_rays",
        precision=precision.name,
        errors=Errors(error(rays)),
        bounds=Errors(4 * precision.unit),
        reason="4 u: a sum of three products, relative to its terms",
        formula="numbers of pixels in float32",
        textbook=plain,
        seconds=seconds,
    )
