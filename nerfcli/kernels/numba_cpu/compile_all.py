"""Run every CPU kernel once, which compiles it or loads it from the cache on disk."""

import os
import subprocess
from contextlib import suppress
from pathlib import Path

import torch
from torch import Tensor

from nerfcli import child
from nerfcli.errors import UserError
from nerfcli.kernels.interface import AdamStep, HashGrid, March, PixelTable, Rays, TraceOptions
from nerfcli.kernels.numba_cpu import machine_code
from nerfcli.kernels.numba_cpu.compositing import composite, distortion, interval_weights, optical_depth_before
from nerfcli.kernels.numba_cpu.coordinates import ray_gradients
from nerfcli.kernels.numba_cpu.depth import ray_termination
from nerfcli.kernels.numba_cpu.hash_grid import hash_encode
from nerfcli.kernels.numba_cpu.marching import keep_largest, occupied_samples
from nerfcli.kernels.numba_cpu.networks import density, radiance
from nerfcli.kernels.numba_cpu.pixels import pixel_rays
from nerfcli.kernels.numba_cpu.rays import ray_indices
from nerfcli.kernels.numba_cpu.row_adam import adam_rows
from nerfcli.kernels.numba_cpu.tracing import trace_rays
from nerfcli.kernels.numba_cpu.visible import visible_samples

RENDERING_PROCESS = "nerfcli.kernels.numba_cpu.rendering_process"


def warm_up() -> None:
    """Run every kernel once on a ray of two samples, which compiles it or loads it from the cache.

    To compile all of them takes over a minute of one core. So a second process compiles half of them, unless torch is
    limited to one thread.

    Raises:
        UserError: compiled code cannot be cached on disk.
    """
    beside = None if machine_code.is_there() or torch.get_num_threads() < 2 else _rendering_process()
    try:
        run_training()
        if beside is not None:
            beside.wait()
        run_rendering()  # loads what the other process has compiled, and compiles what it has not
    except OSError as error:
        raise UserError(
            f"cannot cache compiled kernels in {machine_code.folder()}: {error.strerror or error}",
            "free some disk space, or set NUMBA_CACHE_DIR to another folder",
        ) from error
    finally:
        if beside is not None:
            beside.kill()
            beside.communicate()


def _rendering_process() -> "subprocess.Popen[bytes] | None":
    with suppress(OSError), Path(os.devnull).open("wb") as log:
        return child.spawn(RENDERING_PROCESS, Path(), log=log, threads=1)
    return None


def run_training() -> None:
    """Run the kernels of a training step, and those of depth."""
    direction, offsets, starts, lengths = _two_samples()
    spans = (starts, starts + 1)
    points = torch.zeros(2, 3, requires_grad=True)
    ray_gradients(direction, direction, *spans, offsets=offsets, contraction="l2", gradient=torch.zeros(2, 3))
    table, weights = _field()
    encoded = hash_encode(points, table, (2,) * 8, None, torch.zeros(2, 32))
    hash_encode(points.detach(), table, (2,) * 8, None, None)
    optical_depth_before(density(encoded.detach(), weights), lengths, offsets)
    thickness, rgb = radiance(encoded, torch.zeros(1, 16, requires_grad=True), ray_indices(offsets), weights)
    interval_weights(thickness, lengths, offsets)
    ray_termination(thickness, *spans, offsets=offsets, fractions=(0.5,))
    colour, _, spread = composite(thickness, rgb, lengths, offsets=offsets, background=torch.zeros(3))
    (colour.sum() + distortion(spread, *spans, offsets).sum()).backward()
    gradient, first, second = (torch.zeros(8, 16, 4) for _ in range(3))
    adam_rows(table, gradient, first, second, step=AdamStep(1, 0.0, (0.9, 0.99), 1e-15))


def run_rendering() -> None:
    """Run the kernels that find samples along the rays of pixels and render them."""
    direction, _, _, lengths = _two_samples()
    occupied = torch.ones(2, 2, 2, dtype=torch.bool)
    rays, along = Rays(direction, direction, torch.zeros(1)), March(torch.arange(1, 5) / 2, occupied, "l2", 10.0)
    table, weights = _field()
    grid = HashGrid(table, (2,) * 8, weights)
    _, _, _, _, points, *_ = visible_samples(rays, along, grid)
    trace_rays(rays, along, grid, TraceOptions((0.5,)), background=torch.zeros(3))
    occupied_samples(rays, along)
    keep_largest(torch.zeros(2, 2, 2), points, lengths[: len(points)])
    pixel = torch.zeros(1, dtype=torch.int64)
    photos = torch.zeros(1, 3, dtype=torch.uint8)
    pixel_rays(pixel, PixelTable(pixel, pixel, direction, torch.eye(4)[None], photos))


def _two_samples() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the direction of a ray, the offsets of its samples, and where they start and how long they are."""
    return torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([0, 2]), torch.tensor([0.0, 1.0]), torch.ones(2)


def _field() -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return the table of a hash grid and the weights of its networks."""
    shapes = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
    return torch.zeros(8, 16, 4, requires_grad=True), tuple(torch.zeros(shape, requires_grad=True) for shape in shapes)
