"""Choose the weight of total variation and the model error by predicting training views that a trial leaves out.

Prediction of noisy projections favours fits that follow noise and model errors too far: at the best prediction, volumes
of phantoms were already 1 to 4 dB below their best. The scale of `strength` already accounts for dose, unit and model
error, so that 1 is right for most scans; another value is taken only where it predicts far better.
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

# Strengths in the order in which they are tried: the default first, then the alternatives.
STRENGTHS = (1.0, 0.3, 3.0, 0.1, 10.0)
# Fraction by which another strength has to lower the deviance of views that were not fitted.
FAR_BETTER = 0.25
# One in this many training views is left out of the trial.
LEFT_OUT_EVERY = 5
TRIAL_PASSES = 10
# Number of detector rows that a trial uses. Pixels and voxels keep their size: larger ones have errors beyond the
# noise, and need another weight.
TRIAL_ROWS = 12


@dataclass(frozen=True)
class StrengthTrial:
    """Result of trials of total variation.

    Args:
        tried: strengths and, for each, the mean deviance per pixel of views that were not fitted; 1 is noise alone.
        model_error: see `Poisson`; estimated from the views that were not fitted, 0 for line integrals.
    """

    strength: float
    tried: tuple[tuple[float, float], ...]
    model_error: float


def choose_strength(
    scan: Scan,
    geometry: ScanGeometry,
    grid: VoxelGrid,
    *,
    max_seconds: float | None,
    progress: Callable[[float, str], None] | None = None,
) -> StrengthTrial:
    """Try strengths on the middle rows of the detector, and take the default unless another predicts far better.

    Args:
        scan: the scan; every fifth of its training views is predicted.
        geometry: corrected geometry of all views.
        max_seconds: time limit for all trials together, each of which gets at most a quarter; None tries the default
            strength alone, so that the result does not depend on the machine.
        progress: called with the fraction done and a short text.
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
    quarter = None if max_seconds is None else max_seconds / 4
    fit = start(problem)
    if isinstance(judge, Poisson) and isinstance(problem.likelihood, Poisson):
        fit = reconstruct(problem, fit, strength=STRENGTHS[0], passes=TRIAL_PASSES, seconds=quarter)
        error = judge.found_model_error(projector.forward(fit.volume, every), torch.from_numpy(every))
        judge = judge.with_model_error(error)
        problem = replace(problem, likelihood=problem.likelihood.with_model_error(error))
    deviances = []
    for number, strength in enumerate(STRENGTHS if max_seconds is not None else STRENGTHS[:1]):
        if number > 0 and max_seconds is not None and fit.seconds * (number + 2) / (number + 1) > max_seconds:
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
