"""Points and steps: contraction from the centre to infinity, world coordinates of 1e6, rays along axes, empty space."""

import math
import time
from collections.abc import Iterator

import numpy as np
import torch
from frame_rays import frame_rays
from torch import Tensor

from nerfcli import kernels
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts
from nerfcli.kernels import HashGrid, March, Rays, reference
from nerfcli.kernels.selftest import textbook
from nerfcli.kernels.selftest.cases import CONTRACTED, DIRECTIONS
from nerfcli.kernels.selftest.measure import Errors, Precision, Row, largest_error
from nerfcli.training.open_cells import uncontract

GIVEN = (1.0, 0.5, 0.25)
WORLD = 1e6


def rows(precisions: tuple[Precision, ...]) -> Iterator[Row]:
    """Yield the rows of all operations on points and steps."""
    for precision in precisions:
        if not precision.compiled:
            yield from _contraction_rows(precision)
        if precision.dtype != torch.bfloat16:
            yield _axis_row(precision)
            yield _empty_row(precision)
    yield from _world_rows()


def _contracted(point: tuple[float, ...]) -> tuple[list[float], list[float], list[float]]:
    """Return the contracted point, the gradient of its dot product with GIVEN, and the size of the gradient's terms."""
    norm = math.hypot(*point)
    if norm <= 1.0:
        return list(point), list(GIVEN), [1.0] * 3
    along = math.fsum(x / norm * g for x, g in zip(point, GIVEN, strict=True))
    size = math.fsum(abs(x / norm * g) for x, g in zip(point, GIVEN, strict=True))
    first, bend = (2 - 1 / norm) / norm, (-2 + 2 / norm) / norm  # d contracted = first dx + bend u (u . dx)
    gradient = [first * g + bend * along * x / norm for x, g in zip(point, GIVEN, strict=True)]
    sizes = [first * abs(g) + abs(bend) * size for g in GIVEN]
    return [(2 - 1 / norm) * (x / norm) for x in point], gradient, sizes


def _contraction_rows(precision: Precision) -> Iterator[Row]:
    zero = (0.0, 0.0, 0.0)
    for name, radii in CONTRACTED:
        points = [tuple(r * x for x in d) for r in radii for d in DIRECTIONS] + ([zero] if 0.0 in radii else [])
        wanted = [_contracted(point) for point in points]

        def errors(operation, points=points, wanted=wanted) -> tuple[Errors, float]:  # type: ignore[no-untyped-def]
            given = precision.tensor(points).requires_grad_()
            start = time.perf_counter()
            answer = operation(given)
            (answer * precision.tensor(GIVEN)).sum().backward()
            seconds = time.perf_counter() - start
            value = largest_error(answer, [w[0] for w in wanted], tiny=precision.tiny)
            sizes = [w[2] for w in wanted]
            return Errors(
                value, largest_error(given.grad, [w[1] for w in wanted], tiny=precision.tiny, scale=sizes)
            ), seconds

        ours, seconds = errors(kernels.contract)
        yield Row(
            case=name,
            operation="contract",
            precision=precision.name,
            errors=ours,
            bounds=Errors(8 * precision.unit, 16 * precision.unit),
            reason="8 roundings u; of the gradient 16, relative to its terms",
            formula="where(|x| <= 1, x, (2 - 1 / |x|) x / |x|)",
            textbook=errors(textbook.contract)[0],
            seconds=seconds,
        )
    if precision.dtype == torch.bfloat16:
        return
    points = [tuple(r * x for x in DIRECTIONS[0]) for r in (0.5, 2.0, 30.0, 300.0)]
    start = time.perf_counter()
    back = uncontract(kernels.contract(precision.tensor(points)))
    seconds = time.perf_counter() - start
    beyond = uncontract(kernels.contract(precision.tensor([[2.0**30, 0.0, 0.0]])))
    yield Row(
        case="contraction and back, to where rays end (300)",
        operation="uncontract",
        precision=precision.name,
        errors=Errors(largest_error(back, points, tiny=precision.tiny)),
        bounds=Errors(8 * 300 * precision.unit),
        reason="8 u times the radius: next to 2, numbers stand u apart; rays end at 300, before it matters",
        formula="the same at a radius of 1e9",
        textbook=Errors(largest_error(beyond, [[2.0**30, 0.0, 0.0]], tiny=precision.tiny)),
        seconds=seconds,
    )


def _axis_row(precision: Precision) -> Row:
    """Measure axis-parallel rays through a full cube of side 2, some in the plane of a side or of cell borders."""
    origins = [[-2.0, 0.25, 0.125], [0.25, 2.0, 0.0], [0.5, -0.5, -3.0], [-2.0, -1.0, 1.0], [0.0, 0.0, 0.0]]
    directions = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    wanted = [2.0, 2.0, 2.0, 2.0, 1.0]  # the last starts in the middle
    start = time.perf_counter()
    starts, ends, offsets = _seen(origins, directions, precision=precision, full=True)
    seconds = time.perf_counter() - start
    chords = reference.sum_along_rays(ends - starts, offsets)
    near = [(side - o) / d if d else (side - o) / 0.0 if side != o else math.nan for side, o, d in ((-1.0, -1.0, 0.0),)]
    return Row(
        case="rays along axes, and in the plane of a side",
        operation="visible_samples",
        precision=precision.name,
        errors=Errors(largest_error(chords, wanted, tiny=precision.tiny)),
        bounds=Errors(0.0),
        reason="steps of 2^-7 are kept or not by their middles; nothing is divided by a direction",
        formula="slabs: (side - origin) / direction",
        textbook=None if precision.compiled else Errors(largest_error(np.array(near), [0.0], tiny=precision.tiny)),
        seconds=seconds,
    )


def _empty_row(precision: Precision) -> Row:
    """Measure rays without an occupied cell: no samples, the background colour, transmittance 1, undefined depth."""
    origins, directions = [[-2.0, 0.25, 0.125]] * 3, [[1.0, 0.0, 0.0]] * 3
    begin = time.perf_counter()
    starts, ends, offsets = _seen(origins, directions, precision=precision, full=False)
    module = precision.parts
    density, background = torch.zeros_like(starts), precision.tensor([[0.25, 0.5, 1.0]] * 3)
    rgb = starts.new_zeros(len(starts), 3)
    colour, passing, _ = module.composite(density, rgb, ends - starts, offsets=offsets, background=background)
    light = module.ray_termination(density, starts, ends, offsets=offsets, fractions=(0.5,))
    seconds = time.perf_counter() - begin
    got = torch.cat([colour.flatten(), passing, light.opacity, light.mean, light.quantiles.flatten()])
    wanted = [0.25, 0.5, 1.0] * 3 + [1.0] * 3 + [0.0] * 3 + [math.nan] * 6
    return Row(
        case="empty occupancy: every ray without samples",
        operation="visible_samples, composite, ray_termination",
        precision=precision.name,
        errors=Errors(largest_error(got, wanted, tiny=precision.tiny)),
        bounds=Errors(0.0),
        reason="exact: background, T = 1, opacity 0, depth undefined",
        seconds=seconds,
    )


def _seen(
    origins: list[list[float]], directions: list[list[float]], *, precision: Precision, full: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Return starts, ends and offsets of the samples kept on rays cut into steps of 2^-7, in a full or empty cube."""
    side, levels = 16, 8
    make = torch.ones if full else torch.zeros
    module = precision.parts
    table, shapes = precision.tensor([[[0.0] * 4] * 16] * levels), ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
    layers = tuple(precision.tensor([[0.0] * n] * m) for m, n in shapes)
    occupied = make(side, side, side, dtype=torch.bool, device=precision.device)
    edges = precision.tensor([k * 2.0**-7 for k in range(5 * 2**7)])
    rays = Rays(precision.tensor(origins), precision.tensor(directions), precision.tensor([0.0] * len(origins)))
    samples = module.visible_samples(rays, March(edges, occupied, "none", 1e9), HashGrid(table, (2,) * levels, layers))
    return samples.starts, samples.ends, samples.offsets


def _world_rows() -> Iterator[Row]:
    """Measure ray steps of 1.7e-3 in a scene of size 1 at 1e6 from the origin, with and without a training frame."""
    centre = np.array([WORLD, -WORLD, WORLD])
    camera = Camera.pinhole(8, 6, 8.0)
    offset = np.array([0.25, 0.125, -0.5])
    frame = Frame("a", camera, from_parts(np.eye(3), centre + offset))
    start = time.perf_counter()
    rays = frame_rays(frame, Similarity(1.0, np.eye(3), -centre), torch.device("cpu"))
    distances = torch.arange(1, 1025) * (math.sqrt(3) / 1024)
    points = rays.origin + rays.directions[0] * distances[:, None]
    seconds = time.perf_counter() - start
    bearing = rays.directions[0].double()
    steps = (torch.from_numpy(offset) + bearing * distances.double()[:, None]).diff(dim=0).norm(dim=1)
    world = torch.tensor(centre + offset, dtype=torch.float32) + rays.directions[0] * distances[:, None]
    unit = torch.finfo(torch.float32).eps / 2

    def error(path: Tensor) -> float:
        return largest_error(path.double().diff(dim=0).norm(dim=1), steps.tolist(), tiny=1e-30)

    yield Row(
        case="world coordinates of 1e6: steps of rays",
        operation="frame_rays",
        precision="float32",
        errors=Errors(error(points)),
        bounds=Errors(8 * unit * 2.5 / float(steps.min())),
        reason="8 u times place (2.5) / step: the similarity to the training frame is applied in float64",
        formula="float32 in world coordinates",
        textbook=Errors(error(world)),
        seconds=seconds,
    )
    similarity = Similarity(1e-3, np.eye(3), -centre * 1e-3)
    there = centre + np.random.default_rng(0).standard_normal((64, 3))
    start = time.perf_counter()
    back = similarity.inverse().apply(similarity.apply(there))
    seconds = time.perf_counter() - start
    lost = there.astype(np.float32).astype(np.float64)
    yield Row(
        case="world coordinates of 1e6: to the frame and back",
        operation="Similarity",
        precision="float64",
        errors=Errors(float(np.abs(back - there).max())),
        bounds=Errors(8 * 2.0**-53 * WORLD * math.sqrt(3)),
        reason="8 u of the coordinate, relative to the scene's size of 1",
        formula="float32 in world coordinates",
        textbook=Errors(float(np.abs(lost - there).max())),
        seconds=seconds,
    )
