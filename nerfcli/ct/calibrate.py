"""Estimates from a scan's own measurements: the detector's tilt, the brightness of each view, noise and model error.

The tilt is judged by prediction: a volume fitted to every second view has to explain the others. See `centre` for the
centre of rotation.
"""

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize_scalar

from nerfcli.ct.centre import SIGNIFICANT
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.grid import VoxelGrid, grid_of_scan, layers_of_rays
from nerfcli.ct.likelihood import Poisson, likelihood_of, with_noise
from nerfcli.ct.reconstruct import Problem, Projector, reconstruct, start
from nerfcli.ct.scan import Scan

# Passes of the trial reconstructions, and the weight of their total variation.
TRIAL_PASSES = 6
TRIAL_STRENGTH = 0.3
# A trial uses fewer than twice this many views.
TRIAL_VIEWS = 120
TILT_RANGE = np.deg2rad(2.0)
# Largest number of trials that its estimate takes.
MOST_TILTS = 16
# Weight, in photons of air, of the prior that a view's open beam is that of the scan: it drifts by about 1 %.
PRIOR_PHOTONS = 1e4
# The largest line integral of a ray beside the object.
MOST_IN_AIR = 0.01
# The trial for the model error predicts one in this many training views, after this many passes over the others, with
# this many middle rows of the detector. Pixels and voxels keep their size: larger ones have larger errors.
LEFT_OUT_EVERY, MODEL_ERROR_PASSES, MODEL_ERROR_ROWS = 5, 10, 12
# The noise is assumed too high if the mean deviance of these views is below this; it is corrected in so many trials.
TOO_NOISY, NOISE_TRIALS = 0.7, 4


@dataclass(frozen=True)
class Correction:
    """A correction of one parameter of the geometry.

    Args:
        value: the correction, in pixels or radians.
        gain: mean decrease of the deviance per pixel of the views that were not fitted, compared with the value 0.
        error: standard error of the gain, over views.
    """

    value: float
    gain: float
    error: float

    @property
    def holds(self) -> bool:
        """True if the correction predicts the views that were not fitted significantly better."""
        return self.gain > SIGNIFICANT * self.error


def detector_tilt(scan: Scan, *, seconds: float | None = None) -> Correction:
    """Estimate the rotation of the detector in its plane, see `ScanGeometry.tilted`.

    Args:
        seconds: time limit; None for no limit.

    Returns:
        The rotation; 0 for fewer than 8 rows, and 0 with an infinite error where the time is too short.
    """
    if scan.geometry.rows < 8:
        return Correction(0.0, 0.0, 0.0)
    binning = max(1, scan.geometry.columns // 64)

    def misfit(angle: float) -> np.ndarray:
        return _prediction(scan, scan.geometry.tilted(angle), binning=binning)

    def mean(angle: float) -> float:
        return float(np.nanmean(misfit(float(angle))))

    stated = misfit(0.0)
    grid = np.linspace(-TILT_RANGE, TILT_RANGE, 5)
    begun = time.perf_counter()  # the trial before may have loaded kernels
    first = mean(grid[0])
    if seconds is not None and MOST_TILTS * (time.perf_counter() - begun) > seconds:
        return Correction(0.0, 0.0, math.inf)
    # On a grid over the whole range, then between the neighbours of the best value.
    best = int(np.argmin([first, mean(grid[1]), float(np.nanmean(stated)), mean(grid[3]), mean(grid[4])]))
    between = (float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)]))
    precise = float(np.deg2rad(0.02))
    value = float(minimize_scalar(mean, bounds=between, method="bounded", options={"xatol": precise}).x)
    better = stated - misfit(value)
    error = float(np.nanstd(better) / np.sqrt(max(np.isfinite(better).sum(), 1)))
    return Correction(value, float(np.nanmean(better)), error)


def beside_object(likelihood: Poisson, integrals: torch.Tensor) -> torch.Tensor:
    """Return the mask (views, pixels) of the pixels whose rays pass beside the object, from their line integrals."""
    return (integrals < MOST_IN_AIR) & (likelihood.open_beam > 0)


def air_factors(likelihood: Poisson, integrals: torch.Tensor) -> torch.Tensor:
    """Estimate the brightness of each view relative to the open beam, from pixels beside the object.

    Formula: sum of counts over sum of expected counts, for pixels beside the object, with `PRIOR_PHOTONS` added to
    both. Views without such pixels get 1.

    Args:
        likelihood: counts, open beam and background, (views, pixels).
        integrals: (views, pixels) line integrals of a first reconstruction.
    """
    air = beside_object(likelihood, integrals)
    expected = torch.where(air, likelihood.open_beam * torch.exp(-integrals) + likelihood.background, 0).double().sum(1)
    counted = torch.where(air, likelihood.counts, 0).double().sum(1)
    return ((counted + PRIOR_PHOTONS) / (expected + PRIOR_PHOTONS)).float()


def found_noise(scan: Scan, geometry: ScanGeometry, grid: VoxelGrid, *, seconds: float | None) -> tuple[float, float]:
    """Judge the assumed noise, and estimate the model error of line integrals, by views that a trial does not fit.

    The noise is too high if these views are predicted better than it allows. Too much noise means too much smoothing,
    so that after a correction, the trial is repeated.

    Args:
        scan: the scan, with its noise; every fifth of its training views is predicted.
        geometry: corrected geometry of all views.
        seconds: time limit; None for no limit, so that the result does not depend on the machine.

    Returns:
        The factor by which the standard deviation of the noise is too high, 1 if it is not; and the model error, see
        `Poisson`, 0 for measured line integrals, whose noise is estimated as a whole.
    """
    views = scan.training_views
    left = views[2::LEFT_OUT_EVERY]
    fitted, every = np.setdiff1d(views, left), torch.arange(len(left))
    first = max((geometry.rows - MODEL_ERROR_ROWS) // 2, 0)
    part = replace(scan, geometry=geometry).only_rows(first, min(first + MODEL_ERROR_ROWS, geometry.rows))
    layers, lower, fit = layers_of_rays(grid, part.geometry), 1.0, None
    projector = Projector(part.geometry.select(left), layers)
    for last in [*[False] * (NOISE_TRIALS - 1), True]:
        assumed = with_noise(part, lower=lower)
        problem = Problem(part.geometry.select(fitted), likelihood_of(assumed, fitted), layers)
        limit = None if seconds is None else seconds / NOISE_TRIALS
        fit = reconstruct(problem, fit or start(problem), strength=1.0, passes=MODEL_ERROR_PASSES, seconds=limit)
        judge, integrals = likelihood_of(assumed, left), projector.forward(fit.volume)
        deviance = float(judge.deviance(integrals, every).nanmean())
        if last or not deviance < TOO_NOISY:
            break
        lower /= max(deviance, 1e-12) ** 0.5
    return lower, judge.found_model_error(integrals, every) if isinstance(judge, Poisson) else 0.0


def _prediction(scan: Scan, geometry: ScanGeometry, *, binning: int) -> np.ndarray:
    """Return the mean deviance (views,) of every second view, predicted by a volume fitted to the others."""
    views = scan.training_views
    views = views[:: max(1, len(views) // TRIAL_VIEWS)]
    coarse = geometry.binned(binning)
    grid = grid_of_scan(coarse)
    fitted, left = views[::2], views[1::2]
    problem = Problem(coarse.select(fitted), likelihood_of(scan, fitted, binning=binning), grid)
    fit = reconstruct(problem, start(problem), strength=TRIAL_STRENGTH, passes=TRIAL_PASSES)
    predicted = Projector(coarse.select(left), grid).forward(fit.volume)
    deviance = likelihood_of(scan, left, binning=binning).deviance(predicted, torch.arange(len(left)))
    return np.nanmean(deviance.numpy(), axis=1)
