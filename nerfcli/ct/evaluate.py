"""Evaluate a reconstruction on held-out projections and the true volume, next to filtered back-projection."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from skimage.metrics import structural_similarity
from torch import Tensor
from torch.nn.functional import grid_sample

from nerfcli.atomic import read_json, refuse_read_only, write_json
from nerfcli.ct.calibrate import air_factors
from nerfcli.ct.geometry import CIRCULAR, ScanGeometry
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.likelihood import Poisson, likelihood_of
from nerfcli.ct.recognise import MEASUREMENT
from nerfcli.ct.reconstruct import Projector
from nerfcli.ct.result import METRICS, Reconstruction, load_reconstruction, scan_of
from nerfcli.ct.scan import Scan, load_truth
from nerfcli.errors import UserError
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output

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
        chi_square_of_view: the same for each held-out view; None for views without usable pixels.
    """

    rms: float
    psnr: float
    peak: float
    chi_square: float
    chi_square_of_view: tuple[float | None, ...]


@dataclass(frozen=True)
class VolumeScores:
    """Comparison of a volume with the true one, on the voxels of the true one.

    Args:
        psnr: 20 log10(largest true value / rms difference) in dB.
        ssim: mean over layers across all three axes; None if the layers are too small.
        bias: mean difference, in 1 / unit.
    """

    psnr: float
    ssim: float | None
    bias: float


class ScanEvaluation(NamedTuple):
    """Metrics of a reconstruction: RUN/metrics.json, its content, and whether the file already existed."""

    path: Path
    metrics: dict[str, Any]
    is_kept: bool


def evaluate_scan(
    run: str | Path,
    output: Output = Output(),
    *,
    reference: str | Path | None = None,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> ScanEvaluation:
    """Write RUN/metrics.json: errors of held-out projections and, if the scan names its true volume, of the volume.

    Filtered back-projection of the same views is measured, too.

    Args:
        run: the folder that `train_scan` wrote.
        output: the file to write, RUN/metrics.json by default.
        reference: folder of another reconstruction, usually from more views, to compare volumes with. It is not the
            truth: it has errors too, and errors common to both do not show.

    Raises:
        UserError: there is no reconstruction, its scan has changed, or the reference has another unit or is not the one
            of the existing metrics.
    """
    run = Path(run)
    resources.begin()
    result = load_reconstruction(run)
    compared = None if reference is None else _reference_of(Path(reference), result.unit)
    described = None if compared is None else {"run": str(reference), "passes": compared.passes}
    path = output.at(run / METRICS)
    if path.exists() and not output.overwrite:
        kept = read_json(path, needed=("methods",), hint="measure again with --overwrite")
        if described not in (None, kept.get("reference")):
            raise UserError(f"{path} was measured without the reference {reference}", "measure again with --overwrite")
        if kept.get("scan_digest") == result.scan_digest and kept.get("passes") == result.passes:
            reporter.note(f"{path} is kept; add --overwrite to measure again")
            return ScanEvaluation(path, kept, True)
    refuse_read_only(path)
    scan = scan_of(result, run)
    geometry = scan.geometry.corrected(result.used["centre"], result.used["tilt"])
    volumes = {"nerfcli": np.asarray(result.volume)}
    reporter.progress(0.0, "filtered back-projection")
    try:
        integrals = logarithms(scan, result.used["air"])
        filtered = filtered_back_projection(geometry.select(scan.training_views), integrals, result.grid)
        volumes["filtered back-projection"] = filtered.clamp_min(0).numpy()
    except UserError as error:
        reporter.note(f"no filtered back-projection: {error.message}")
    reporter.progress(0.5, "held-out views")
    others = {
        "volume": load_truth(scan.history),
        "against_reference": None if compared is None else (compared.grid, compared.volume),
    }
    air, methods = held_out_air(scan, geometry, result), {}
    for name, volume in volumes.items():
        projections = score_projections(scan, geometry, torch.from_numpy(np.array(volume)), result.grid, air=air)
        methods[name] = {
            "projections": None if projections is None else asdict(projections),
            **{
                what: None if other is None else asdict(score_volume(volume, result.grid, other[1], other[0]))
                for what, other in others.items()
            },
        }
    metrics = {
        "measurement": MEASUREMENT,
        "scan_digest": result.scan_digest,
        "passes": result.passes,
        "unit": result.unit,
        "held_out_views": len(scan.held_out),
        "fitted_views": len(scan.training_views),
        "missing_wedge_deg": result.missing_wedge_deg,
        "reference": described,
        "methods": methods,
    }
    write_json(path, metrics)
    return ScanEvaluation(path, metrics, False)


def _reference_of(run: Path, unit: str) -> Reconstruction:
    reference = load_reconstruction(run)
    if reference.unit != unit:
        raise UserError(
            f"the reference {run} has lengths in {reference.unit}, expected {unit}", "use a reference of the same scan"
        )
    return reference


def held_out_air(scan: Scan, geometry: ScanGeometry, result: Reconstruction) -> np.ndarray | None:
    """Estimate the factor on the open beam of each held-out view from its pixels beside the object, as in the fit.

    None if the reconstruction did not use such factors, or no view is held out.
    """
    if result.used.get("air") is None or not scan.held_out:
        return None
    views = np.array(scan.held_out, dtype=int)
    likelihood = likelihood_of(scan, views)
    assert isinstance(likelihood, Poisson)
    integrals = Projector(geometry.select(views), result.grid).forward(torch.from_numpy(np.array(result.volume)))
    return air_factors(likelihood, integrals).numpy()


def score_projections(
    scan: Scan, geometry: ScanGeometry, volume: torch.Tensor, grid: VoxelGrid, *, air: np.ndarray | None = None
) -> ProjectionScores | None:
    """Compare the projections of a volume with the held-out views; return None if there are none with usable pixels.

    Args:
        geometry: corrected geometry of all its views.
        air: factor on the open beam of each held-out view; 1 if not given.
    """
    views = np.array(scan.held_out, dtype=int)
    if len(views) == 0:
        return None
    predicted = Projector(geometry.select(views), grid).forward(volume)
    likelihood = likelihood_of(scan, views, air=air)
    measured = scan.line_integrals(views).reshape(len(views), -1)
    if air is not None:
        measured = measured + np.log(air)[:, None].astype(np.float32)
    deviance = likelihood.deviance(predicted, torch.arange(len(views))).numpy()
    usable = np.isfinite(deviance) & np.isfinite(measured)
    if not usable.any():
        return None
    rms = float(np.sqrt(np.mean((predicted.numpy() - measured)[usable] ** 2)))
    peak = float(np.nanquantile(scan.line_integrals(scan.training_views), 1 - 1e-5))
    return ProjectionScores(
        rms,
        float(20 * np.log10(peak / max(rms, 1e-30))),
        peak,
        float(np.mean(deviance[usable])),
        tuple(float(np.nanmean(row)) if np.isfinite(row).any() else None for row in deviance),
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
    return VolumeScores(float(psnr), float(np.mean(values)) if values else None, float(difference.mean()))


def resampled(volume: np.ndarray, grid: VoxelGrid, other: VoxelGrid) -> np.ndarray:
    """Return a volume at the voxel centres of another grid, by trilinear interpolation; 0 outside."""
    place = [(other.axis(name) - grid.first["xyz".index(name)]) / grid.size for name in "zyx"]
    coordinates = np.meshgrid(*place, indexing="ij")
    return map_coordinates(volume, coordinates, order=1, mode="constant", cval=0.0, prefilter=False)


def logarithms(scan: Scan, air: Sequence[float] | None) -> np.ndarray:
    """Return line integrals (V, rows, columns) of the training views, with the open beam of each view corrected.

    Rows without a usable pixel are those of the nearest row with one.
    """
    views = scan.training_views
    integrals, usable = scan.line_integrals(views), scan.of_views("usable", views)
    if usable is not None:
        rows = np.arange(scan.geometry.rows)
        for picture, is_live in zip(integrals, np.broadcast_to(usable.any(axis=2), integrals.shape[:2]), strict=True):
            if not is_live.all():
                live = rows[is_live]
                picture[:] = picture[live[np.abs(live - rows[:, None]).argmin(1)]]
    return integrals if air is None else integrals + np.log(np.asarray(air, dtype=np.float32))[:, None, None]


def filtered_back_projection(geometry: ScanGeometry, integrals: np.ndarray, grid: VoxelGrid) -> Tensor:
    """Reconstruct by Feldkamp's algorithm (parallel beams: filtered back-projection), ramp filter, not clipped.

    Args:
        geometry: views at equal steps, over a full turn, or half a turn for parallel beams.
        integrals: (V, rows, columns) line integrals.

    Returns:
        (Z, Y, X) attenuation in 1 / unit.

    Raises:
        UserError: the scan is not a circle around z.

    Source: Feldkamp, Davis and Kress 1984, Practical cone-beam algorithm, JOSA A 1(6), equation 28.
    """
    height, width = geometry.pixel_at_origin
    outward = -geometry.emitter if geometry.beam == "parallel" else geometry.emitter
    radius = float(np.median(np.linalg.norm(outward, axis=1)))
    down = geometry.row_step / np.linalg.norm(geometry.row_step, axis=1, keepdims=True)
    if not geometry.is_circular or np.abs(down[:, :2]).max() >= CIRCULAR:
        raise UserError(
            "filtered back-projection needs a source on a circle around z and an upright detector",
            "use it for scans on a circle",
        )
    columns = np.arange(geometry.columns) - (geometry.columns - 1) / 2
    rows = np.arange(geometry.rows) - (geometry.rows - 1) / 2
    # Coordinates on a detector through the axis.
    along, down = columns * width, rows * height
    weighted = np.asarray(integrals, dtype=np.float64)
    if geometry.beam == "cone":
        weighted = weighted * (radius / np.sqrt(radius**2 + along[None, None] ** 2 + down[None, :, None] ** 2))
    filtered = torch.from_numpy(_ramp(weighted, width).astype(np.float32))

    z, y, x = (torch.from_numpy(grid.axis(name)) for name in "zyx")
    volume = torch.zeros(grid.shape)
    for view in range(geometry.views):
        direction = outward[view] / radius
        if geometry.beam == "cone":
            depth = 1 - (x * direction[0] + y[:, None] * direction[1]) / radius  # (Y, X), 1 on the axis
        else:
            depth = torch.ones(len(y), len(x), dtype=torch.float64)
        right, centre = geometry.column_step[view], geometry.centre[view]
        right = right / np.linalg.norm(right)
        across = (x * right[0] + y[:, None] * right[1]) / depth
        offset = float(centre @ right) / float(geometry.magnification[view])
        column = (across - offset) / width  # from the middle, in pixels
        lift = float(centre[2]) / float(geometry.magnification[view])
        row = -(z[:, None, None] / depth - lift) / height
        place = torch.stack(
            [
                (column * 2 / max(geometry.columns, 2)).expand(row.shape),
                row * 2 / max(geometry.rows, 2) if geometry.rows > 1 else torch.zeros_like(row),
            ],
            dim=-1,
        )
        picture = filtered[view][None, None]
        seen = grid_sample(
            picture, place.reshape(1, -1, 1, 2).float(), mode="bilinear", padding_mode="zeros", align_corners=False
        )
        volume += seen.view(grid.shape) / depth.square().float()
    return volume * (np.pi / geometry.views)  # over a full turn, each line is measured from both of its ends


def _ramp(projections: np.ndarray, width: float) -> np.ndarray:
    """Filter projections along their rows by the ramp, sampled in space (Kak and Slaney 1988, equation 3.61)."""
    count = projections.shape[-1]
    length = 1 << int(np.ceil(np.log2(2 * count)))
    place = np.arange(length) - length // 2
    kernel = np.zeros(length)
    kernel[place == 0] = 1 / (4 * width**2)
    odd = place % 2 != 0
    kernel[odd] = -1 / (np.pi * place[odd] * width) ** 2
    response = np.fft.rfft(np.fft.ifftshift(kernel))
    return np.fft.irfft(np.fft.rfft(projections, length) * response, length)[..., :count] * width
