"""Fit a hash grid to a scan: attenuation as a function of position, with line integrals as sums over samples of rays.

It minimises the objective of `reconstruct` by stochastic gradient descent, with random pixels for the likelihood and
random points for the total variation. There is no contraction, early stop or view dependence: every sample counts.

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
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.reconstruct import Problem, curvature_bound
from nerfcli.kernels import AdamStep
from nerfcli.kernels.activations import density_from_log

LEVELS, FEATURES, WIDTH = 8, 4, 32
LOG2_ROWS = 16
COARSEST = 16
# Largest length in voxels of the intervals along a ray; each has one sample at a random place.
STEP_VOXELS = 1.5
# Samples per step (about, at most) and steps per pass (at least); points of total variation per sample.
SAMPLES, MIN_STEPS_PER_PASS = 2**16, 64
SMOOTHED = 1 / 16
RATE, LAST_RATE = 1e-2, 1e-4
BETAS, EPS = (0.9, 0.99), 1e-15
ARRAYS = ("table.npy", "first-layer.npy", "last-layer.npy")
_CHUNK = 2**18


@dataclass
class HashVolume:
    """Attenuation start * exp(network(code of the position)), on the cube around a grid.

    Args:
        table: (L, T, F) hash table: levels, rows, features.
        layers: weights of the network's two layers, (H, L * F) and (1, H).
        start: attenuation where the code is 0, in 1 / unit.
        low: (x, y, z) lowest corner of the cube.
        side: side of the cube, in the scan's unit.
        finest: number of cells along the cube at the last level.
        passes: number of passes over all pixels so far.
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
        """Learned arrays, keyed by file name."""
        tensors = zip(ARRAYS, (self.table, *self.layers), strict=True)
        return {name: tensor.detach().numpy() for name, tensor in tensors}

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Number of cells along the cube at each level, in geometric progression."""
        growth = math.log(max(self.finest, COARSEST) / COARSEST) / (LEVELS - 1)
        return tuple(round(COARSEST * math.exp(growth * level)) for level in range(LEVELS))

    def attenuation(self, points: Tensor, *, table_grad: Tensor | None = None) -> Tensor:
        """Return the attenuation (N,) at points (N, 3); gradients of the table are added to the sink."""
        places = ((points - torch.tensor(self.low)) / self.side).float()
        code = self.backend.hash_encode(places, self.table, self.resolutions, table_grad=table_grad)
        hidden = torch.relu(code @ self.layers[0].t())
        return self.start * density_from_log((hidden @ self.layers[1].t())[:, 0])

    @torch.no_grad()
    def on_grid(self, grid: VoxelGrid) -> Tensor:
        """Return the attenuation (Z, Y, X) at the voxel centres of a grid."""
        axes = [torch.from_numpy(grid.axis(name)).float() for name in "zyx"]
        out = torch.empty(grid.shape)
        for layer, z in enumerate(axes[0]):
            y, x = torch.meshgrid(axes[1], axes[2], indexing="ij")
            points = torch.stack([x, y, torch.full_like(x, float(z))], dim=-1).view(-1, 3)
            out[layer] = torch.cat([self.attenuation(part) for part in points.split(_CHUNK)]).view(x.shape)
        return out


def new_arrays(seed: int) -> dict[str, np.ndarray]:
    """Return random initial arrays; the volume that they describe is nearly constant."""
    generator = torch.Generator().manual_seed(seed)
    shapes = ((LEVELS, 2**LOG2_ROWS, FEATURES), (WIDTH, LEVELS * FEATURES), (1, WIDTH))
    bounds = (1e-4, math.sqrt(6 / (LEVELS * FEATURES)), math.sqrt(6 / WIDTH))
    return {
        name: torch.empty(shape).uniform_(-bound, bound, generator=generator).numpy()
        for name, shape, bound in zip(ARRAYS, shapes, bounds, strict=True)
    }


def hash_volume(grid: VoxelGrid, start: float, arrays: Mapping[str, np.ndarray], *, passes: float = 0.0) -> HashVolume:
    """Build a hash volume around a grid from its learned arrays; its finest level has one cell per voxel."""
    table, one, two = (torch.from_numpy(np.array(arrays[name])).requires_grad_() for name in ARRAYS)
    x, y, z = (centre - grid.size / 2 for centre in grid.first)
    return HashVolume(table, (one, two), start, (x, y, z), max(grid.shape) * grid.size, max(grid.shape), passes)


def line_integrals(
    volume: HashVolume,
    rays: tuple[Tensor, Tensor],
    grid: VoxelGrid,
    *,
    jitter: Tensor,
    table_grad: Tensor | None = None,
) -> Tensor:
    """Return line integrals (R,) of rays inside the grid's box, as sums over samples; 0 for rays that miss the box.

    Args:
        volume: attenuation to integrate.
        rays: (R, 3) origins and unit directions, float64.
        grid: its box bounds the rays, and `STEP_VOXELS` refers to its voxels.
        jitter: offsets of samples within their intervals, in [0, 1), repeated along the samples.
        table_grad: see `HashVolume.attenuation`.
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
    sampled = volume.attenuation(points, table_grad=table_grad)
    return kernels.sum_along_rays(sampled, offsets) * length.float()


def total_variation(volume: HashVolume, points: Tensor, size: float, *, table_grad: Tensor | None = None) -> Tensor:
    """Return the mean over points (N, 3) of the norm of the differences to neighbours `size` away along x, y and z."""
    steps = torch.cat([torch.zeros(1, 3), size * torch.eye(3)])
    values = volume.attenuation((points[:, None] + steps).view(-1, 3), table_grad=table_grad).view(-1, 4)
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
    """Fit a hash volume in place until the passes are done or the time is up.

    Args:
        volume: start of the fit, changed in place.
        strength: weight of total variation, as in `reconstruct`.
        passes: number of passes over all pixels; None for no limit.
        seconds: time limit; None for no limit, 0 for no step.
        progress: called with the fraction done and a short text.
    """
    begun = time.perf_counter()
    likelihood, grid = problem.likelihood.by_ray(), problem.grid
    _, beta = curvature_bound(problem, strength)
    geometry = problem.geometry
    count = geometry.views * geometry.rows * geometry.columns
    samples_of_ray = max(grid.shape) / STEP_VOXELS
    rays_of_step = math.ceil(min(SAMPLES / samples_of_ray, count / MIN_STEPS_PER_PASS))
    smoothed = math.ceil(SMOOTHED * rays_of_step * samples_of_ray)
    table_grad = torch.zeros_like(volume.table)
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
            fraction = max(done / passes if passes else 0.0, 0.0 if seconds is None else spent / max(seconds, 1e-9))
            if fraction >= 1:
                return
            origins, directions = geometry.rays_of_pixels(chosen.numpy())
            rays = torch.from_numpy(origins), torch.from_numpy(directions)
            jitter = torch.rand(997, generator=generator, dtype=torch.float64)
            integrals = line_integrals(volume, rays, grid, jitter=jitter, table_grad=table_grad)
            slope = likelihood.slope(integrals.detach()[:, None], chosen)[:, 0] * (count / len(chosen))
            outputs, gradients = [integrals], [slope]
            if strength > 0:
                points = corner + extent * torch.rand(smoothed, 3, generator=generator)
                outputs.append(total_variation(volume, points, grid.size, table_grad=table_grad))
                gradients.append(torch.tensor(beta * grid.voxels))
            optimiser.zero_grad()
            torch.autograd.backward(outputs, gradients)
            step += 1
            rate = RATE * (LAST_RATE / RATE) ** fraction
            for group in optimiser.param_groups:
                group["lr"] = rate
            optimiser.step()
            with torch.no_grad():
                volume.backend.adam_rows(volume.table, table_grad, first, second, step=AdamStep(step, rate, BETAS, EPS))
            done += len(chosen) / count
            volume.passes += len(chosen) / count
            if progress is not None:
                progress(fraction, f"pass {math.ceil(volume.passes)}")
