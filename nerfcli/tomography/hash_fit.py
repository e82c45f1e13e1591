"""Fit a hash grid to a scan: attenuation as a function of position, with line integrals summed over samples of rays.

The objective is that of `reconstruct`, by stochastic gradients: random pixels for the likelihood, random points for the
total variation. No contraction, no early stop, no dependence on the direction: every sample of a ray counts.

Source: Müller et al. 2022, Instant NGP, arXiv:2201.05989; Zha et al. 2022, NAF, arXiv:2209.14540, for X-rays.
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.kernels.activations import density_from_log
from nerfcli.tomography.grid import VoxelGrid
from nerfcli.tomography.reconstruct import Problem, curvature_bound

LEVELS, FEATURES, WIDTH = 8, 4, 32
LOG2_ROWS = 16
COARSEST = 16
# Samples are this many voxels apart, each at a random place in its interval.
STEP_VOXELS = 1.5
# At most about so many samples a step, at least so many steps a pass; points of total variation, per sample.
SAMPLES, STEPS_OF_PASS = 2**16, 64
SMOOTHED = 1 / 16
RATE, LAST_RATE = 1e-2, 1e-4
BETAS, EPS = (0.9, 0.99), 1e-15
ARRAYS = ("table.npy", "first-layer.npy", "last-layer.npy")
_CHUNK = 2**18


@dataclass
class HashVolume:
    """Attenuation start * exp(network(code of the position)), on the cube around a grid.

    Args:
        table: (L, T, F).
        layers: (H, L * F) and (1, H).
        start: attenuation of a code of 0, in 1 / unit.
        low: (x, y, z) corner of the cube.
        side: of the cube.
        finest: cells along the cube of the last level.
        passes: how many times all pixels have been looked at.
    """

    table: Tensor
    layers: tuple[Tensor, Tensor]
    start: float
    low: tuple[float, float, float]
    side: float
    finest: int
    passes: float = 0.0
    backend: kernels.Backend = field(
        default_factory=lambda: kernels.backend_for(torch.device("cpu"), torch.float32), repr=False
    )

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Learned arrays by the names of their files."""
        tensors = zip(ARRAYS, (self.table, *self.layers), strict=True)
        return {name: tensor.detach().numpy() for name, tensor in tensors}

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along the cube of each level, in geometric progression."""
        growth = math.log(max(self.finest, COARSEST) / COARSEST) / (LEVELS - 1)
        return tuple(round(COARSEST * math.exp(growth * level)) for level in range(LEVELS))

    def attenuation(self, points: Tensor, *, sink: Tensor | None = None) -> Tensor:
        """(N,) attenuation at points (N, 3); gradients of the table are added to the sink."""
        places = ((points - torch.tensor(self.low)) / self.side).float()
        code = self.backend.hash_encode(places, self.table, self.resolutions, sink=sink)
        hidden = torch.relu(code @ self.layers[0].t())
        return self.start * density_from_log((hidden @ self.layers[1].t())[:, 0])

    @torch.no_grad()
    def on_grid(self, grid: VoxelGrid) -> Tensor:
        """(Z, Y, X) attenuation at the centres of voxels."""
        axes = [torch.from_numpy(grid.axis(name)).float() for name in "zyx"]
        out = torch.empty(grid.shape)
        for layer, z in enumerate(axes[0]):
            y, x = torch.meshgrid(axes[1], axes[2], indexing="ij")
            points = torch.stack([x, y, torch.full_like(x, float(z))], dim=-1).view(-1, 3)
            out[layer] = torch.cat([self.attenuation(part) for part in points.split(_CHUNK)]).view(x.shape)
        return out


def new_arrays(seed: int) -> dict[str, np.ndarray]:
    """Return what a volume of one value has learned."""
    generator = torch.Generator().manual_seed(seed)
    shapes = ((LEVELS, 2**LOG2_ROWS, FEATURES), (WIDTH, LEVELS * FEATURES), (1, WIDTH))
    bounds = (1e-4, math.sqrt(6 / (LEVELS * FEATURES)), math.sqrt(6 / WIDTH))
    return {
        name: torch.empty(shape).uniform_(-bound, bound, generator=generator).numpy()
        for name, shape, bound in zip(ARRAYS, shapes, bounds, strict=True)
    }


def hash_volume(grid: VoxelGrid, start: float, arrays: Mapping[str, np.ndarray], *, passes: float = 0.0) -> HashVolume:
    """Return a volume around a grid, by what it has learned; its finest level has a cell per voxel."""
    table, one, two = (torch.from_numpy(np.array(arrays[name])).requires_grad_() for name in ARRAYS)
    x, y, z = (centre - grid.size / 2 for centre in grid.first)
    return HashVolume(table, (one, two), start, (x, y, z), max(grid.shape) * grid.size, max(grid.shape), passes)


def line_integrals(
    volume: HashVolume, rays: tuple[Tensor, Tensor], grid: VoxelGrid, *, jitter: Tensor, sink: Tensor | None = None
) -> Tensor:
    """(R,) sums over samples between the points where rays enter and leave the grid's box; 0 for those that miss it.

    Args:
        volume: what is summed.
        rays: (R, 3) origins and unit directions, float64.
        grid: whose box ends the rays, and whose voxels the step is stated in.
        jitter: numbers in [0, 1), repeated along the samples.
        sink: see `HashVolume.attenuation`.
    """
    origins, directions = rays
    low = torch.tensor(grid.first, dtype=torch.float64) - grid.size / 2
    high = low + grid.size * torch.tensor(grid.shape[::-1], dtype=torch.float64)
    inverse = 1 / torch.where(directions == 0, 1e-300, directions)
    ends = torch.stack([(low - origins) * inverse, (high - origins) * inverse])
    near, far = ends.amin(0).amax(1), ends.amax(0).amin(1)
    chord = (far - near).clamp_min(0)
    counts = torch.ceil(chord / (STEP_VOXELS * grid.size)).long()
    offsets = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    index = kernels.ray_indices(offsets)
    length = chord / counts.clamp_min(1)
    number = torch.arange(len(index)) - offsets[index]
    place = near[index] + (number + jitter.repeat(-(-len(index) // len(jitter)))[: len(index)]) * length[index]
    points = origins[index] + place[:, None] * directions[index]
    sampled = volume.attenuation(points, sink=sink)
    return kernels.sum_along_rays(sampled, offsets) * length.float()


def total_variation(volume: HashVolume, points: Tensor, size: float, *, sink: Tensor | None = None) -> Tensor:
    """Mean over points (N, 3) of the length of the difference to neighbours a voxel away along x, y and z."""
    steps = torch.cat([torch.zeros(1, 3), size * torch.eye(3)])
    values = volume.attenuation((points[:, None] + steps).view(-1, 3), sink=sink).view(-1, 4)
    return ((values[:, 1:] - values[:, :1]).square().sum(1) + 1e-12 * volume.start**2).sqrt().mean()


def fit_hash(
    problem: Problem,
    volume: HashVolume,
    *,
    strength: float,
    seed: int = 0,
    passes: int | None = None,
    seconds: float | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> None:
    """Fit a hash volume in place until the passes are done or the time is over.

    Args:
        problem: what to fit to.
        volume: where to begin.
        strength: of total variation, as in `reconstruct`.
        seed: of pixels and samples.
        passes: how many times to look at all pixels.
        seconds: how long to work; None for no limit, 0 for no step.
        progress: takes the share done and a few words.
    """
    begun = time.perf_counter()
    likelihood, grid = problem.likelihood.by_ray(), problem.grid
    _, beta = curvature_bound(problem, strength)
    geometry = problem.geometry
    count = geometry.views * geometry.rows * geometry.columns
    samples_of_ray = max(grid.shape) / STEP_VOXELS
    rays_of_step = math.ceil(min(SAMPLES / samples_of_ray, count / STEPS_OF_PASS))
    smoothed = math.ceil(SMOOTHED * rays_of_step * samples_of_ray)
    sink = torch.zeros_like(volume.table)
    first, second = torch.zeros_like(volume.table), torch.zeros_like(volume.table)
    optimiser = torch.optim.Adam(volume.layers, lr=RATE, betas=BETAS, eps=EPS)
    extent = grid.size * torch.tensor(grid.shape[::-1])
    corner = torch.tensor(grid.first) - grid.size / 2
    generator = torch.Generator().manual_seed(seed)
    done, step = 0.0, 0
    while True:
        order = torch.randperm(count, generator=generator)
        for chosen in order.split(rays_of_step):
            spent = time.perf_counter() - begun
            share = max(done / passes if passes else 0.0, 0.0 if seconds is None else spent / max(seconds, 1e-9))
            if share >= 1:
                return
            origins, directions = geometry.rays_of_pixels(chosen.numpy())
            rays = torch.from_numpy(origins), torch.from_numpy(directions)
            jitter = torch.rand(997, generator=generator, dtype=torch.float64)
            integrals = line_integrals(volume, rays, grid, jitter=jitter, sink=sink)
            slope = likelihood.slope(integrals.detach()[:, None], chosen)[:, 0] * (count / len(chosen))
            outputs, gradients = [integrals], [slope]
            if strength > 0:
                points = corner + extent * torch.rand(smoothed, 3, generator=generator)
                outputs.append(total_variation(volume, points, grid.size, sink=sink))
                gradients.append(torch.tensor(beta * grid.voxels))
            optimiser.zero_grad()
            torch.autograd.backward(outputs, gradients)
            step += 1
            rate = RATE * (LAST_RATE / RATE) ** share
            for group in optimiser.param_groups:
                group["lr"] = rate
            optimiser.step()
            with torch.no_grad():
                volume.backend.adam_rows(volume.table, sink, first, second, step=step, rate=rate, betas=BETAS, eps=EPS)
            done += len(chosen) / count
            volume.passes += len(chosen) / count
            if progress is not None:
                progress(share, f"pass {math.ceil(volume.passes)}")
