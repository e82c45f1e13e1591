"""Bayes' Rays' uncertainty of a field: a Laplace approximation over a grid that deforms its space.

Goli et al. 2024, arXiv:2309.03185, and its code: points x of the training rays become x + D(x), with one offset per
vertex of a grid over the field's unit cube, interpolated. Only the diagonal of the Hessian of the squared colour error
with respect to these offsets, at 0, is used; its inverse is the variance of each vertex. Nothing is trained again.

    python benchmarks/uncertainty_laplace.py -o uncertainty       # the folder of `uncertainty.py train`
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from torch import Tensor
from uncertainty import replicates
from uncertainty_scenes import load_replicate, looks, write_capture

from nerfcli.cameras.frame import Frame
from nerfcli.field.background import colours_behind
from nerfcli.kernels import HashGrid, March, Rays, grid_coordinates, reference, spherical_harmonics
from nerfcli.kernels.interface import Samples
from nerfcli.render.model import Model
from nerfcli.render.rays import CENTRES, pixel_rays
from nerfcli.render.tracing import TOLERANCE, deepest, uniform_cuts
from nerfcli.workflows.train import train_scene, was_interrupted

# Cells along each side of the deformation grid, number of training rays (theirs: 256 and 4,096,000), rays per batch.
SIDE, RAYS, TOGETHER = 64, 2**15, 1024
# From their code: the prior, and the log10 deviation of light that passes all samples.
PRIOR, LEAST = 1e-4, -3.0


def corners_of(coordinates: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Return the indices (8, N) of the vertices around points (N, 3) of the unit cube, and their weights (8, N)."""
    places = coordinates.clamp(0.0, 1.0) * side
    low = places.floor().clamp_max(side - 1)
    fraction = places - low
    numbers, weights = [], []
    for corner in range(8):
        step = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2])
        at = low.long() + step
        numbers.append((at[:, 2] * (side + 1) + at[:, 1]) * (side + 1) + at[:, 0])
        weights.append(torch.where(step == 1, fraction, 1.0 - fraction).prod(dim=1))
    return torch.stack(numbers), torch.stack(weights)


def marched(model: Model, origins: Tensor, directions: Tensor) -> tuple[HashGrid, Samples]:
    """Return the field's grid and the visible samples of rays."""
    grid = model.field.medium()
    assert isinstance(grid, HashGrid)
    assert not grid.antialias
    cuts = uniform_cuts(model.marching).to(directions)
    along = March(torch.cat([cuts, cuts[-1:]]), model.occupied, model.contraction, deepest(TOLERANCE))
    rays = Rays(origins, directions, torch.zeros_like(directions[:, 0]))
    return grid, reference.visible_samples(rays, along, grid)


def colours(
    model: Model, origins: Tensor, directions: Tensor, samples: Samples, grid: HashGrid, offsets: Tensor
) -> Tensor:
    """Return the colours (R, 3) of rays whose samples are moved by offsets (N, 3) of the training frame."""
    rays = reference.ray_indices(samples.offsets)
    points = origins[rays] + directions[rays] * ((samples.starts + samples.ends) / 2)[:, None] + offsets
    encoded = reference.hash_encode(grid_coordinates(points, model.contraction), grid.table, grid.resolutions)
    harmonics = spherical_harmonics(directions, grid.view_degree)
    density, rgb = reference.radiance(encoded, harmonics, rays, grid.layers)
    behind = colours_behind(model.background, directions)
    lengths = samples.ends - samples.starts
    return reference.composite(density, rgb, lengths, offsets=samples.offsets, background=behind)[0]


def squared_jacobians(model: Model, origins: Tensor, directions: Tensor, side: int) -> Tensor:
    """Return the squared derivatives of colours by the offset of each vertex, ((side + 1)^3,) float64.

    They are summed over rays, channels and axes.
    """
    grid, samples = marched(model, origins, directions)
    offsets = torch.zeros_like(samples.coordinates).requires_grad_()
    seen = colours(model, origins, directions, samples, grid, offsets)
    numbers, weights = corners_of(samples.coordinates, side)
    keys = (reference.ray_indices(samples.offsets) * (side + 1) ** 3 + numbers).ravel()
    unique, places = keys.unique(return_inverse=True)
    found = torch.zeros((side + 1) ** 3, dtype=torch.float64)
    for channel in range(3):
        (slopes,) = torch.autograd.grad(seen[:, channel].sum(), offsets, retain_graph=channel < 2)
        parts = (weights[:, :, None] * slopes).reshape(-1, 3).double()
        sums = torch.zeros((len(unique), 3), dtype=torch.float64).index_add_(0, places, parts)
        found.index_add_(0, unique % (side + 1) ** 3, sums.square().sum(dim=1))
    return found


@torch.no_grad()
def logarithms(model: Model, origins: Tensor, directions: Tensor, variance: Tensor, side: int) -> Tensor:
    """Return for rays (R,) the log10 standard deviation of the deformation, composited like their colours.

    Args:
        variance: ((side + 1)^3,) of the vertices; between them, means are weighted by squared interpolation weights.
    """
    _, samples = marched(model, origins, directions)
    numbers, weights = corners_of(samples.coordinates, side)
    fractions = weights.square() / weights.square().sum(dim=0)
    values = torch.log10((variance[numbers] * fractions).sum(dim=0).sqrt() + 1e-12)
    light, passed = reference.interval_weights(samples.density, samples.ends - samples.starts, samples.offsets)
    return reference.sum_along_rays(light.double() * values, samples.offsets) + passed * LEAST


def rays_of(model: Model, frame: Frame, pixels: np.ndarray) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield origins and directions (N, 3) of some pixels, in batches."""
    rays = pixel_rays(frame, model.training_from_scene, pixels=pixels, places=CENTRES, device=torch.device("cpu"))
    for directions in rays.directions.split(TOGETHER):
        yield rays.origin.expand_as(directions), directions


def deviations(model: Model, training: Sequence[Frame], views: Sequence[Frame], *, side: int = SIDE) -> np.ndarray:
    """Return the uncertainty of all pixels of views, one view after the other."""
    rng, total, count = np.random.default_rng(0), torch.zeros((side + 1) ** 3, dtype=torch.float64), 0
    for frame in training:
        size = frame.camera.width * frame.camera.height
        chosen = np.sort(rng.choice(size, min(size, RAYS // len(training)), replace=False))
        count += len(chosen)
        for origins, directions in rays_of(model, frame, chosen):
            total += squared_jacobians(model, origins, directions, side)
    variance = 1.0 / (total / count + PRIOR / side**3)
    columns = [
        logarithms(model, *rays, variance, side)
        for view in views
        for rays in rays_of(model, view, np.arange(view.camera.width * view.camera.height))
    ]
    return torch.cat(columns).numpy()


def main(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the experiment.")],
    only: Annotated[str, typer.Option(help="Names of replicates, as desk-sector-0; all by default.")] = "",
) -> None:
    """Train the deployed field of each replicate again, and keep the uncertainty of its views: laplace.npz."""
    torch.set_num_threads(1)
    for one in replicates():
        folder, capture = output / one.name, output / "captures" / one.scene
        if (only and one.name not in only.split(",")) or (folder / "laplace.npz").exists():
            continue
        if not (capture / "transforms.json").exists():
            write_capture(one.scene, capture)
        scene = load_replicate(capture, folder, sector=one.sector)
        settings, path, holdout = one.settings(1), folder / "laplace-run", str(folder / "held_out.txt")
        resume = was_interrupted(capture, path, settings, holdout=holdout)
        run = train_scene(capture, path, settings, holdout=holdout, resume=resume)
        began = time.process_time()
        found = deviations(run.model(), run.cameras.train, looks(scene.test_frames))
        seconds = time.process_time() - began
        np.savez_compressed(folder / "laplace.npz", deviation=found, seconds=np.array(seconds))
        print(f"{one.name}: {RAYS} rays, {seconds:.0f} CPU s", flush=True)


if __name__ == "__main__":
    typer.run(main)
