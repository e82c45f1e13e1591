"""nerfcli ablate: what each component of the model contributes on a scene."""

from typing import Annotated

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import command

DEFAULT_BUDGET = "1m"
_STYLES = {"would help": "green", "needed: worse without it": "green", "not needed: better without it": "yellow"}


@command
def ablate(
    scene: Annotated[str, typer.Argument(help="Scene folder, or - to read paths from standard input.")],
    *,
    writing: options.Writing,
    budget: Annotated[
        str | None, typer.Option(help="Time of each training: 30s, 2m.  [default: 1m, or none with --steps]")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Steps of each training; results repeat bit for bit on a CPU.", min=1)
    ] = None,
    seeds: Annotated[int, typer.Option(help="Number of seeds per variant, starting at --seed.", min=1)] = 3,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only",
            metavar="NAME,...",
            help="Vary only these components. Repeatable.  [default: all]",
            callback=options.split_at_commas,
        ),
    ] = None,
    training: options.Training,
    printing: options.Printing,
) -> None:
    """Measure what each component of the model contributes on a scene.

    Trains the model that `train --model auto` selects, and variants with one component less or more, all for the same
    time or number of steps and with the same seeds, and compares them on the held-out photos. Each difference comes
    with its 95 % interval over the seeds and a verdict. Later trainings do not use the result. Masks are
    not varied because they change what is measured. For the components see `nerfcli train --help`.

    PSNR is measured on about 16,000 random pixels of the held-out photos: the same pixels for all variants of a seed,
    other pixels for each seed, so that the interval includes the choice of pixels. `nerfcli evaluate` measures the runs
    on whole photos, with SSIM.

    Writes SCENE-ablation/ with ablation.csv, ablation.json and all runs. Run the same command again to resume an
    interrupted one.

    \b
    Examples:
      nerfcli ablate photos-scene
      nerfcli ablate photos-scene --only view,exposure --budget 30s
      nerfcli ablate photos-scene --seeds 5 -o paper/ablation
    """
    from nerfcli.bench.ablation import COLUMNS, ResultRow, table_of
    from nerfcli.training.runs.components import CHOICES
    from nerfcli.workflows.ablate import ablate_scene

    if unknown := [name for name in only or () if name not in CHOICES]:
        raise typer.BadParameter(f"{unknown[0]!r}; choose from {', '.join(CHOICES)}", param_hint="--only")
    if budget is None and steps is None:
        budget = DEFAULT_BUDGET
    console, settings = printing.console, training.settings(budget, steps)

    def work(given: Given) -> None:
        output = writing.beside(given, "-ablation")
        with console.stage(f"ablate {given.path.name}") as reporter:
            content = ablate_scene(given.path, output, settings, seeds=seeds, only=tuple(only or ()), reporter=reporter)
        rows = [ResultRow(**row) for row in content["rows"]]
        console.table(COLUMNS, table_of(rows), styles=_STYLES)
        console.note(f"protocol: {rows[-1].protocol}; 95 % intervals from Student's t over the seeds")
        console.result(output.at(given.path) / "ablation.csv", content)

    for_each_input(scene, work, command="ablate")
