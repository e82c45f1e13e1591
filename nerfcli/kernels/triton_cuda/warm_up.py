"""Compilation of all kernels of training and rendering, before any time budget starts to run."""

from itertools import product

import torch

from nerfcli.kernels.interface import AdamStep, BearingGrids, HashGrid, March, PixelTable, Rays, Targets, TraceOptions
from nerfcli.kernels.triton_cuda.backend import TritonBackend


def warm_up(device: torch.device) -> None:
    """Run steps of trainings and a picture of two rays: each contraction, with and without what kernels leave out."""
    backend = TritonBackend(device)
    numbers = torch.arange(2, device=device)
    first, bearings, poses = numbers[:1], torch.ones(2, 3, device=device), torch.eye(4, device=device)[None]
    grids = BearingGrids(torch.tensor([[2, 2]], device=device), torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device))
    for channels in (3, 4):
        colours = torch.zeros(2, channels, dtype=torch.uint8, device=device)
        for of_lens in (None, grids):
            pixels = PixelTable(first, first, bearings, poses, colours, of_lens)
            origins, directions, _ = backend.pixel_rays(numbers, pixels)
    table = torch.zeros(8, 16, 4, device=device, requires_grad=True)
    shapes = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
    layers = tuple(torch.zeros(shape, device=device, requires_grad=True) for shape in shapes)
    table_grad, mean, square = (torch.zeros(8, 16, 4, device=device) for _ in range(3))
    grid = HashGrid(table, (2,) * 8, layers, table_grad=table_grad)
    # Of detailed fields, which note the cells of their samples; and of components that are not on by default.
    other = grid._replace(view_degree=0, antialias=True)
    cell_depths = torch.full((2, 2, 2), -1.0, device=device)
    edges, occupied = torch.linspace(0.0, 0.5, 6, device=device), torch.ones(2, 2, 2, dtype=torch.bool, device=device)
    for contraction in ("none", "l2"):
        march = March(edges, occupied, contraction, 7.0)
        for learn, (field, cells) in product((False, True), ((grid, None), (other, cell_depths))):
            rays = Rays(origins.clone(), directions.clone(), *(torch.zeros(2, device=device) for _ in range(2)))
            rays.origins.requires_grad_(learn)
            rays.directions.requires_grad_(learn)
            sums = backend.render_rays(
                rays,
                march,
                field,
                Targets(distortion=True),
                background=torch.zeros(2, 3, device=device),
                cell_depths=cells,
            )
            (sums.rgb.sum() + sums.distortion.sum()).backward()
        backend.trace_rays(rays.detached(), march, grid, TraceOptions((0.5,)), background=torch.zeros(3, device=device))
    backend.density(torch.full((2, 3), 0.5, device=device), grid)
    backend.adam_rows(table, table_grad, mean, square, step=AdamStep(1, 0.0, (0.9, 0.99), 1e-15))
    if device.type == "cuda":
        torch.cuda.synchronize(device)
