"""Choice of the total variation weight and the model error, by training views that a trial leaves out.

Predicting noisy projections rewards fitting their noise and the model's own errors for too long: where the prediction
is best, the volume has been past its best by 1 to 4 dB on phantoms. The scale of `strength` already takes dose, unit
and model error out of it, so that 1 is right for most scans; another value is taken only where it predicts far better.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from nerfcli.tomography.geometry import ScanGeometry
from nerfcli.tomography.grid import VoxelGrid, layers_of_rays
from nerfcli.tomography.likelihood import Poisson, likelihood_of
from nerfcli.tomography.reconstruct import Problem, Projector, reconstruct, start
from nerfcli.tomography.scan import Scan

# The usual one first, then those that may be better, in the order in which they are tried.
STRENGTHS = (1.0, 0.3, 3.0, 0.1, 10.0)
# By how much another strength has to lower the deviance of views that were not fitted.
FAR_BETTER = 0.25
# Every how many training views one is left out of the trial.
LEFT_OUT_EVERY = 5
TRIAL_PASSES = 10
# Rows of the detector that a trial looks at. Pixels and voxels keep their size: larger ones are wrong by more than
# noise, and ask for another weight.
TRIAL_ROWS = 12


@dataclass(frozen=True)
class StrengthTrial:
    """Trials of total variation.

    Args:
        strength: the one that was chosen.
        tried: strengths and, for each, the mean deviance per pixel of views that were not fitted; 1 is noise alone.
        model_error: see `Poisson`, as the views that were not fitted show it; 0 for line integrals.
    """

    strength: float
    tried: tuple[tuple[float, float], ...]
    model_error: float


def choose_strength(
    scan: Scan,
    geometry: ScanGeometry,
    grid: VoxelGrid,
    *,
    most_seconds: float | None,
    progress: Callable[[float, str], None] | None = None,
) -> StrengthTrial:
    """Try strengths on the middle rows of the detector, and take the usual one unless another predicts far better.

    Args:
        scan: of whose training views every fifth is predicted.
        geometry: of all views, corrected.
        grid: of the reconstruction.
        most_seconds: for all trials together, of which each gets a quarter at most; None tries the usual strength
            alone, so that the result does not depend on the machine.
        progress: takes the share done and a few words.
    """
    views = scan.training_views
    left = views[2::LEFT_OUT_EVERY]
    fitted = np.setdiff1d(views, left)
    first = max((geometry.rows - TRIAL_ROWS) // 2, 0)
    part = replace(scan, geometry=geometry).only_rows(first, min(first + TRIAL_ROWS, geometry.rows))
    layers = layers_of_rays(grid, part.geometry)
    problem = Problem(part.geometry.select(fitted), likelihood_of(part, fitted), layers)
    projector, judge = Projector(part.geometry.select(left), layers), likelihood_of(part, left)
    every = np.arange(len(left))
    error = 0.0
    quarter = None if most_seconds is None else most_seconds / 4
    fit = start(problem)
    if isinstance(judge, Poisson) and isinstance(problem.likelihood, Poisson):
        fit = reconstruct(problem, fit, strength=STRENGTHS[0], passes=TRIAL_PASSES, seconds=quarter)
        error = judge.found_model_error(projector.forward(fit.volume, every), torch.from_numpy(every))
        judge = judge.with_model_error(error)
        problem = replace(problem, likelihood=problem.likelihood.with_model_error(error))
    deviances = []
    for number, strength in enumerate(STRENGTHS if most_seconds is not None else STRENGTHS[:1]):
        if number > 0 and most_seconds is not None and fit.seconds * (number + 2) / (number + 1) > most_seconds:
            break
        if progress is not None:
            progress(number / len(STRENGTHS), f"total variation {strength:g}")
        fit = reconstruct(problem, fit, strength=strength, passes=TRIAL_PASSES, seconds=quarter)
        deviance = judge.deviance(projector.forward(fit.volume, every), torch.from_numpy(every))
        deviances.append(np.nanmean(deviance.numpy(), axis=1))
    means = [float(np.mean(d)) for d in deviances]
    best = int(np.argmin(means))
    chosen = best if means[best] < (1 - FAR_BETTER) * means[0] else 0
    return StrengthTrial(STRENGTHS[chosen], tuple(zip(STRENGTHS, means, strict=False)), error)
