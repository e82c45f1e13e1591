"""Scores of a reconstruction: held-out projections, and a true volume if there is one."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from skimage.metrics import structural_similarity

from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.likelihood import Poisson, likelihood_of
from nerfcli.ct.reconstruct import Projector
from nerfcli.ct.scan import Scan

# Number of layers along each axis over which SSIM is averaged.
SSIM_LAYERS = 24


@dataclass(frozen=True)
class ProjectionScores:
    """Comparison of held-out views with their predictions.

    Args:
        rms: root mean square difference of line integrals, over all views together.
        psnr: 20 log10(peak / rms) in dB.
        peak: reference line integral of the PSNR: the quantile 1 - 1e-5 of the training views.
        chi_square: mean squared misfit in units of the counting noise: 1 is the best possible; below 1, the fit has
            used held-out measurements.
        chi_square_of_view: the same for each held-out view.
    """

    rms: float
    psnr: float
    peak: float
    chi_square: float
    chi_square_of_view: tuple[float, ...]


@dataclass(frozen=True)
class VolumeScores:
    """Comparison of a volume with the true one, on the voxels of the true one.

    Args:
        psnr: 20 log10(largest true value / rms difference) in dB.
        ssim: mean over layers across all three axes.
        bias: mean difference, in 1 / unit.
    """

    psnr: float
    ssim: float
    bias: float


def score_projections(
    scan: Scan, geometry: ScanGeometry, volume: torch.Tensor, grid: VoxelGrid, *, air: np.ndarray | None = None
) -> ProjectionScores | None:
    """Compare the projections of a volume with the held-out views; return None if no view is held out.

    Args:
        geometry: corrected geometry of all its views.
        air: factor on the open beam of each held-out view; 1 if not given.
    """
    views = np.array(scan.held_out, dtype=int)
    if len(views) == 0:
        return None
    every = np.arange(len(views))
    predicted = Projector(geometry.select(views), grid).forward(volume, every)
    likelihood = likelihood_of(scan, views)
    measured = scan.line_integrals(views).reshape(len(views), -1)
    if air is not None:
        assert isinstance(likelihood, Poisson)
        likelihood = likelihood.scaled(torch.from_numpy(air.astype(np.float32)))
        measured = measured + np.log(air)[:, None].astype(np.float32)
    deviance = likelihood.deviance(predicted, torch.from_numpy(every)).numpy()
    usable = np.isfinite(deviance) & np.isfinite(measured)
    rms = float(np.sqrt(np.mean((predicted.numpy() - measured)[usable] ** 2)))
    peak = float(np.nanquantile(scan.line_integrals(scan.training_views), 1 - 1e-5))
    return ProjectionScores(
        rms,
        float(20 * np.log10(peak / max(rms, 1e-30))),
        peak,
        float(np.mean(deviance[usable])),
        tuple(float(np.nanmean(row)) for row in deviance),
    )


def score_volume(volume: np.ndarray, grid: VoxelGrid, true: np.ndarray, true_grid: VoxelGrid) -> VolumeScores:
    """Compare a volume, interpolated at the voxel centres of the true one, with the true one; 0 outside its grid."""
    seen = volume if grid == true_grid else resampled(volume, grid, true_grid)
    difference = seen.astype(np.float64) - true
    peak = float(true.max())
    values = [
        structural_similarity(np.take(seen, k, axis), np.take(true, k, axis), data_range=peak)
        for axis in range(3)
        if min(np.take(true, 0, axis).shape) >= 7
        for k in np.unique(np.linspace(0, true.shape[axis] - 1, SSIM_LAYERS).astype(int))
    ]
    psnr = 20 * np.log10(peak / max(float(np.sqrt(np.mean(difference**2))), 1e-30))
    return VolumeScores(float(psnr), float(np.mean(values)) if values else float("nan"), float(difference.mean()))


def resampled(volume: np.ndarray, grid: VoxelGrid, other: VoxelGrid) -> np.ndarray:
    """Return a volume at the voxel centres of another grid, by trilinear interpolation; 0 outside."""
    place = [(other.axis(name) - grid.first["xyz".index(name)]) / grid.size for name in "zyx"]
    coordinates = np.meshgrid(*place, indexing="ij")
    return map_coordinates(volume, coordinates, order=1, mode="constant", cval=0.0, prefilter=False)
