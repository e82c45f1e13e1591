"""nerfcli bench: speed against error."""

import json as json_text
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.errors import UserError
from nerfcli.machine import device_name, thread_count

if TYPE_CHECKING:
    from nerfcli.bench.results import Point

_STYLES = {"yes": "green"}


@command
def bench(
    source: Annotated[str, typer.Argument(help="Run folder, or a scene; - to read paths from standard input.")],
    output: options.Output = None,
    budget: Annotated[
        str, typer.Option(help="Total time: 8m, 1h. More time allows more settings, longer trainings and more repeats.")
    ] = "8m",
    device: options.Device = "auto",
    threads: options.Threads = 0,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Measure speed against error on this scene and machine.

    Of a run: renders its field with other steps, tolerances and numbers of threads. Measures the time per picture
    (median and quartiles of interleaved rounds), peak memory, the error against the held-out photos and, separately,
    against a converged rendering of the same field. Of a scene: trains it with other sizes, batches, seeds and times.
    Run nothing else meanwhile.

    Writes SOURCE-bench/ with bench.csv, bench.json and a plot, bench.png; after an interruption they hold the results
    so far. In the column "fastest" are the settings than which none is faster with as small an error.

    \b
    Examples:
      nerfcli bench photos-scene-run
      nerfcli bench photos-scene --budget 30m -o bench/
      nerfcli bench photos-scene-run --json | jq .points[].name
    """
    seconds = options.seconds_from_text(budget)
    if seconds < 20.0:
        raise typer.BadParameter(f"{budget!r} is too short; give at least 20s", param_hint="--budget")
    console = Console(quiet=quiet, json_lines=json)

    def work(path: Path, one_of_many: bool) -> None:
        folder = result_path(path, suffix="-bench", output=output, one_of_many=one_of_many)
        how = {"device": device_name(device), "threads": thread_count(threads), "seconds": seconds}
        content = bench_one(path, folder, how, overwrite=overwrite, console=console)
        console.result(folder / "bench.csv", content)

    for_each_input(source, work, command="bench")


def bench_one(path: Path, folder: Path, how: dict[str, Any], *, overwrite: bool, console: Console) -> dict[str, Any]:
    """Measure one run or scene, or keep a complete bench of it; return the content of bench.json.

    Raises:
        UserError: the input cannot be measured, or `folder` holds something else.
    """
    from nerfcli import kernels
    from nerfcli.bench.measurement import describe_machine, is_busy, load_average, measure_renderings, measure_trainings
    from nerfcli.bench.results import BENCH, COLUMNS, Point, table_of, write_results
    from nerfcli.training.runs.run import Run

    if not path.exists():
        raise UserError(f"{path} does not exist", "give a run folder, or a scene folder")
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir()) and not (folder / BENCH).is_file()):
        raise UserError(f"{folder} exists and is not a bench folder", "choose another folder with -o")
    if not overwrite and (folder / BENCH).is_file():
        content = json_text.loads((folder / BENCH).read_text(encoding="utf-8"))
        if content["complete"]:
            console.note(f"{folder} is complete; add --overwrite to measure again")
            return content
    if is_busy(load := load_average()):
        console.warn(f"other programs use the processors (load average {load:.1f}): times will be too long and vary")
    kernels.prepare(console.note, how["device"])
    about = {"source": str(path), "machine": describe_machine(how["device"], how["threads"]), "load_average": load}
    latest: list[Point] = []

    def save(points: Sequence["Point"]) -> None:
        latest[:] = points
        write_results(folder, about, latest, complete=False)

    with console.progress(f"bench {path.name}") as tell:
        if Run(path).is_trained:
            measure_renderings(Run(path), **how, save=save, tell=tell)
        else:
            measure_trainings(path, folder, **how, save=save, tell=tell)
    content = write_results(folder, about, latest, complete=True)
    console.table(COLUMNS, table_of(latest), styles=_STYLES)
    return content
