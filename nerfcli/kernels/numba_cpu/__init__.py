"""The hot operations on CPU threads, compiled by Numba for the processor they run on, cached on disk."""

import torch

from nerfcli.errors import UserError
from nerfcli.kernels.interface import HashGrid, March, PixelTable, Rays
from nerfcli.kernels.numba_cpu import machine_code
from nerfcli.kernels.numba_cpu.compositing import composite, distortion, interval_weights, optical_depth_before
from nerfcli.kernels.numba_cpu.coordinates import sample_coordinates
from nerfcli.kernels.numba_cpu.depth import light_ends, mixture_quantile
from nerfcli.kernels.numba_cpu.hash_grid import can_hash_encode, hash_encode
from nerfcli.kernels.numba_cpu.marching import keep_largest, occupied_samples
from nerfcli.kernels.numba_cpu.networks import can_radiance, density, radiance
from nerfcli.kernels.numba_cpu.pixels import pixel_rays
from nerfcli.kernels.numba_cpu.projection import back_project, project
from nerfcli.kernels.numba_cpu.rays import ray_indices
from nerfcli.kernels.numba_cpu.row_adam import adam_rows
from nerfcli.kernels.numba_cpu.threads import thread_safe
from nerfcli.kernels.numba_cpu.total_variation import denoise_total_variation
from nerfcli.kernels.numba_cpu.tracing import trace_rays
from nerfcli.kernels.numba_cpu.visible import visible_samples

__all__ = [
    "adam_rows",
    "back_project",
    "can_hash_encode",
    "can_radiance",
    "composite",
    "denoise_total_variation",
    "density",
    "distortion",
    "hash_encode",
    "interval_weights",
    "is_compiled",
    "keep_largest",
    "light_ends",
    "mixture_quantile",
    "occupied_samples",
    "optical_depth_before",
    "pixel_rays",
    "project",
    "radiance",
    "ray_indices",
    "sample_coordinates",
    "thread_safe",
    "trace_rays",
    "visible_samples",
    "warm_up",
]


machine_code.discard_outdated(machine_code.sources(), machine_code.folder())


def is_compiled() -> bool:
    """Return whether compiled kernels are cached on disk."""
    return machine_code.is_there()


def warm_up() -> None:
    """Run every kernel once on a ray of two samples, which compiles it or loads it from the cache.

    Raises:
        UserError: compiled code cannot be cached on disk.
    """
    try:
        _run_all()
    except OSError as error:
        raise UserError(
            f"cannot cache compiled kernels in {machine_code.folder()}: {error.strerror or error}",
            "free some disk space, or set NUMBA_CACHE_DIR to another folder",
        ) from error


def _run_all() -> None:
    offsets = torch.tensor([0, 2])
    direction, jitter = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1)
    occupied = torch.ones(2, 2, 2, dtype=torch.bool)
    starts, lengths = torch.tensor([0.0, 1.0]), torch.ones(2)
    table = torch.zeros(8, 16, 4, requires_grad=True)
    shapes = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
    weights = tuple(torch.zeros(shape, requires_grad=True) for shape in shapes)
    rays, along = Rays(direction, direction, jitter), March(torch.tensor([0.5, 1.0, 1.5, 2.0]), occupied, "l2", 10.0)
    grid = HashGrid(table, (2,) * 8, weights)
    _, _, _, encoded, points, *_ = visible_samples(rays, along, grid)
    trace_rays(rays, along, grid, background=torch.zeros(3), fractions=(0.5,), negligible=0.0)
    occupied_samples(rays, along)
    keep_largest(torch.zeros(2, 2, 2), points, lengths[: len(points)])
    spans = (starts, starts + 1)
    sample_coordinates(direction, direction, *spans, offsets=offsets, contraction="l2", computed=None)
    ray = direction.clone().requires_grad_()
    points = sample_coordinates(ray, ray, *spans, offsets=offsets, contraction="l2", computed=points)
    encoded = hash_encode(points, table, (2,) * 8, None, encoded)
    hash_encode(points.detach(), table, (2,) * 8, None, None)
    optical_depth_before(density(encoded.detach(), weights), lengths, offsets)
    thickness, rgb = radiance(encoded, torch.zeros(1, 16, requires_grad=True), ray_indices(offsets), weights)
    interval_weights(thickness, lengths, offsets)
    light_ends(thickness, starts, starts + 1, offsets=offsets, fractions=(0.5,))
    mixture_quantile(thickness, starts, starts + 1, offsets=offsets, rays_per_pixel=1, fraction=0.5)
    colour, _, spread = composite(thickness, rgb, lengths, offsets=offsets, background=torch.zeros(3))
    (colour.sum() + distortion(spread, starts, starts + 1, offsets).sum()).backward()
    pixel = torch.zeros(1, dtype=torch.int64)
    photos = torch.zeros(1, 3, dtype=torch.uint8)
    pixel_rays(pixel, PixelTable(pixel, pixel, direction, torch.eye(4)[None], photos))
    gradient, first, second = (torch.zeros(8, 16, 4) for _ in range(3))
    adam_rows(table, gradient, first, second, step=1, rate=0.0, betas=(0.9, 0.99), eps=1e-15)
