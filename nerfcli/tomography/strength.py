"""How much total variation a scan needs: chosen on training views that a trial does not fit.

Predicting noisy projections rewards fitting their noise for too long: at the best prediction, the volume is already
past its best. So of all weights that predict about equally well, the largest is taken.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from nerfcli.tomography.geometry import ScanGeometry
from nerfcli.tomography.grid import VoxelGrid, layers_of_rays
from nerfcli.tomography.likelihood import likelihood_of
from nerfcli.tomography.reconstruct import Problem, Projector, reconstruct, start
from nerfcli.tomography.scan import Scan

STRENGTHS = (0.03, 0.1, 0.3, 1.0, 3.0)
# Every how many training views one is left out of the trial.
LEFT_OUT_EVERY = 5
TRIAL_PASSES = 12
# Rows of the detector that a trial looks at. Pixels and voxels keep their size: larger ones are wrong by more than noise,
# and ask for another weight.
TRIAL_ROWS = 12


@dataclass(frozen=True)
class StrengthTrial:
    """Trials of total variation.

    Args:
        strength: the one that was chosen.
        tried: strengths and, for each, the mean deviance per pixel of views that were not fitted; 1 is noise alone.
        error: standard error over views of the difference between the chosen and the best one.
    """

    strength: float
    tried: tuple[tuple[float, float], ...]
    error: float


def choose_strength(
    scan: Scan,
    geometry: ScanGeometry,
    grid: VoxelGrid,
    *,
    most_seconds: float,
    progress: Callable[[float, str], None] | None = None,
) -> StrengthTrial:
    """Try strengths on the middle rows of the detector, and take the largest that predicts as well as the best.

    Args:
        scan: of whose training views every fifth is predicted.
        geometry: of all views, corrected.
        grid: of the reconstruction.
        most_seconds: for all trials together; the first two are always done.
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
    deviances, fit = [], start(problem)
    for number, strength in enumerate(STRENGTHS):
        if number > 1 and fit.seconds * (number + 1) / number > most_seconds:
            break
        if progress is not None:
            progress(number / len(STRENGTHS), f"total variation {strength:g}")
        fit = reconstruct(problem, fit, strength=strength, passes=TRIAL_PASSES)
        deviance = judge.deviance(projector.forward(fit.volume, every), torch.from_numpy(every))
        deviances.append(np.nanmean(deviance.numpy(), axis=1))
    means = [float(np.mean(d)) for d in deviances]
    best = int(np.argmin(means))
    chosen, error = best, 0.0
    for number in range(best + 1, len(means)):
        worse = deviances[number] - deviances[best]
        spread = float(np.std(worse, ddof=1) / np.sqrt(len(worse))) if len(worse) > 1 else 0.0
        if float(np.mean(worse)) <= spread:
            chosen, error = number, spread
    return StrengthTrial(STRENGTHS[chosen], tuple(zip(STRENGTHS, means, strict=False)), error)
