"""Estimates from a scan's own measurements: the detector's tilt, the brightness of each view, and the model error.

The tilt is judged by prediction: a volume fitted to every second view has to explain the others. See `centre` for the
centre of rotation.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize_scalar

from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.grid import VoxelGrid, grid_of_scan, layers_of_rays
from nerfcli.ct.likelihood import Poisson, likelihood_of
from nerfcli.ct.reconstruct import Problem, Projector, reconstruct, start
from nerfcli.ct.scan import Scan

# Passes of the trial reconstructions, and the weight of their total variation.
TRIAL_PASSES = 6
TRIAL_STRENGTH = 0.3
# A trial uses fewer than twice this many views.
TRIAL_VIEWS = 120
TILT_RANGE = np.deg2rad(2.0)
# A correction is taken if it improves the prediction of views that were not fitted by this many standard errors.
SIGNIFICANT = 3.0
# Weight, in photons of air, of the prior that a view's open beam is that of the scan: it drifts by about 1 %.
PRIOR_PHOTONS = 1e4
# The largest line integral of a ray beside the object.
MOST_IN_AIR = 0.01
# The trial for the model error predicts one in this many training views, after this many passes over the others, with
# this many middle rows of the detector. Pixels and voxels keep their size: larger ones have larger errors.
LEFT_OUT_EVERY, MODEL_ERROR_PASSES, MODEL_ERROR_ROWS = 5, 10, 12


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


def detector_tilt(scan: Scan) -> Correction:
    """Estimate the rotation of the detector in its plane, see `ScanGeometry.tilted`; 0 for fewer than 8 rows."""
    if scan.geometry.rows < 8:
        return Correction(0.0, 0.0, 0.0)
    binning = max(1, scan.geometry.columns // 64)

    def misfit(angle: float) -> np.ndarray:
        return _prediction(scan, scan.geometry.tilted(angle), binning=binning)

    def mean(angle: float) -> float:
        return float(np.nanmean(misfit(float(angle))))

    # On a grid over the whole range, then between the neighbours of the best value.
    grid = np.linspace(-TILT_RANGE, TILT_RANGE, 5)
    best = int(np.argmin([mean(value) for value in grid]))
    between = (float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)]))
    precise = float(np.deg2rad(0.02))
    value = float(minimize_scalar(mean, bounds=between, method="bounded", options={"xatol": precise}).x)
    better = misfit(0.0) - misfit(value)
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


def model_error(scan: Scan, geometry: ScanGeometry, grid: VoxelGrid, *, seconds: float | None) -> float:
    """Estimate the model error of line integrals, see `Poisson`, from views that a trial does not fit.

    Args:
        scan: the scan; every fifth of its training views is predicted.
        geometry: corrected geometry of all views.
        seconds: time limit; None for no limit, so that the result does not depend on the machine.

    Returns:
        The error; 0 for measured line integrals, whose noise is estimated as a whole.
    """
    views = scan.training_views
    left = views[2::LEFT_OUT_EVERY]
    first = max((geometry.rows - MODEL_ERROR_ROWS) // 2, 0)
    part = replace(scan, geometry=geometry).only_rows(first, min(first + MODEL_ERROR_ROWS, geometry.rows))
    judge = likelihood_of(part, left)
    if not isinstance(judge, Poisson):
        return 0.0
    fitted, layers = np.setdiff1d(views, left), layers_of_rays(grid, part.geometry)
    problem = Problem(part.geometry.select(fitted), likelihood_of(part, fitted), layers)
    fit = reconstruct(problem, start(problem), strength=1.0, passes=MODEL_ERROR_PASSES, seconds=seconds)
    every = np.arange(len(left))
    integrals = Projector(part.geometry.select(left), layers).forward(fit.volume, every)
    return judge.found_model_error(integrals, torch.from_numpy(every))


def _prediction(scan: Scan, geometry: ScanGeometry, *, binning: int) -> np.ndarray:
    """Return the mean deviance (views,) of every second view, predicted by a volume fitted to the others."""
    views = scan.training_views
    views = views[:: max(1, len(views) // TRIAL_VIEWS)]
    coarse = geometry.binned(binning)
    grid = grid_of_scan(coarse)
    fitted, left = views[::2], views[1::2]
    problem = Problem(coarse.select(fitted), likelihood_of(scan, fitted, binning=binning), grid)
    fit = reconstruct(problem, start(problem), strength=TRIAL_STRENGTH, passes=TRIAL_PASSES)
    projector = Projector(coarse.select(left), grid)
    every = np.arange(len(left))
    deviance = likelihood_of(scan, left, binning=binning).deviance(
        projector.forward(fit.volume, every), torch.from_numpy(every)
    )
    return np.nanmean(deviance.numpy(), axis=1)
