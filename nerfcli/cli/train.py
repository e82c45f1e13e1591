"""nerfcli train: from a scene to a field."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import STDIN, Given, for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.errors import in_shell
from nerfcli.machine import Resources, is_first, is_one_of_several

if TYPE_CHECKING:
    from nerfcli.training.runs.settings import TrainSettings
    from nerfcli.workflows.train import TrainingPlan

DEFAULT_BUDGET = "2m"


@dataclass(frozen=True)
class Fit:
    """What to train, for how long, and from where on."""

    budget: Annotated[
        str | None, typer.Option(help="Training time: 90s, 5m, 1h; 90 is 90 s.  [default: 2m, or none with --steps]")
    ] = None
    steps: Annotated[
        int | None, typer.Option(help="Total optimizer steps; results repeat bit for bit on a CPU.", min=1)
    ] = None
    sensor_depth: Annotated[
        bool,
        typer.Option(
            "--no-sensor-depth", help="Ignore depth maps of a sensor, like --without sensor.", show_default=False
        ),
    ] = True
    include: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="NAME[=VALUE],...",
            help="Components to enable; nerfcli train --help lists them. Repeatable.",
            callback=options.split_at_commas,
        ),
    ] = None
    exclude: Annotated[
        list[str] | None,
        typer.Option(
            "--without",
            metavar="NAME,...",
            help="Components to disable; nerfcli train --help lists them. Repeatable.",
            callback=options.split_at_commas,
        ),
    ] = None
    field: Annotated[str | None, typer.Option(help="Type of field: hash, voxels or mlp.  [default: hash]")] = None
    field_memory: Annotated[
        str | None,
        typer.Option(
            help="Approximate size of the parameters: 4MB, 64MB.  [default: hash 8 to 64MiB by the budget, voxels "
            "64MiB, mlp 256KiB]"
        ),
    ] = None
    model: Annotated[
        str,
        typer.Option(
            help="auto: select components for this scene with short trainings; default: use the default components."
        ),
    ] = "auto"
    contraction: Annotated[
        str,
        typer.Option(
            help="Map distant space into a ball (l2), or not at all (none); auto: l2, but none for photos with alpha "
            "or of an object before a plain background."
        ),
    ] = "auto"
    log2_rows: Annotated[
        int | None,
        typer.Option(
            help="Rows of each hash table, as a power of two.  [default: 16 to 19 by the budget, on a GPU 19]",
            min=4,
            max=24,
            show_default=False,
        ),
    ] = None
    batch: Annotated[
        int | None,
        typer.Option(
            help="Maximum number of samples per step; the first steps use fewer.  [default: 65536, on a GPU 262144]",
            min=2**8,
            show_default=False,
        ),
    ] = None
    memory: Annotated[
        str | None,
        typer.Option(
            help="Memory limit, of the GPU with --device cuda: 4GB, 500MB.  [default: 4/5 of the machine's memory, or "
            "what is free on the GPU]",
            show_default=False,
        ),
    ] = None
    holdout: options.Holdout = None
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue from the last checkpoint to the new total; start if there is none."),
    ] = False
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Show the memory, disk space, time and schedule of the training, without training."
        ),
    ] = False

    def settings(self, training: options.Training) -> "TrainSettings":
        """Return the settings that the options select."""
        from nerfcli.field.kinds import KINDS
        from nerfcli.training.runs.components import Components, choose

        if self.field not in (None, "hash") and self.log2_rows is not None:
            message = "it works with --field hash; for other fields, give --field-memory"
            raise typer.BadParameter(message, param_hint="--log2-rows")
        options.one_of(self.contraction, ("auto", "none", "l2"), "--contraction")
        excluded = [*(self.exclude or ()), *([] if self.sensor_depth else ["sensor"])]
        budget = DEFAULT_BUDGET if self.budget is None and self.steps is None else self.budget
        sized = training.settings(budget, self.steps)
        size = None if self.field_memory is None else options.bytes_from_text(self.field_memory, "--field-memory")
        return replace(
            sized,
            contraction=None if self.contraction == "auto" else self.contraction,
            components=choose(Components(), included=self.include or (), excluded=excluded),
            model=options.one_of(self.model, ("auto", "default"), "--model"),
            fixed=tuple(sorted({text.partition("=")[0] for text in (*(self.include or ()), *excluded)})),
            samples_per_step=self.batch,
            log2_rows=self.log2_rows,
            field=options.one_of(self.field or "hash", KINDS, "--field"),
            field_memory_bytes=size,
        )

    def resources(self, training: options.Training) -> Resources:
        """Return what the training may use of this machine."""
        limit = None if self.memory is None else options.bytes_from_text(self.memory)
        return replace(training.resources, memory_bytes=limit)


@command
def train(
    scene: Annotated[str, typer.Argument(help="Scene folder, or - to read paths from standard input.")],
    writing: options.Writing,
    fit: Fit,
    training: options.Training,
    *,
    printing: options.Printing,
) -> None:
    """Fit a radiance field to a scene.

    SCENE is a folder written by `nerfcli poses`, or a file or folder of any other format that `nerfcli convert` reads
    (COLMAP, nerfstudio, instant-ngp, Blender, LLFF, Metashape, ...), with photos on disk; a zip archive of one is
    unpacked beside the run. The held-out photos are those of --holdout, or those of the scene, or else every 8th photo.
    Writes SCENE-run/. Ctrl-C or SIGTERM saves a checkpoint; --resume continues from it.

    \b
    Components, for --with and --without:
      background  auto, black, constant, random, sphere: colour behind the field
      view        0 to 3: degree of view-dependent colour
      exposure    none, exif, matched (fixed, from pixels that photos share), learned: brightness and white balance
      cameras     fixed, poses, focal, all: camera parameters optimized together with the field
      masks       ignore, empty: whether black in masks is unknown or empty space
      points      a weight: surfaces at the 3D points of matched features
      stereo      true, false: with points, also at depths from stereo matching of the training photos
      sensor      true, false: surfaces at the depths of a sensor, if the capture has depth maps
      near        true, false: smaller gradients near cameras
      distortion  a weight: concentrate the density along each ray
      antialias   true, false: fade out details smaller than a pixel; for photos from near and far
      occluders   true, false: ignore what hides a surface in one photo, or is attached to the camera

    Unless they are set with --with or --without, points, stereo, sensor, occluders, exposure, cameras, background and
    view are selected automatically. The first four and exposures from matched pixels are used where the photos support
    them. For the rest, short trainings on up to 15 % of the budget keep a
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
    from nerfcli.workflows.train import plan_training, train_scene

    if is_one_of_several() and (fit.dry_run or scene == STDIN):
        hint = "use this command without torchrun"
        raise UserError("torchrun works only with one scene, and without --dry-run", hint, 2)
    console = Console(quiet=printing.quiet or not is_first(), json_lines=printing.json)
    settings = fit.settings(training)
    how = {"holdout": options.holdout_rule(fit.holdout), "resources": fit.resources(training)}

    def work(given: Given) -> None:
        output = writing.beside(given, "-run")
        if fit.dry_run:
            plan = plan_training(given.path, settings, **how)
            show_plan(plan, given.path, console, with_schedule=not printing.json)
            return
        with console.stage(f"train {given.path.name}") as reporter:
            run = train_scene(given.path, output, settings, resume=fit.resume, **how, reporter=reporter)
        if is_first():
            console.result(run.path)
        if not given.one_of_many:
            here = in_shell(run.path)
            console.note(f"next: nerfcli evaluate {here}, or nerfcli render {here} --cameras orbit --video")

    for_each_input(scene, work, command="train")


def show_plan(plan: "TrainingPlan", scene: Path, console: Console, *, with_schedule: bool) -> None:
    """Print what a training costs, and its schedule as a table."""
    from nerfcli.training.schedule import NOTES, table_of

    console.facts(scene, plan.to_json(), f"{scene}: {plan.describe()}")
    if with_schedule:
        console.fact_table(*table_of(plan.schedule), styles={})
        for note in NOTES:
            console.note(note)
