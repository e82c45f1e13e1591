"""nerfcli ablate: what each component is worth on a scene."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import (
    Device,
    Downscale,
    Exclude,
    Holdout,
    Include,
    Json,
    Memory,
    Output,
    Overwrite,
    Quiet,
    Seed,
    Threads,
    device_name,
    downscale_factor,
    holdout_rule,
    memory_limit,
    model_name,
    named_components,
    seconds_from_text,
    thread_count,
)
from nerfcli.errors import UserError

if TYPE_CHECKING:
    from nerfcli.ablate.results import Measured
    from nerfcli.ablate.variants import Capture
    from nerfcli.runs.settings import TrainSettings
    from nerfcli.scene import Scene

    Measure = Callable[["_Trainings", str, TrainSettings, Path], Measured]

DEFAULT_BUDGET = "1m"
_SAME = "; the same pixels for all models of a seed, others for each seed"
_STYLES = {"would help": "green", "needed: worse without it": "green", "not needed: better without it": "yellow"}


@command
def ablate(
    scene: Annotated[str, typer.Argument(help="A scene folder, or - for scenes on standard input.")],
    output: Output = None,
    budget: Annotated[
        str | None, typer.Option(help="Time of each training: 30s, 2m.  [default: 1m, or none with --steps]")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Steps of each training; repeatable bit for bit.", min=1)] = None,
    seeds: Annotated[int, typer.Option(help="Trainings of each model, from --seed on.", min=1)] = 3,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="NAME", help="A component to vary; all. Repeatable.")
    ] = None,
    include: Include = None,
    exclude: Exclude = None,
    whole: Annotated[
        bool,
        typer.Option("--whole", help="Measure whole held-out photos as `evaluate` does, SSIM too, not random pixels."),
    ] = False,
    model: Annotated[
        str, typer.Option(help="What is compared with: auto (what the scene decides on) or default.")
    ] = "auto",
    downscale: Downscale = "auto",
    holdout: Holdout = None,
    memory: Memory = None,
    device: Device = "auto",
    seed: Seed = 0,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Measure what each component of the model is worth on a scene.

    Trainings with it and without it are compared on the held-out photos: the one that `train --model auto` chooses
    beside models that have one component less, or one more: the same time or steps, the same seeds. Each difference
    comes with its 95 % interval over the seeds and a verdict. This is a measurement: nothing is chosen by it. Masks are
    not varied, as they change what is measured. Components are those of `nerfcli train --help`.

    PSNR is that of some 16,000 random pixels of the held-out photos: the same ones for all models of a seed, others for
    each seed, so that the interval includes the choice of pixels. For a table of a paper add --whole: whole photos and
    SSIM by the protocol of `nerfcli evaluate`, which takes longer than short trainings do.

    Writes SCENE-ablation/ with ablation.csv, ablation.json and every run. When it was interrupted, the same command
    goes on; with --whole it measures the trainings that are there anew.

    \b
    Examples:
      nerfcli ablate photos-scene
      nerfcli ablate photos-scene --only view --only exposure --budget 30s
      nerfcli ablate photos-scene --model default --seeds 5 --whole -o paper/ablation
    """
    from nerfcli.runs.components import CHOICES, Components, choose
    from nerfcli.runs.settings import TrainSettings

    if unknown := [name for name in only or () if name not in CHOICES]:
        raise typer.BadParameter(f"{unknown[0]!r}; choose from {', '.join(CHOICES)}", param_hint="--only")
    if budget is None and steps is None:
        budget = DEFAULT_BUDGET
    console = Console(quiet=quiet, json_lines=json)
    settings = TrainSettings(
        budget_seconds=None if budget is None else seconds_from_text(budget),
        steps=steps,
        downscale=downscale_factor(downscale),
        seed=seed,
        device=device_name(device),
        threads=thread_count(threads),
        components=choose(Components(), included=include or (), excluded=exclude or ()),
        model=model_name(model),
        fixed=named_components(include, exclude),
    )
    rule, limit = holdout_rule(holdout), memory_limit(memory)

    def work(path: Path, one_of_many: bool) -> None:
        folder = result_path(path, suffix="-ablation", output=output, one_of_many=one_of_many)
        trainings = _Trainings(path, folder, rule, limit, overwrite, console)
        measure = _measured_whole if whole else _measured_pixels
        content = ablate_scene(trainings, settings, seeds=seeds, only=tuple(only or ()), measure=measure)
        console.result(folder / "ablation.csv", content)

    for_each_input(scene, work)


class _Trainings:
    """The runs of one ablation, each trained once, in a folder of its own."""

    def __init__(
        self, scene: Path, folder: Path, rule: str | None, limit: int | None, overwrite: bool, console: Console
    ):
        self.scene, self.folder, self.rule, self.console = scene, folder, rule, console
        self.overwrite, self._limit = overwrite, limit
        self.inner = Console(quiet=True, json_lines=False)

    def run(self, name: str, settings: "TrainSettings") -> Path:
        """The folder of a run, trained with these settings: now, or by an earlier call."""
        from nerfcli.ablate.results import RUNS
        from nerfcli.cli.train import train_scene, was_interrupted
        from nerfcli.runs.folder import STATE

        run = self.folder / RUNS / f"{name}-{settings.seed}"
        resume = not self.overwrite and was_interrupted(self.scene, run, settings, holdout=self.rule)
        train_scene(
            self.scene,
            run,
            settings=settings,
            memory_bytes=self._limit,
            resume=resume,
            overwrite=self.overwrite,
            console=self.inner,
            holdout=self.rule,
        )
        # Three times as large as the field, and nobody goes on from here.
        (run / STATE).unlink(missing_ok=True)
        return run


def ablate_scene(
    trainings: _Trainings, settings: "TrainSettings", *, seeds: int, only: tuple[str, ...], measure: "Measure"
) -> dict[str, Any]:
    """Train every variant with every seed, or what is left of it, measure it, and write the table after each.

    Args:
        trainings: where the runs are.
        settings: of all of them; `model` "auto" has the scene decide first.
        seeds: how many, from that of the settings on.
        only: components to vary; all where there are none.
        measure: takes the trainings, the name of a variant, its settings and its run.

    Raises:
        UserError: see `nerfcli.train.loop.train`; nothing is held out, or something else stands at the folder.
    """
    from nerfcli import scene as scenes
    from nerfcli.ablate.results import COLUMNS, refuse_foreign, rows_of, table_of, write_results
    from nerfcli.ablate.variants import AUTO, CHOSEN, Variant, variants
    from nerfcli.runs.folder import chosen_components, read_config

    scene, folder, console = scenes.load(trainings.scene, holdout=trainings.rule), trainings.folder, trainings.console
    if not scene.test_frames:
        raise UserError(f"{trainings.scene} has no held-out photo to measure on", "hold some out: --holdout every:8")
    refuse_foreign(folder)
    about = {"scene": str(trainings.scene), "settings": settings.to_json(), "complete": False}
    measured: list[Measured] = []
    compared: list[Variant] = []
    rows = rows_of(measured, compared)
    write_results(folder, rows, measured, about)
    with console.progress(f"ablate {trainings.scene.name}") as update:
        if settings.model == "auto":
            update(0.0, "asking the scene which components it needs")
            run = trainings.run(AUTO, settings)
            compared.append(Variant(AUTO, settings.components))
            measured.append(measure(trainings, AUTO, settings, run))
            settings = replace(settings, model="default", components=chosen_components(read_config(run)), fixed=())
            about["chosen"] = settings.components.to_json()
            console.note(_told(measured[-1]))
        models = [Variant(CHOSEN, settings.components)]
        models += variants(settings.components, _capture(scene), only=only)
        compared[:0] = models
        todo = [(seed, one) for seed in range(settings.seed, settings.seed + seeds) for one in models]
        for number, (seed, variant) in enumerate(todo):
            update(number / len(todo), f"{variant.name}, seed {seed} ({number + 1} of {len(todo)})")
            wanted = replace(settings, components=variant.components, seed=seed)
            run = trainings.run(variant.name, wanted)
            measured.append(measure(trainings, variant.name, wanted, run))
            console.note(_told(measured[-1]))
            about["complete"] = number + 1 == len(todo)
            rows = rows_of(measured, compared)
            write_results(folder, rows, measured, about)
    console.table(COLUMNS, table_of(rows), styles=_STYLES)
    console.note(f"measured by {measured[-1].protocol}; intervals of 95 % by Student's t over the seeds")
    return {"rows": [vars(row) for row in rows], **about}


def _capture(scene: "Scene") -> "Capture":
    """What the scene offers to components."""
    import numpy as np

    from nerfcli.ablate.variants import Capture
    from nerfcli.cameras.formats.colmap import parse_colmap
    from nerfcli.media.images import read_image
    from nerfcli.photos.exif_exposure import mean_log_exposure, relative_log_exposures
    from nerfcli.scene import model_folder

    first, sparse = scene.train_frames[0].image, model_folder(scene.root)
    seen = parse_colmap(sparse).observations if sparse is not None else None
    exif = relative_log_exposures(scene.train_frames, mean_log_exposure(scene.train_frames))
    return Capture(
        has_alpha=first is not None and read_image(first).shape[-1] == 4,
        has_points=seen is not None and len(seen.pixels) > 0,
        has_exif=bool(np.ptp(exif) > 0.0),
    )


def _measured_whole(trainings: _Trainings, name: str, settings: "TrainSettings", run: Path) -> "Measured":
    """Whole photos, by the protocol of `evaluate`: now, or by an earlier call."""
    from nerfcli.ablate.results import Measured
    from nerfcli.cli.evaluate import evaluate_run

    device, threads = settings.device, settings.threads
    _, metrics = evaluate_run(
        run, device=device, threads=threads, overwrite=trainings.overwrite, console=trainings.inner
    )
    mean, training, protocol = metrics["mean"], metrics["training"], metrics["protocol"]
    return Measured(name, settings.seed, mean["psnr"], mean["ssim"], training["seconds"], training["steps"], protocol)


def _measured_pixels(trainings: _Trainings, name: str, settings: "TrainSettings", run: Path) -> "Measured":
    """Random pixels of the held-out photos: the same for all models of a seed."""
    from nerfcli.ablate.results import Measured
    from nerfcli.cli.evaluation import held_out_photos
    from nerfcli.evaluate.sampled import SampledPixels
    from nerfcli.render.model import load_model
    from nerfcli.runs.folder import FIELD, read_cameras, read_config, read_log

    model, last = load_model(run / FIELD, settings.device), read_log(run)[-1]
    photos = held_out_photos(read_config(run), read_cameras(run)["test"], model=model, threads=settings.threads)
    sample = SampledPixels.drawn(photos, seed=settings.seed)
    return Measured(
        name, settings.seed, sample.psnr(model), None, last["seconds"], last["step"], f"{sample.protocol()}{_SAME}"
    )


def _told(entry: "Measured") -> str:
    return f"{entry.variant}, seed {entry.seed}: {entry.psnr:.2f} dB after {entry.seconds:.0f} s, {entry.steps} steps"
