"""Run an ablation: train and measure every variant with every seed."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.bench.ablation import (
    AUTO,
    CHOSEN,
    RUNS,
    CaptureTraits,
    MeasuredTraining,
    ResultRow,
    Variant,
    refuse_others,
    rows_of,
    variants,
    write_results,
)
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.colmap import find_model, parse_colmap
from nerfcli.captures.loading import load_scene, refuse_without_held_out_photos
from nerfcli.evaluate.photos import held_out_photos
from nerfcli.evaluate.sampled import SampledPixels
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.exif import log_exposures, mean_log_exposure, relative_log_exposures
from nerfcli.photos.images import read_image
from nerfcli.photos.loading import is_transparent
from nerfcli.training.runs.components import CHOICES
from nerfcli.training.runs.files import STATE
from nerfcli.training.runs.run import Run
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.workflows.train import train_scene

_SAME = "; the same pixels for all variants of a seed, other pixels for each seed"


def ablate_scene(
    path: Path,
    output: Output,
    settings: TrainSettings,
    *,
    seeds: int,
    only: tuple[str, ...] = (),
    reporter: Reporter = Reporter(),
) -> dict[str, Any]:
    """Train and measure every variant with every seed, continue an earlier call, and write the table after each.

    Args:
        output: the folder to write the table and the runs into, SCENE-ablation by default.
        settings: of all trainings; with `model` "auto", the components are first selected for the scene.
        seeds: number of seeds, counted up from the seed of the settings.
        only: components to vary; all if empty.

    Returns:
        The content of ablation.json.
    """
    scene = load_scene(path)
    refuse_without_held_out_photos(scene)
    folder = output.beside(path, "-ablation")
    # Written out, so that an ablation is not continued with the sizes of another type of device.
    first, most = settings.samples
    settings = replace(
        settings,
        first_samples_per_step=first,
        samples_per_step=most,
        log2_rows=settings.chosen_log2_rows if settings.on_gpu else settings.log2_rows,
    )
    about: dict[str, Any] = {"scene": str(path), "settings": settings.to_json()}
    about |= {"seeds": seeds, "varied": list(only or CHOICES)}
    refuse_others(output, folder, about)

    def trained(name: str, settings: TrainSettings) -> Run:
        """Return a run with these settings, trained now or by an earlier call."""
        target = folder / RUNS / f"{name}-{settings.seed}"
        where, quiet = Output(target, output.overwrite), Reporter(warn=reporter.warn)
        run = train_scene(path, where, settings, resume=None, reporter=quiet)
        # The training state is three times as large as the field, and complete trainings are not resumed.
        (target / STATE).unlink(missing_ok=True)
        return run

    judge: Run | None = None
    measured: list[MeasuredTraining] = []
    compared: list[Variant] = []
    rows: list[ResultRow] = []
    if settings.model == "auto":
        reporter.progress(0.0, "selecting components for this scene")
        run = judge = trained(AUTO, settings)
        compared.append(Variant(AUTO, settings.components))
        measured.append(_measured(run, AUTO, settings, judge=judge))
        settings = replace(settings, model="default", components=run.components, fixed=())
        about["chosen"] = asdict(settings.components)
        reporter.note(_line(measured[-1]))
    models = [Variant(CHOSEN, settings.components)]
    models += variants(settings.components, _capture(scene), only=only)
    compared[:0] = models
    todo = [(seed, one) for seed in range(settings.seed, settings.seed + seeds) for one in models]
    for number, (seed, variant) in enumerate(todo):
        reporter.progress(number / len(todo), f"{variant.name}, seed {seed} ({number + 1} of {len(todo)})")
        wanted = replace(settings, components=variant.components, seed=seed)
        run = trained(variant.name, wanted)
        judge = judge or run
        measured.append(_measured(run, variant.name, wanted, judge=judge))
        reporter.note(_line(measured[-1]))
        about["complete"] = number + 1 == len(todo)
        rows = rows_of(measured, compared)
        write_results(folder, rows, measured, about)
    return {"rows": [vars(row) for row in rows], **about}


def _capture(scene: Capture) -> CaptureTraits:
    """Return the traits of a scene that decide which components can be varied."""
    images, sparse = [frame.image for frame in scene.train_frames if frame.image is not None], find_model(scene.root)
    seen = parse_colmap(sparse).observations if sparse is not None else None
    exif = log_exposures(scene.train_frames)
    return CaptureTraits(
        has_alpha=any(is_transparent(read_image(image)) for image in images),
        has_points=seen is not None and len(seen.pixels) > 0,
        has_exif=bool(np.ptp(relative_log_exposures(exif, mean_log_exposure(exif))) > 0.0),
    )


def _measured(run: Run, name: str, settings: TrainSettings, *, judge: Run) -> MeasuredTraining:
    """Return a training measured on random pixels of the held-out photos, the same for all variants of a seed.

    Args:
        judge: the run that is measured first. The pixels that it left out do not count, whatever others left out.
    """
    model, last = run.model(settings.device), run.log[-1]
    photos = held_out_photos(run, run.cameras.test, left_out_by=judge)
    sample = SampledPixels.drawn(photos, seed=settings.seed)
    return MeasuredTraining(
        name, settings.seed, sample.psnr(model), last["seconds"], last["step"], f"{sample.protocol()}{_SAME}"
    )


def _line(entry: MeasuredTraining) -> str:
    return f"{entry.variant}, seed {entry.seed}: {entry.psnr:.2f} dB after {entry.seconds:.0f} s, {entry.steps} steps"
