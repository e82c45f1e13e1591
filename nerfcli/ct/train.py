"""Reconstruct a scan: correct its geometry, choose weights, fit a volume."""

import math
import platform
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerfcli import __version__
from nerfcli.atomic import clear_leftovers, exclusive
from nerfcli.ct.calibrate import air_factors, beside_object, detector_tilt, found_noise
from nerfcli.ct.centre import FEWEST_VIEWS, centre_of, highest_contrast_row
from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.grid import TRUNCATED, UNSEEN, VoxelGrid, grid_of_scan, marks, marks_in_words, missing_wedge_deg
from nerfcli.ct.likelihood import Poisson, likelihood_of, with_noise
from nerfcli.ct.recognise import is_reconstruction
from nerfcli.ct.reconstruct import Fit, Problem, Projector, finer, reconstruct, start
from nerfcli.ct.result import (
    LOCK,
    METRICS,
    Reconstruction,
    ReconstructionSettings,
    load_reconstruction,
    save_reconstruction,
)
from nerfcli.ct.scan import Scan, load_scan
from nerfcli.errors import OUT_OF_MEMORY, UserError, duration, listed, several
from nerfcli.interrupts import deferred_interrupts
from nerfcli.machine import default_memory_limit, thread_count, use_threads
from nerfcli.notices import Progress, Reporter
from nerfcli.output import Output

# Largest fraction of the time budget for estimates before the fit, and of the time left for the coarse start.
CHOICE_FRACTION, COARSE_FRACTION = 0.25, 0.1
# Minimum fraction of the budget for the fit, even if the trials before it took longer than planned.
LEAST_FRACTION = 0.25
COARSE_PASSES = 6
# Maximum number of passes of a fit that is limited only by time.
MOST_PASSES = 200
# Fewest views to fit: of fewer, none could be left out to judge the noise.
LEAST_VIEWS = 3
# Memory of a fit per voxel: volume, momentum, gradient, curvature, threshold, best volume and three duals, with copies.
BYTES_OF_VOXEL = 52
# The open beam drifts if its standard deviation between views exceeds this many standard errors.
DRIFT = 3.0
# Options of `nerfcli ct train` by setting: what --resume may not change, and the totals that it may.
_FIXED = {"voxel_size": "--voxel-size", "strength": "--tv", "centre": "--centre", "tilt": "--tilt", "air": "--air"}
_TOTALS = {"budget_seconds": "--budget", "passes": "--passes"}


def train_scan(
    scan: str | Path,
    output: Output,
    settings: ReconstructionSettings,
    *,
    resume: bool = False,
    reporter: Reporter = Reporter(),
) -> Reconstruction:
    """Fit a volume to a scan, keep an existing one with the same settings, or refuse to touch another one.

    Args:
        scan: a folder that `nerfcli ct convert` wrote.
        output: the folder to write, SCAN-run by default.
        settings: budget, and values that are not to be estimated from the scan.
        resume: continue from the volume in the folder, with its own settings but for totals, where those given are
            defaults or the same; start from the beginning if there is none.

    Raises:
        UserError: the scan cannot be read, or the folder holds something else, or an interrupted fit without `resume`.
        KeyboardInterrupt: passed on; the volume fitted so far has been written.
    """
    folder = Path(scan)
    run = output.beside(folder, "-run")
    loaded = load_scan(folder)
    if len(loaded.training_views) < LEAST_VIEWS:
        views = several(len(loaded.training_views), "view")
        raise UserError(
            f"{folder} has {views} with usable pixels that are not held out, expected {LEAST_VIEWS}",
            "convert it again, with fewer views held out"
            if len(loaded.live_views) >= LEAST_VIEWS
            else "a reconstruction needs more views of the object",
        )
    if settings.centre is not None and abs(settings.centre) > loaded.geometry.columns:
        raise UserError(
            f"--centre {-settings.centre:g} is outside the {loaded.geometry.columns} columns",
            "give the columns from where the scan says that the axis is to where it is",
        )
    earlier = load_reconstruction(run) if is_reconstruction(run) and not output.overwrite else None
    if earlier is not None:
        if resume:  # with its own settings; a default counts as not given
            given, usual = vars(settings), vars(ReconstructionSettings(passes=1))
            own = {name: vars(earlier.settings)[name] for name in _FIXED if given[name] == usual[name]}
            settings = replace(settings, **own)
        if reason := _reason_to_keep(run, earlier, loaded.digest, settings, resume=resume):
            again = "give a larger --budget or --passes" if resume else "add --overwrite to fit again"
            reporter.note(f"{run} is kept: {reason}; {again}")
            return earlier
    elif _holds_something(run) and not (output.overwrite and is_reconstruction(run)):
        raise UserError(f"{run} exists and is not a reconstruction", "choose another folder with --output")
    with exclusive(run / LOCK, f"nerfcli ct train is writing {run}"):
        clear_leftovers(run)
        if loaded.kind != "line_integral" and loaded.photons_per_value is None:
            reporter.warn("photons per detector value not given: estimated from the noise of neighbouring pixels")
        threads = thread_count(settings.threads)
        use_threads(threads)
        result = _fit(loaded, folder, run, settings, earlier, reporter)
    for sentence in result.decisions:
        reporter.note(sentence)
    return result


def _holds_something(run: Path) -> bool:
    """Return whether a folder has more than the hidden files that an interrupted reconstruction leaves."""
    return run.is_dir() and any(not path.name.startswith(".") for path in run.iterdir())


def _reason_to_keep(
    run: Path, earlier: Reconstruction, scan_digest: str, settings: ReconstructionSettings, *, resume: bool
) -> str:
    """Return why an earlier reconstruction is kept as it is; "" if it is to be continued."""
    made, given = asdict(earlier.settings), asdict(settings)
    changed = [] if earlier.scan_digest == scan_digest else ["the scan"]
    changed += [
        option for name, option in (_FIXED if resume else _FIXED | _TOTALS).items() if made[name] != given[name]
    ]
    if changed:
        raise UserError(
            f"{run} holds another reconstruction; it differs in {listed(changed)}",
            "give the same settings, choose another folder with --output, or add --overwrite",
        )
    if not (earlier.complete or resume):
        raise UserError(
            f"{run} holds a fit that was interrupted after pass {earlier.passes}",
            "add --resume to continue, or --overwrite to replace it",
        )
    if earlier.complete and all(made[name] == given[name] for name in _TOTALS):
        return "it is complete and has these settings"
    budget = settings.budget_seconds if earlier.complete else None  # an interrupted fit may have exceeded its own
    if earlier.passes >= (settings.passes or math.inf) or earlier.seconds >= (budget or math.inf):
        return f"it has {several(earlier.passes, 'pass', 'passes')} in {duration(earlier.seconds)} already"
    return ""


def _fit(
    scan: Scan,
    folder: Path,
    run: Path,
    settings: ReconstructionSettings,
    earlier: Reconstruction | None,
    reporter: Reporter,
) -> Reconstruction:
    """Fit the volume and save it; an interrupt of the fit or the save is passed on when the volume is saved."""
    begun = time.perf_counter() - (0.0 if earlier is None else earlier.seconds)
    digest, decisions = scan.digest, [] if earlier is None else list(earlier.decisions)
    # Check memory first: correcting the geometry takes seconds, and hardly changes the number of voxels.
    _fits_memory(grid_of_scan(scan.geometry, settings.voxel_size) if earlier is None else earlier.grid)
    used = earlier.used if earlier is not None else _estimates(scan, settings, decisions, reporter.progress)
    geometry = scan.geometry.corrected(float(used["centre"]), float(used["tilt"]))
    grid = earlier.grid if earlier is not None else grid_of_scan(geometry, settings.voxel_size)
    if (lower := float(used.get("noise_lower", 1.0))) > 1:
        scan = with_noise(scan, lower=lower)
    problem = _problem(scan, geometry, grid, used)
    if earlier is not None:
        fit = Fit(torch.from_numpy(np.array(earlier.volume)), torch.zeros(3, *grid.shape), earlier.passes)
    else:
        # The start is interpolated from a fit with voxels and pixels twice as large.
        coarse = _problem(scan, geometry, grid.coarser(2), used, binning=2)
        limit = seconds_left(settings.budget_seconds, begun)
        limit = None if limit is None else COARSE_FRACTION * limit
        strength = used["strength"]
        fit = finer(reconstruct(coarse, start(coarse), strength=strength, passes=COARSE_PASSES, seconds=limit), grid)
    kept, interrupt = deque([fit], maxlen=1), None
    with deferred_interrupts() as interrupts:

        def on_step(fraction: float, words: str) -> None:
            reporter.progress(fraction, words)
            interrupts.raise_if_pending()

        try:
            fit = reconstruct(
                *(problem, fit),
                strength=float(used["strength"]),
                passes=MOST_PASSES if settings.passes is None else settings.passes - fit.passes,
                seconds=seconds_left(settings.budget_seconds, begun),
                progress=on_step,
                keep=kept.append,
            )
        except KeyboardInterrupt as caught:
            fit, interrupt = kept[-1], caught
        found = marks(problem.geometry, grid)
        decisions += [f"{words}; they are marked" for words in marks_in_words(found, (UNSEEN, TRUNCATED))]
        wedge = missing_wedge_deg(problem.geometry)
        if wedge > 0:
            decisions.append(f"missing wedge of {wedge:.0f} degrees: edges along its directions are not determined")
        result = Reconstruction(
            *(fit.volume.numpy(), found, grid, scan.unit, folder, digest, settings, used),
            tuple(dict.fromkeys(decisions)),  # those on marks and the wedge are the same after --resume
            *(fit.passes, time.perf_counter() - begun, fit.settled, wedge),
            {"nerfcli": __version__, "python": platform.python_version(), "torch": version("torch")},
            complete=interrupt is None,
        )
        (run / METRICS).unlink(missing_ok=True)  # they belong to the volume that is replaced
        save_reconstruction(run, result)
        if interrupt is not None:
            reporter.note(
                f"the volume of pass {result.passes} is saved in {run}; to continue, add --resume to the same command"
            )
            raise interrupt
        interrupts.raise_if_pending()
    return result


def _estimates(
    scan: Scan, settings: ReconstructionSettings, decisions: list[str], progress: Progress
) -> dict[str, Any]:
    """Return what is estimated from the scan, or set, before the fit: the `used` of a reconstruction."""
    budget = settings.budget_seconds
    deadline = math.inf if budget is None else time.perf_counter() + CHOICE_FRACTION * budget

    def left() -> float | None:
        return None if deadline == math.inf else max(deadline - time.perf_counter(), 0.0)

    centre = _centre(scan, decisions, progress) if settings.centre is None else settings.centre
    tilt = settings.tilt
    if tilt is None:
        progress(0.0, "detector tilt")
        # At most half of the time for estimates, so that the noise is judged too.
        most = None if (seconds := left()) is None else seconds / 2
        tilt = _tilt(replace(scan, geometry=scan.geometry.shifted(centre)), decisions, most)
    geometry = scan.geometry.corrected(centre, tilt)
    grid = grid_of_scan(geometry, settings.voxel_size)
    progress(0.0, "noise and model error")
    lower, error = found_noise(with_noise(scan), geometry, grid, seconds=left())
    if lower > 1:
        decisions.append(f"noise: lowered by a factor of {lower:.2g}, as views that were left out show")
    if error > 0:
        decisions.append(f"model error: line integrals are uncertain by {error:.2g} beyond photon noise")
    used = {"strength": settings.strength, "noise_lower": lower, "model_error": error, "centre": centre, "tilt": tilt}
    # The open beam is estimated with the noise as stated, as its errors are not those of counting.
    return used | {"air": None if settings.air is False else _air(scan, geometry, grid, settings, decisions, left())}


def _problem(scan: Scan, geometry: ScanGeometry, grid: VoxelGrid, used: Mapping[str, Any], binning: int = 1) -> Problem:
    """Return the fit of the training views, binned, with the estimated model error and open beam."""
    views, error = scan.training_views, float(used.get("model_error", 0.0))
    likelihood = likelihood_of(scan, views, binning=binning, air=used.get("air"), model_error=error)
    return Problem(geometry.binned(binning).select(views), likelihood, grid)


def seconds_left(total: float | None, begun: float) -> float | None:
    """Return the seconds left of a budget, but at least `LEAST_FRACTION` of it; None without a budget."""
    return None if total is None else max(total - (time.perf_counter() - begun), LEAST_FRACTION * total)


def _centre(scan: Scan, decisions: list[str], progress: Progress) -> float:
    """Return the shift of the detector that the views show; 0 where there are too few, or the stated centre holds."""
    if len(scan.training_views) < FEWEST_VIEWS:
        return 0.0
    progress(0.0, "centre of rotation")
    found = centre_of(highest_contrast_row(scan, scan.training_views).thinned())
    if not found.is_off:
        return 0.0
    stated = axis_column(scan.geometry)
    decisions.append(
        f"centre of rotation: axis at column {stated - found.shift:.2f} ± {found.error:.2f}; "
        f"the scan states {stated:.2f}"
    )
    return found.shift


def _tilt(scan: Scan, decisions: list[str], seconds: float | None) -> float:
    """Return the rotation of the detector that the views show; 0 where it does not hold, or for lack of time."""
    found = detector_tilt(scan, seconds=seconds)
    if math.isinf(found.error):
        decisions.append("detector tilt: not estimated, for lack of time; set --tilt, or give a larger --budget")
    if not found.holds:
        return 0.0
    decisions.append(
        f"detector tilt: {np.rad2deg(found.value):+.2f} degrees, which lowers chi-square of left-out views "
        f"by {found.gain:.3g} ± {found.error:.2g}"
    )
    return found.value


def _air(
    scan: Scan,
    geometry: ScanGeometry,
    grid: VoxelGrid,
    settings: ReconstructionSettings,
    decisions: list[str],
    seconds: float | None,
) -> list[float] | None:
    """Estimate factors on the open beam of each training view; None if, unless forced, they vary no more than noise."""
    binning = max(1, geometry.columns // 96)
    problem = _problem(scan, geometry, grid.coarser(binning), {}, binning)
    binned = problem.likelihood
    if not isinstance(binned, Poisson):
        return None
    strength = settings.strength
    fit = reconstruct(problem, start(problem), strength=strength, passes=COARSE_PASSES, seconds=seconds)
    integrals = Projector(problem.geometry, problem.grid).forward(fit.volume)
    factors = air_factors(binned, integrals)
    photons = torch.where(beside_object(binned, integrals), binned.counts, 0).sum(1)
    error = float((1 / photons.clamp_min(1)).sqrt().median())
    spread = float(factors.std()) if len(factors) > 1 else 0.0
    if settings.air is not True and spread <= DRIFT * error:
        return None
    decisions.append(
        f"open beam: corrected per view; it varies by {100 * spread:.2f} % between views, of which noise explains "
        f"{100 * error:.2f} %"
    )
    return [float(f) for f in factors]


def _fits_memory(grid: VoxelGrid) -> None:
    needed, limit = BYTES_OF_VOXEL * grid.voxels, default_memory_limit()
    if limit is not None and needed > limit:
        size = " x ".join(str(count) for count in reversed(grid.shape))
        raise UserError(
            f"{size} voxels need {needed / 1e9:.1f} GB of memory; the limit is {limit / 1e9:.1f} GB",
            f"choose larger voxels with --voxel-size (now {grid.size:.3g})",
            OUT_OF_MEMORY,
        )
