"""nerfcli bench: speed against error."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.errors import UserError
from nerfcli.workflows.machine import device_name, thread_count

if TYPE_CHECKING:
    from nerfcli.bench.measurement import BenchOptions

_SWEEPS = ("both", "render", "train")
_SHORTEST_SECONDS = 20.0
_STYLES = {"in it": "green"}


@command
def bench(
    source: Annotated[
        str, typer.Argument(help="Run folder, or a scene to train first; - to read paths from standard input.")
    ],
    output: options.Output = None,
    budget: Annotated[
        str, typer.Option(help="Total time: 8m, 1h. More time allows more settings, longer trainings and more repeats.")
    ] = "8m",
    sweep: Annotated[
        str, typer.Option(help="render (rendering settings only), train (training settings only) or both.")
    ] = "both",
    device: options.Device = "auto",
    seed: options.Seed = 0,
    threads: options.Threads = 0,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Measure speed against error on this scene and machine.

    Renders one trained field with many settings and trains with many settings. Measures for each the time (median and
    quartiles of interleaved repeats), peak memory, size, the error against the held-out photos and, separately, the
    error against a converged rendering of the same field. Shows which settings are in the Pareto set, which setting
    dominates the others, and recommends settings. Run nothing else meanwhile.

    Writes SOURCE-bench/ with bench.html (plots, and the pictures behind each point), bench.csv and bench.json. An
    interrupted bench reports its results so far; run the same command again to continue.

    \b
    Examples:
      nerfcli bench photos-scene-run
      nerfcli bench photos-scene-run --sweep render --budget 3m
      nerfcli bench photos-scene --budget 30m -o bench/
      nerfcli bench photos-scene-run --json | jq -r .recommendations[].point
    """
    options.one_of(sweep, _SWEEPS, "--sweep")
    seconds = options.seconds_from_text(budget)
    if seconds < _SHORTEST_SECONDS:
        raise typer.BadParameter(
            f"{budget!r} is too short; give at least {_SHORTEST_SECONDS:g}s", param_hint="--budget"
        )
    console = Console(quiet=quiet, json_lines=json)
    from nerfcli.bench.measurement import BenchOptions
    from nerfcli.cli.scans import refuse_scan

    wanted = BenchOptions(seconds, sweep, seed)

    def work(path: Path, one_of_many: bool) -> None:
        refuse_scan(path, "bench")
        folder = result_path(path, suffix="-bench", output=output, one_of_many=one_of_many)
        page, content = bench_one(
            path,
            folder,
            wanted,
            device=device_name(device),
            threads=thread_count(threads),
            overwrite=overwrite,
            console=console,
        )
        console.result(page, content)

    for_each_input(source, work, command="bench")


def bench_one(
    path: Path, folder: Path, wanted: "BenchOptions", *, device: str, threads: int, overwrite: bool, console: Console
) -> tuple[Path, dict[str, Any]]:
    """Measure one run or scene, continue an earlier bench, and write the report, even if interrupted.

    Raises:
        UserError: the input cannot be measured, or `folder` holds something else.
        KeyboardInterrupt: passed on after the report of the measurements so far.
    """
    from nerfcli.bench.measurement import COMPLETE, measure, open_bench
    from nerfcli.bench.records import MEASURED
    from nerfcli.bench.report import discard, write_report
    from nerfcli.bench.trained_run import find_subject

    subject = find_subject(path, device=device, threads=threads, seed=wanted.seed)
    if overwrite:
        discard(folder)
    records = open_bench(subject, folder, wanted)
    if records.last(COMPLETE) is not None:
        console.note(f"{folder} is complete; add --overwrite to measure again")
    elif (folder / MEASURED).exists():
        console.note(f"resuming {folder} with {len(records.all())} measurements")
    interrupted = None
    with console.progress(f"bench {path.name}") as update:
        try:
            measure(subject, records, wanted, tell=update, notify=console.note)
        except KeyboardInterrupt as error:
            interrupted = error
    page, content = write_report(records)
    if interrupted is not None and not content["rendering"] and not content["training"]:
        raise interrupted
    _print(content, console)
    if interrupted is not None:
        console.note(f"{page} shows the measurements so far; run the same command again to continue")
        raise interrupted
    return page, content


def _print(content: dict[str, Any], console: Console) -> None:
    from nerfcli.bench.tables import RENDERING_COLUMNS, TRAINING_COLUMNS, rendering_rows, sentences, training_rows

    if content["rendering"]:
        console.table(RENDERING_COLUMNS, rendering_rows(content["rendering"]), styles=_STYLES)
    if content["training"]:
        console.table(TRAINING_COLUMNS, training_rows(content["training"]), styles=_STYLES)
    if not content["rendering"] and not content["training"]:
        raise UserError("nothing was measured yet", "give more time with --budget, or run the same command again")
    for sentence in sentences(content):
        console.note(sentence)
