"""Fit a volume to a scan: penalised likelihood by ordered subsets with momentum, and total variation.

    minimise over volumes mu >= 0:   sum over rays of -log likelihood(line integral of mu)  +  beta * TV(mu)

Each step uses a subset of the views. It moves each voxel by its gradient over a bound on the curvature, denoises the
result in the metric of that bound (`denoise_total_variation`), and extrapolates in the direction of the last move.

Source: Erdogan and Fessler 1999, Ordered subsets algorithms for transmission tomography, Phys. Med. Biol. 44; Kim,
Ramani and Fessler 2015, Combining ordered subsets and momentum, IEEE TMI 34(1); the proximal step as in Beck and
Teboulle 2009.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from nerfcli import kernels
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.likelihood import Likelihood
from nerfcli.kernels.reference import total_variation
from nerfcli.notices import Progress, no_progress

# Approximate number of views per subset: with fewer, a pass has more steps, but each approximates all views less well.
VIEWS_OF_SUBSET = 5
# Largest number of subsets: with more, momentum diverges (on a scan of 90 degrees 30 subsets did, 11 did not).
MOST_SUBSETS = 12
# Above this multiple of the best objective, the number of subsets is halved and the fit restarts at the best volume.
RISE = 1.05
# Iterations on the dual of total variation per step; they start from the dual of the step before.
DENOISING_STEPS = 3
# Lower bound of the curvature as a fraction of its median: voxels that few rays meet would move too far otherwise.
LEAST_CURVATURE = 0.1
# Last fraction of a time budget, without momentum, in which the disagreement between subsets settles.
SETTLING = 0.25
# A volume has settled when a pass changes it by at most this fraction of its norm.
SETTLED = 3e-4


@dataclass(frozen=True)
class Problem:
    """Data and grid of a fit."""

    geometry: ScanGeometry
    likelihood: Likelihood
    grid: VoxelGrid


@dataclass
class Fit:
    """State of a fit.

    Args:
        volume: (Z, Y, X) attenuation, float32.
        dual: (3, Z, Y, X) dual variable of its total variation.
        passes: number of passes over all views so far.
        settled: whether the last pass changed the volume by at most `SETTLED`.
    """

    volume: Tensor
    dual: Tensor
    passes: int = 0
    settled: bool = False


class Projector:
    """Rays of a scan through a grid, view by view; the rays of all views are kept once they are used together."""

    def __init__(self, geometry: ScanGeometry, grid: VoxelGrid):
        self._geometry, self._grid = geometry, grid
        self._backend = kernels.backend_for(torch.device("cpu"), torch.float32)
        self._of_all: tuple[Tensor, Tensor] | None = None

    def forward(self, volume: Tensor, views: np.ndarray | None = None) -> Tensor:
        """Return line integrals (views, pixels) of a volume, for some views or for all."""
        grid = self._grid
        integrals = self._backend.project(volume, *self._rays(views), first=grid.first, size=grid.size)
        return integrals.view(self._geometry.views if views is None else len(views), -1)

    def backward(self, values: Tensor, views: np.ndarray | None = None) -> Tensor:
        """Apply the transpose of `forward`: return a volume from values (views, pixels)."""
        grid, rays = self._grid, self._rays(views)
        return self._backend.back_project(values.reshape(-1), *rays, shape=grid.shape, first=grid.first, size=grid.size)

    def _rays(self, views: np.ndarray | None) -> tuple[Tensor, Tensor]:
        if views is None and self._of_all is not None:
            return self._of_all
        origins, directions = self._geometry.rays(views)
        rays = torch.from_numpy(origins.reshape(-1, 3)), torch.from_numpy(directions.reshape(-1, 3))
        if views is None:
            self._of_all = rays
        return rays


def start(problem: Problem) -> Fit:
    """Return a constant volume >= 0: the sum of the line integrals that the data suggest over that of chord lengths."""
    projector = Projector(problem.geometry, problem.grid)
    ones = torch.ones(problem.grid.shape)
    total, length = 0.0, 0.0
    for view in torch.arange(problem.geometry.views):
        suggested = problem.likelihood.suggested(view[None])
        chord = projector.forward(ones, view[None].numpy())
        met = torch.isfinite(suggested) & (chord > 0)
        total, length = total + float(suggested[met].sum()), length + float(chord[met].sum())
    mean = max(total / length, 0.0) if length > 0 else 0.0
    return Fit(torch.full(problem.grid.shape, mean), torch.zeros(3, *problem.grid.shape))


def finer(fit: Fit, grid: VoxelGrid) -> Fit:
    """Interpolate a fit onto another grid over the same box, with a dual of 0; its passes are counted anew."""
    volume = interpolate(fit.volume[None, None], grid.shape, mode="trilinear")[0, 0]
    return Fit(volume, torch.zeros(3, *grid.shape))


def reconstruct(
    problem: Problem,
    fit: Fit,
    *,
    strength: float,
    passes: int | None = None,
    seconds: float | None = None,
    progress: Progress = no_progress,
    keep: Callable[[Fit], None] = lambda fit: None,
) -> Fit:
    """Continue a fit until the passes or the time are used up, or it has converged.

    Args:
        strength: weight of total variation: beta = strength * sqrt(median over voxels of sum over rays of curvature *
            length), so that 1 is about the noise of a voxel without regularisation, for any dose and unit of the scan.
        passes: number of passes over all views; None for no limit.
        seconds: time limit, but at least one pass is done; None for no limit.
        progress: called after every step with the fraction done and a short text.
        keep: called after every pass with the fit, so that an interruption does not lose it.

    Returns:
        A new fit; the given one is not changed.
    """
    begun = time.perf_counter()
    projector = Projector(problem.geometry, problem.grid)
    count = problem.geometry.views
    subsets = _subsets(count, min(MOST_SUBSETS, count // VIEWS_OF_SUBSET))
    curvature, beta = curvature_bound(problem, strength)
    threshold = beta / curvature
    backend = kernels.backend_for(torch.device("cpu"), torch.float32)
    volume, dual = fit.volume.clone(), fit.dual.clone()
    ahead, inertia = volume, 1.0
    done, settled = 0, False
    best, best_volume = math.inf, volume
    while True:
        before, objective = volume, beta * float(total_variation(volume))
        spent = time.perf_counter() - begun
        settling = seconds is not None and spent > (1 - SETTLING) * seconds
        for number, views in enumerate(subsets):
            index = torch.from_numpy(views)
            integrals = projector.forward(ahead, views)
            objective += float(problem.likelihood.deviance(integrals, index).nansum()) / 2
            slope = problem.likelihood.slope(integrals, index)
            gradient = projector.backward(slope, views) * (count / len(views))
            target = ahead - gradient / curvature
            if strength > 0:
                moved = backend.denoise_total_variation(target, threshold, dual, iterations=DENOISING_STEPS)
            else:
                moved = target.clamp_min(0)
            if settling:
                ahead = moved
            else:
                following = (1 + (1 + 4 * inertia**2) ** 0.5) / 2
                ahead = moved + (inertia - 1) / following * (moved - volume)
                inertia = following
            volume = moved
            part, spent = done + (number + 1) / len(subsets), time.perf_counter() - begun
            fraction = max(part / passes if passes else 0.0, spent / seconds if seconds else 0.0)
            progress(min(1.0, fraction), f"pass {fit.passes + done + 1}")
        done += 1
        if objective < best:
            best, best_volume = objective, before
        elif objective > RISE * best and len(subsets) > 1:
            subsets = _subsets(count, len(subsets) // 2)
            ahead, volume, inertia = best_volume, best_volume, 1.0
        settled = float((volume - before).norm()) <= SETTLED * max(float(volume.norm()), 1e-30)
        spent = time.perf_counter() - begun
        keep(Fit(volume, dual, fit.passes + done, settled))
        over = (passes is not None and done >= passes) or (seconds is not None and spent * (done + 1) / done > seconds)
        if over or (settled and done > 1):
            break
    return Fit(volume, dual, fit.passes + done, settled)


def curvature_bound(problem: Problem, strength: float) -> tuple[Tensor, float]:
    """Return a bound on the curvature of each voxel (Z, Y, X), and beta."""
    projector = Projector(problem.geometry, problem.grid)
    ones = torch.ones(problem.grid.shape)
    bound, diagonal = torch.zeros(problem.grid.shape), torch.zeros(problem.grid.shape)
    for views in _subsets(problem.geometry.views, problem.geometry.views // VIEWS_OF_SUBSET):
        curvature = problem.likelihood.curvature(torch.from_numpy(views))
        bound += projector.backward(curvature * projector.forward(ones, views), views)
        diagonal += projector.backward(curvature, views)
    met = bound > 0
    if not met.any():
        return torch.ones_like(bound), 0.0
    beta = strength * float((diagonal[met].median() * problem.grid.size) ** 0.5)
    return bound.clamp_min(LEAST_CURVATURE * float(bound[met].median())), beta


def _subsets(count: int, number: int) -> list[np.ndarray]:
    """Split views into subsets that each go all around, in an order that keeps successive subsets far apart."""
    number = max(1, number)
    order = sorted(range(number), key=lambda s: int(format(s, "016b")[::-1], 2))
    return [np.arange(s, count, number) for s in order]
