"""nerfcli train: from a scene to a field."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import (
    Contraction,
    Device,
    Downscale,
    Exclude,
    FieldKind,
    FieldMemory,
    Holdout,
    Include,
    Json,
    Memory,
    ModelChoice,
    Output,
    Overwrite,
    Quiet,
    Seed,
    Threads,
    bytes_from_text,
    contraction_name,
    device_name,
    downscale_factor,
    field_kind,
    holdout_rule,
    memory_limit,
    model_name,
    named_components,
    seconds_from_text,
    thread_count,
)
from nerfcli.errors import UserError

if TYPE_CHECKING:
    from nerfcli.runs.settings import TrainSettings
    from nerfcli.scene import Scene

DEFAULT_BUDGET = "2m"
NAMES_SHOWN = 8


@command
def train(
    scene: Annotated[str, typer.Argument(help="A scene folder, or - for scenes on standard input.")],
    output: Output = None,
    budget: Annotated[
        str | None, typer.Option(help="Training time: 90s, 5m, 1h.  [default: 2m, or none with --steps]")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Optimiser steps in all; repeatable bit for bit.", min=1)] = None,
    include: Include = None,
    exclude: Exclude = None,
    field: FieldKind = "hash",
    field_memory: FieldMemory = None,
    model: ModelChoice = "auto",
    downscale: Downscale = "auto",
    contraction: Contraction = "auto",
    log2_rows: Annotated[
        int, typer.Option(help="Rows of each table of a hash grid, as a power of two.", min=4, max=24)
    ] = 16,
    levels: Annotated[int, typer.Option(help="Tables of the field; other numbers than 8 are slow.", min=1)] = 8,
    width: Annotated[int, typer.Option(help="Neurons of its layers; other numbers than 32 are slow.", min=1)] = 32,
    batch: Annotated[int, typer.Option(help="Most samples of a step; the first ones are smaller.", min=2**8)] = 2**16,
    holdout: Holdout = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint to the new total.")] = False,
    memory: Memory = None,
    device: Device = "auto",
    seed: Seed = 0,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Fit a radiance field to a scene.

    SCENE is what `nerfcli poses` wrote, a COLMAP project, or a folder with transforms.json (nerfstudio, instant-ngp),
    transforms_train.json (Blender) or poses_bounds.npy (LLFF). Photos are held out as the scene says, else every 8th,
    or by --holdout. Writes SCENE-run/. Ctrl-C or SIGTERM saves a checkpoint; --resume goes on from it.

    Components, for --with and --without: background (auto, black, constant, random, sphere: what is behind the
    field), view (0 to 3: the degree to which colours depend on the direction), exposure (none, exif, learned:
    brightness and white balance of each photo), cameras (fixed, poses, focal, all: what of the photos' cameras learns
    with the field), masks (ignore, empty: what their black means), points (a weight: surfaces at points that photos
    share), entropy (a weight: rays are opaque or clear), near (smaller gradients near cameras), distortion (a weight:
    the light of a ray in one place), antialias (true, false: details smaller than a pixel fade out; for photos from
    near and far), pixels (anywhere, error: more of them where the photos are explained worst). The scene decides on
    points, exposure, cameras, background and view, unless they are named by --with or --without: short trainings on
    up to 15 % of the budget keep a component that is better by more than the noise, on pixels of the
    training photos that were not seen. --model default skips that.

    Fields, for --field: hash (a multiresolution hash grid with two small networks: best for its time), voxels (a dense
    grid of density and spherical harmonics), mlp (one network on Fourier features: small, and slow). The finest detail
    of the last two is a pixel's footprint at the centre of the scene.

    \b
    Examples:
      nerfcli train photos-scene --budget 90s
      nerfcli train photos-scene --budget 5m --resume
      nerfcli train photos-scene --holdout block:0.15 -o gap-run
      nerfcli train data/lego --steps 2000 --downscale 2 -o lego-run
      nerfcli train photos-scene --budget 5m --model default
      nerfcli train photos-scene --without view --with distortion=0.01
      nerfcli train photos-scene --with cameras=poses
      nerfcli train photos-scene --field voxels --field-memory 16MB
    """
    from nerfcli.runs.components import Components, choose
    from nerfcli.runs.settings import TrainSettings

    if budget is None and steps is None:
        budget = DEFAULT_BUDGET
    console = Console(quiet=quiet, json_lines=json)
    settings = TrainSettings(
        budget_seconds=None if budget is None else seconds_from_text(budget),
        steps=steps,
        downscale=downscale_factor(downscale),
        contraction=contraction_name(contraction),
        seed=seed,
        device=device_name(device),
        threads=thread_count(threads),
        components=choose(Components(), included=include or (), excluded=exclude or ()),
        model=model_name(model),
        fixed=named_components(include, exclude),
        first_samples_per_step=min(TrainSettings.first_samples_per_step, batch),
        samples_per_step=batch,
        levels=levels,
        log2_rows=log2_rows,
        width=width,
        field=field_kind(field),
        field_memory_bytes=None if field_memory is None else bytes_from_text(field_memory),
    )
    rule = holdout_rule(holdout)

    limit = memory_limit(memory)

    def work(folder: Path, one_of_many: bool) -> None:
        run = result_path(folder, suffix="-run", output=output, one_of_many=one_of_many)
        train_scene(
            folder,
            run,
            settings=settings,
            memory_bytes=limit,
            resume=resume,
            overwrite=overwrite,
            console=console,
            holdout=rule,
        )
        console.result(run)

    for_each_input(scene, work)


def train_scene(
    folder: Path,
    run: Path,
    *,
    settings: "TrainSettings",
    memory_bytes: int | None = None,
    resume: bool,
    overwrite: bool,
    console: Console,
    holdout: str | None = None,
) -> None:
    """Train one scene, keep a run that is already what was asked for, or refuse to touch another one.

    Photos are held out as the scene says, or by the rule `holdout`.

    Raises:
        UserError: see `nerfcli.train.loop.train`; or a different run stands at `run`.
    """
    from nerfcli import scene as scenes
    from nerfcli.atomic import clear_leftovers
    from nerfcli.cameras.orientation import rescaling_told
    from nerfcli.evaluate.protocol import METRICS
    from nerfcli.exclusive import exclusive
    from nerfcli.runs.folder import LOCK

    scene = scenes.load(folder, holdout=holdout)
    if scene.missing:
        listed = ", ".join(scene.missing[:NAMES_SHOWN])
        more = f" and {len(scene.missing) - NAMES_SHOWN} more" if len(scene.missing) > NAMES_SHOWN else ""
        console.warn(f"{len(scene.missing)} photos of {folder} are not there and are left out: {listed}{more}")
    for text in rescaling_told(scene.rescaled):
        console.note(text)

    def is_kept() -> bool:
        if not _keeps(run, scene, settings, resume=resume, overwrite=overwrite):
            return False
        console.note(f"{run} is kept: it was trained with these settings; --overwrite trains again")
        return True

    if is_kept():
        return
    with exclusive(run / LOCK, f"nerfcli train is at work on {run}"):
        if is_kept():  # by one that has just ended
            return
        clear_leftovers(run)
        if overwrite:
            (run / METRICS).unlink(missing_ok=True)  # they belong to the field that goes
        _fit(scene, run, settings, memory_bytes=memory_bytes, resume=resume, console=console)


def _keeps(run: Path, scene: "Scene", settings: "TrainSettings", *, resume: bool, overwrite: bool) -> bool:
    """Whether `run` is already what was asked for.

    Raises:
        UserError: it is something else, which is not ours to replace; or nothing to resume.
    """
    from nerfcli import scene as scenes
    from nerfcli.runs.folder import CONFIG, FIELD, LOCK, STATE, is_complete, is_same_run, read_config, split_hash

    trained = (run / FIELD).exists()
    if resume and not trained and not (run / STATE).exists():
        raise UserError(f"nothing to resume in {run}", "leave --resume out to start, or give the run with -o")
    if resume and read_config(run).get("split_sha256") != split_hash(scene.test_names):
        before = read_config(run).get("holdout")
        raise UserError(
            f"{run} was trained with other photos held out ({before or 'as the scene says'})",
            f"give --holdout {before}" if before else "leave --holdout out, or choose another place with -o",
        )
    if resume and read_config(run).get("scene_fingerprint") != scenes.fingerprint(scene):
        raise UserError(f"{run} was trained on another scene than {scene.root}", "choose another place with -o")
    if trained and not resume and not overwrite:
        if is_same_run(run, scene, settings) and is_complete(run, settings):
            return True
        raise UserError(
            f"{run} exists", "add --resume to go on, --overwrite to replace it, or choose another place with -o"
        )
    others = run.is_dir() and not (run / CONFIG).exists() and any(path.name != LOCK for path in run.iterdir())
    if run.is_file() or others:
        raise UserError(f"{run} is not a run, but something else", "choose another place with -o")
    return False


def _fit(
    scene: "Scene",
    run: Path,
    settings: "TrainSettings",
    *,
    memory_bytes: int | None,
    resume: bool,
    console: Console,
) -> None:
    from nerfcli.runs.folder import STATE
    from nerfcli.train.loop import Progress
    from nerfcli.train.loop import train as fit

    with console.progress(f"train {scene.root.name}") as update:

        def on_progress(progress: Progress) -> None:
            detail = (
                f"step {progress.step}  loss {progress.loss:.4f}  {progress.samples_per_second / 1e3:.0f} k samples/s"
            )
            update(progress.share, detail)

        try:
            fit(
                scene,
                run,
                settings,
                resume=resume,
                memory_bytes=memory_bytes,
                notify=console.note,
                on_progress=on_progress,
            )
        except KeyboardInterrupt:
            if (run / STATE).exists():
                paths = f"{shlex.quote(str(scene.root))} -o {shlex.quote(str(run))}"
                console.note(f"checkpoint saved; go on with: nerfcli train {paths} --resume")
            raise


def was_interrupted(folder: Path, run: Path, settings: "TrainSettings", *, holdout: str | None = None) -> bool:
    """Whether a training of this scene with these settings stopped before its end and left a checkpoint."""
    from nerfcli import scene as scenes
    from nerfcli.runs.folder import FIELD, is_complete, is_same_run

    if not (run / FIELD).exists():
        return False
    scene = scenes.load(folder, holdout=holdout)
    return is_same_run(run, scene, settings) and not is_complete(run, settings)


def train_other_seeds(run: Path, count: int, *, device: str, threads: int, console: Console) -> list[Path]:
    """Train the scene of a run again with other seeds and otherwise the same settings, in RUN/seeds/SEED.

    Runs that are there and complete are kept, interrupted ones are gone on with.

    Args:
        run: a complete run.
        count: how many others; their seeds follow the run's own.
        device, threads: as for `TrainSettings`.

    Raises:
        UserError: the scene is no longer where it was, or is another one by now.
    """
    from dataclasses import replace

    from nerfcli import scene as scenes
    from nerfcli.runs.folder import read_config, settings_of

    config = read_config(run)
    folder, holdout = Path(config["scene"]), config.get("holdout")
    first = replace(settings_of(config), device=device, threads=threads)
    if not folder.exists():
        raise UserError(
            f"the scene of {run} should be in {folder}, which is not there",
            "call it from the folder that the run was trained from, or train again",
        )
    scene = scenes.load(folder, holdout=holdout)
    if scenes.fingerprint(scene) != config.get("scene_fingerprint"):
        raise UserError(f"{folder} is not the scene any more that {run} was trained on", "train again with --overwrite")
    others = []
    for seed in range(first.seed + 1, first.seed + 1 + count):
        settings, other = replace(first, seed=seed), run / "seeds" / str(seed)
        resume = was_interrupted(folder, other, settings, holdout=holdout)
        console.note(f"{other}: seed {seed}")
        train_scene(folder, other, settings=settings, resume=resume, overwrite=False, console=console, holdout=holdout)
        others.append(other)
    return others
