"""nerfcli bench: speed against error."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.errors import UserError
from nerfcli.machine import Resources
from nerfcli.output import Output

if TYPE_CHECKING:
    from nerfcli.bench.results import Point

_STYLES = {"yes": "green"}


@command
def bench(
    source: Annotated[str, typer.Argument(help="Run folder, or a scene; - to read paths from standard input.")],
    *,
    writing: options.Writing,
    budget: Annotated[
        str, typer.Option(help="Total time: 8m, 1h. More time allows more settings, longer trainings and more repeats.")
    ] = "8m",
    computing: options.Computing,
    printing: options.Printing,
) -> None:
    """Measure speed against error on this scene and machine.

    Of a run: renders its field with other steps, tolerances and numbers of threads. Measures the time per picture
    (median and quartiles of interleaved rounds), peak memory, the error against the held-out photos and, separately,
    against a converged rendering of the same field. Of a scene: trains it with other sizes, batches, seeds and times.
    Run nothing else on the machine meanwhile.

    Writes SOURCE-bench/ with bench.csv, bench.json and a plot, bench.png; after an interruption they hold the results
    so far. The column "fastest" marks the settings that no other beats in both speed and error.

    \b
    Examples:
      nerfcli bench photos-scene-run
      nerfcli bench photos-scene --budget 30m -o bench/
      nerfcli bench photos-scene-run --json | jq .points[].name
    """
    seconds = options.seconds_from_text(budget)
    if seconds < 20.0:
        raise typer.BadParameter(f"{budget!r} is too short; give at least 20s", param_hint="--budget")
    console = printing.console

    def work(given: Given) -> None:
        output = writing.beside(given, "-bench")
        content = bench_one(given.path, output, seconds, resources=computing.resources, console=console)
        console.result(output.at(given.path) / "bench.csv", content)

    for_each_input(source, work, command="bench")


def bench_one(path: Path, output: Output, seconds: float, *, resources: Resources, console: Console) -> dict[str, Any]:
    """Measure one run or scene, or keep a complete bench of it; return the content of bench.json.

    Raises:
        UserError: the input cannot be measured, or the output folder holds something else, such as another bench.
    """
    from nerfcli import kernels
    from nerfcli.atomic import read_json
    from nerfcli.bench import measurement
    from nerfcli.bench.results import BENCH, COLUMNS, Point, table_of, write_results
    from nerfcli.captures.loading import fingerprint, load_scene
    from nerfcli.training.runs.run import Run

    folder = output.beside(path, "-bench")
    if not path.exists():
        raise UserError(f"{path} does not exist", "give a run folder, or a scene folder")
    others = folder.is_dir() and any(entry.name != measurement.WORK for entry in folder.iterdir())
    if folder.is_file() or (others and not (folder / BENCH).is_file()):
        raise UserError(f"{folder} exists and is not a bench folder", "choose another folder with -o")
    run = Run(path)
    scene = None if run.is_trained else load_scene(path)
    wanted = {
        "source_sha256": run.checkpoint_sha256() if scene is None else fingerprint(scene),
        "budget_seconds": seconds,
        "machine": measurement.describe_machine(resources.torch_device, resources.cores),
    }

    def earlier() -> dict[str, Any]:
        hint = "add --overwrite to measure again, or choose another folder with -o"
        return read_json(folder / BENCH, needed=("complete", *wanted), hint=hint)

    if output.keeps(folder / BENCH, lambda: wanted.items() <= earlier().items()) and earlier()["complete"]:
        console.note(f"{folder} is complete; add --overwrite to measure again")
        return earlier()
    load = measurement.load_average()
    if measurement.is_busy(load):
        console.warn(f"other programs use the processors (load average {load:.1f}): times will be too long and vary")
    kernels.prepare(console.note, resources.torch_device)
    about = {"source": str(path), **wanted, "load_average": load}
    how = {"resources": resources, "seconds": seconds}
    latest: list[Point] = []

    def save(points: Sequence["Point"]) -> None:
        latest[:] = points
        write_results(folder, about, latest, complete=False)

    with console.stage(f"bench {path.name}") as reporter:
        if scene is None:
            measurement.measure_renderings(run, **how, save=save, tell=reporter.progress)
        else:
            measurement.measure_trainings(scene, folder, **how, save=save, tell=reporter.progress)
    content = write_results(folder, about, latest, complete=True)
    console.table(COLUMNS, table_of(latest), styles=_STYLES)
    return content
