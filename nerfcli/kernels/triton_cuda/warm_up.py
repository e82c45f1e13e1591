"""Compilation of all kernels of training and rendering, before any time budget starts to run."""

import torch

from nerfcli.kernels.interface import AdamStep, HashGrid, March, PixelTable, Rays, Targets
from nerfcli.kernels.triton_cuda.backend import TritonBackend


def warm_up(device: torch.device) -> None:
    """Run a step of a training and a picture of two rays, for every contraction."""
    backend = TritonBackend(device)
    numbers = torch.arange(2, device=device)
    pixels = PixelTable(
        numbers[:1],
        numbers[:1],
        torch.ones(2, 3, device=device),
        torch.eye(4, device=device)[None],
        torch.zeros(2, 3, dtype=torch.uint8, device=device),
    )
    origins, directions, _ = backend.pixel_rays(numbers, pixels)
    table = torch.zeros(8, 16, 4, device=device, requires_grad=True)
    shapes = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
    layers = tuple(torch.zeros(shape, device=device, requires_grad=True) for shape in shapes)
    grid = HashGrid(table, (2,) * 8, layers)
    edges, occupied = torch.linspace(0.0, 0.5, 6, device=device), torch.ones(2, 2, 2, dtype=torch.bool, device=device)
    table_grad, first, second = (torch.zeros(8, 16, 4, device=device) for _ in range(3))
    for contraction in ("none", "l2"):
        march = March(edges, occupied, contraction, 7.0)
        for learn in (False, True):
            rays = Rays(origins.clone(), directions.clone(), torch.zeros(2, device=device))
            rays.origins.requires_grad_(learn)
            rays.directions.requires_grad_(learn)
            sums = backend.render_rays(
                rays,
                march,
                grid,
                Targets(distortion=True),
                background=torch.zeros(2, 3, device=device),
                table_grad=table_grad,
            )
            (sums.rgb.sum() + sums.distortion.sum()).backward()
        backend.trace_rays(rays.detached(), march, grid, background=torch.zeros(3, device=device), fractions=(0.5,))
    backend.density(torch.full((2, 3), 0.5, device=device), grid)
    backend.adam_rows(table, table_grad, first, second, step=AdamStep(1, 0.0, (0.9, 0.99), 1e-15))
    if device.type == "cuda":
        torch.cuda.synchronize(device)
