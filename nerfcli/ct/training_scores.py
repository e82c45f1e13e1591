"""Evaluate a reconstruction on held-out projections and the true volume, next to other methods on the same views."""

from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from nerfcli.atomic import read_json, write_json
from nerfcli.ct.baselines import filtered_back_projection, sart_total_variation
from nerfcli.ct.calibrate import air_factors
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.likelihood import Poisson, likelihood_of
from nerfcli.ct.reconstruct import Projector
from nerfcli.ct.result import METRICS, Reconstruction, load_reconstruction
from nerfcli.ct.scan import Scan, load_scan
from nerfcli.ct.scores import score_projections, score_volume
from nerfcli.ct.training import corrected_by
from nerfcli.ct.truth import load_truth
from nerfcli.errors import UserError
from nerfcli.machine import thread_count
from nerfcli.notices import Notify, Progress, no_progress, silent


class ScanEvaluation(NamedTuple):
    """Metrics of a reconstruction: RUN/metrics.json, its content, and whether the file already existed."""

    path: Path
    metrics: dict[str, Any]
    is_kept: bool


def evaluate_scan(
    run: str | Path,
    *,
    threads: int = 0,
    overwrite: bool = False,
    baselines: bool = True,
    reference: str | Path | None = None,
    notify: Notify = silent,
    progress: Progress = no_progress,
) -> ScanEvaluation:
    """Write RUN/metrics.json: errors of held-out projections and, if the scan names its true volume, of the volume.

    Args:
        run: the folder that `train_scan` wrote.
        threads: number of CPU threads; 0 for all.
        baselines: also measure filtered back-projection and SART with total variation on the same views.
        reference: folder of another reconstruction, usually from more views, to compare volumes with. It is not the
            truth: it has errors too, and errors common to both do not show.

    Raises:
        UserError: there is no reconstruction, its scan has changed, or the reference has another unit or is not the one
            of the existing metrics.
    """
    run = Path(run)
    torch.set_num_threads(thread_count(threads))
    result = load_reconstruction(run)
    compared = None if reference is None else _reference_of(Path(reference), result.unit)
    described = None if compared is None else {"run": str(reference), "passes": compared.passes}
    path = run / METRICS
    if path.exists() and not overwrite:
        kept = read_json(path, needed=("methods",), hint="measure again with --overwrite")
        if described not in (None, kept.get("reference")):
            raise UserError(f"{path} was measured without the reference {reference}", "measure again with --overwrite")
        if kept.get("scan_digest") == result.scan_digest and kept.get("passes") == result.passes:
            notify(f"{path} is kept; add --overwrite to measure again")
            return ScanEvaluation(path, kept, True)
    scan = scan_of(result, run)
    geometry = corrected(scan.geometry, result)
    truth = load_truth(scan.history)
    methods: dict[str, Any] = {}

    def measure(name: str, volume: np.ndarray) -> None:
        projections = score_projections(
            scan, geometry, torch.from_numpy(np.array(volume)), result.grid, air=_held_out_air(scan, result)
        )
        methods[name] = {
            "projections": None if projections is None else asdict(projections),
            "volume": None if truth is None else asdict(score_volume(volume, result.grid, truth[1], truth[0])),
            "against_reference": None
            if compared is None
            else asdict(score_volume(volume, result.grid, compared.volume, compared.grid)),
        }

    progress(0.0, "held-out views")
    measure("nerfcli", np.asarray(result.volume))
    if baselines:
        views = scan.training_views
        integrals = scan.line_integrals(views)
        if (factors := result.used.get("air")) is not None:
            integrals = integrals + np.log(np.asarray(factors, dtype=np.float32))[:, None, None]
        progress(0.3, "filtered back-projection")
        try:
            filtered = filtered_back_projection(geometry.select(views), integrals, result.grid)
            measure("filtered back-projection", filtered.clamp_min(0).numpy())
        except UserError as error:
            notify(f"no filtered back-projection: {error.message}")
        progress(0.5, "SART with total variation")
        measure(
            "SART with total variation", sart_total_variation(geometry.select(views), integrals, result.grid).numpy()
        )
    metrics = {
        "measurement": "transmission",
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


def scan_of(result: Reconstruction, run: Path) -> Scan:
    """Load the scan of a reconstruction.

    Raises:
        UserError: the scan no longer exists, or has changed.
    """
    if not result.scan.exists():
        raise UserError(
            f"the scan {result.scan} of {run} does not exist",
            "run the command from the folder that train was run in, or train again",
        )
    scan = load_scan(result.scan)
    if scan.digest != result.scan_digest:
        raise UserError(f"{result.scan} has changed since {run} was trained", "train again with --overwrite")
    return scan


def corrected(geometry: ScanGeometry, result: Reconstruction) -> ScanGeometry:
    """Apply the centre and tilt of a reconstruction to a geometry."""
    return corrected_by(geometry, result.used["centre"], result.used["tilt"])


def _held_out_air(scan: Scan, result: Reconstruction) -> np.ndarray | None:
    """Estimate the factor on the open beam of each held-out view from its pixels beside the object, as in the fit.

    None if the reconstruction did not use such factors.
    """
    if result.used.get("air") is None:
        return None
    views = np.array(scan.held_out, dtype=int)
    likelihood = likelihood_of(scan, views)
    assert isinstance(likelihood, Poisson)
    geometry = corrected(scan.geometry, result).select(views)
    integrals = Projector(geometry, result.grid).forward(
        torch.from_numpy(np.array(result.volume)), np.arange(len(views))
    )
    return air_factors(likelihood, integrals).numpy()
