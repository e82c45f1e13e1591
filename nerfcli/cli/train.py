"""nerfcli train: from a scene to a field."""

import functools
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import STDIN, Given, for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.machine import device_name, is_first, is_one_of_several, local_rank_and_size, thread_count

DEFAULT_BUDGET = "2m"


@command
def train(
    scene: Annotated[str, typer.Argument(help="Scene folder, or - to read paths from standard input.")],
    output: options.Output = None,
    budget: Annotated[
        str | None, typer.Option(help="Training time: 90s, 5m, 1h; 90 is 90 s.  [default: 2m, or none with --steps]")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Total optimizer steps; results repeat bit for bit on a CPU.", min=1)
    ] = None,
    include: options.Include = None,
    exclude: options.Exclude = None,
    field: options.FieldKind = None,
    field_memory: options.FieldMemory = None,
    model: options.ModelChoice = "auto",
    downscale: options.Downscale = "auto",
    contraction: options.Contraction = "auto",
    log2_rows: Annotated[
        int | None,
        typer.Option(
            help="Rows of each hash table, as a power of two.  [default: 16 to 19 by the budget, on a GPU 19]",
            min=4,
            max=24,
            show_default=False,
        ),
    ] = None,
    batch: Annotated[
        int | None,
        typer.Option(
            help="Maximum number of samples per step; the first steps use fewer.  [default: 65536, on a GPU 262144]",
            min=2**8,
            show_default=False,
        ),
    ] = None,
    holdout: options.Holdout = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue from the last checkpoint to the new total; without one, start."),
    ] = False,
    memory: options.DeviceMemory = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show how much memory, disk and time it would take, and its schedule.")
    ] = False,
    device: options.Device = "auto",
    seed: options.Seed = 0,
    threads: options.Threads = 0,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Fit a radiance field to a scene.

    SCENE is a folder written by `nerfcli poses`, or a file or folder of any other format that `nerfcli convert` reads
    (COLMAP, nerfstudio, instant-ngp, Blender, LLFF, Metashape, ...), with photos on disk. The held-out photos are those
    of the scene, else every 8th photo, or those of --holdout. Writes SCENE-run/. Ctrl-C or SIGTERM saves a checkpoint;
    --resume continues from it.

    \b
    Components, for --with and --without:
      background  auto, black, constant, random, sphere: colour behind the field
      view        0 to 3: degree of view-dependent colour
      exposure    none, exif, matched (fixed, from pixels that photos share), learned: brightness and white balance
      cameras     fixed, poses, focal, all: camera parameters optimized together with the field
      masks       ignore, empty: whether black in masks is unknown or empty space
      points      a weight: surfaces at the 3D points of matched features
      stereo      true, false: with points, also at depths from stereo matching of the training photos
      near        true, false: smaller gradients near cameras
      distortion  a weight: concentrate the density along each ray
      antialias   true, false: fade out details smaller than a pixel; for photos from near and far
      occluders   true, false: leave out what hides, in one photo, a surface that others see

    Unless they are set with --with or --without, points, stereo, occluders, exposure, cameras, background and view are
    selected automatically. The first three and exposures from matched pixels are used where the photos support them,
    unless that loses more than 1 dB in a trial. For the rest, short trainings on up to 15 % of the budget keep a
    component if it improves PSNR by more than the noise, on training pixels left out of these trials. --model default
    skips the selection.

    Types of field, for --field: hash (a multiresolution hash grid with two small networks: best quality for its time),
    voxels (a dense grid of density and spherical harmonics), mlp (one network on Fourier features: small and slow).
    The resolution of the last two is one pixel's footprint at the centre of the scene.

    \b
    Examples:
      nerfcli train photos-scene --budget 90s
      nerfcli train photos-scene --budget 5m --resume
      nerfcli train photos-scene --budget 5m --dry-run --json
      nerfcli train photos-scene --holdout block:0.15 -o gap-run
      nerfcli train data/lego --steps 2000 --downscale 2 -o lego-run
      nerfcli train photos-scene --budget 5m --model default
      nerfcli train photos-scene --without view --with distortion=0.01
      nerfcli train photos-scene --with cameras=poses
      nerfcli train photos-scene --field voxels --field-memory 16MB
    """
    from nerfcli.errors import UserError
    from nerfcli.field.kinds import KINDS
    from nerfcli.machine import default_memory_limit
    from nerfcli.training.runs.components import Components, choose
    from nerfcli.training.runs.settings import TrainSettings, sizes_for
    from nerfcli.training.schedule import NOTES, table_of
    from nerfcli.workflows.train import plan_training, train_scene

    if budget is None and steps is None:
        budget = DEFAULT_BUDGET
    if field not in (None, "hash") and log2_rows is not None:
        message = "it works with --field hash; for other fields, give --field-memory"
        raise typer.BadParameter(message, param_hint="--log2-rows")
    if is_one_of_several() and (dry_run or scene == STDIN):
        raise UserError("processes of torchrun train one field of photos", "use this command without torchrun", 2)
    console = Console(quiet=quiet or not is_first(), json_lines=json)
    budget_seconds = None if budget is None else options.seconds_from_text(budget)
    rule = options.holdout_rule(holdout)
    limit = None if memory is None else options.bytes_from_text(memory)

    @functools.cache
    def photo_settings() -> TrainSettings:
        torch_device = device_name(device)
        sized = replace(TrainSettings(), **sizes_for(torch_device))
        largest = batch or sized.samples_per_step
        field_bytes = None if field_memory is None else options.bytes_from_text(field_memory, "--field-memory")
        return TrainSettings(
            budget_seconds=budget_seconds,
            steps=steps,
            downscale=options.downscale_factor(downscale),
            contraction=options.contraction_name(contraction),
            seed=seed,
            device=torch_device,
            threads=thread_count(threads),
            components=choose(Components(), included=include or (), excluded=exclude or ()),
            model=options.one_of(model, ("auto", "default"), "--model"),
            fixed=options.named_components(include, exclude),
            first_samples_per_step=min(sized.first_samples_per_step, largest),
            samples_per_step=largest,
            log2_rows=log2_rows or sized.log2_rows,
            field=options.one_of(field or "hash", KINDS, "--field"),
            field_memory_bytes=field_bytes,
        )

    def memory_of_process() -> int | None:
        shared = limit or default_memory_limit(photo_settings().device)
        on_gpu = photo_settings().device != "cpu"
        return shared if shared is None or on_gpu else shared // local_rank_and_size()[1]

    def train_one_scene(folder: Path, run: Path) -> None:
        with console.stage(f"train {folder.name}") as reporter:
            train_scene(
                folder,
                run,
                photo_settings(),
                memory_bytes=memory_of_process(),
                resume=resume,
                overwrite=overwrite,
                holdout=rule,
                notify=reporter.note,
                warn=reporter.warn,
                progress=reporter.progress,
            )

    def plan_one_scene(folder: Path) -> None:
        on_host = photo_settings().device == "cpu"  # else --memory refers to the GPU
        resident = (limit or default_memory_limit()) if on_host else None
        plan = plan_training(folder, photo_settings(), memory_bytes=resident, holdout=rule)
        console.facts(folder, plan.to_json(), f"{folder}: {plan.describe()}")
        if not json:
            console.fact_table(*table_of(plan.schedule), styles={})
            for note in NOTES:
                console.note(note)

    def work(given: Given) -> None:
        run = options.Writing(output, overwrite).beside(given, "-run").at(given.path)
        if dry_run:
            plan_one_scene(given.path)
            return
        train_one_scene(given.path, run)
        if is_first():
            console.result(run)

    photo_settings()  # refuses invalid options before anything is read
    for_each_input(scene, work, command="train")
