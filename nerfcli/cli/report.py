"""nerfcli report: one page about one or more runs."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import STDIN, no_paths, stdin_paths
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json, Output, Overwrite, Quiet, Threads
from nerfcli.machine import thread_count


@command
def report(
    runs: Annotated[
        list[str], typer.Argument(help="Run folders written by train, or - to read paths from standard input.")
    ],
    output: Output = None,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write a self-contained HTML page about one or more runs.

    Shows metrics, warnings, held-out photos next to their renderings (with a slider, error maps, depth and coverage:
    how many training photos see the surface), training curves, capture, poses, speed, settings and versions. Writes
    RUN/report.html, or report.html next to the first of several runs.

    \b
    Examples:
      nerfcli report photos-scene-run
      nerfcli report small-run large-run -o comparison.html
      ls -d *-run/ | nerfcli report - -o all.html
    """
    from nerfcli.workflows.report import report_runs

    console = Console(quiet=quiet, json_lines=json)
    paths = list(stdin_paths()) if runs == [STDIN] else [Path(run) for run in runs]
    if not paths:
        raise no_paths("report")
    with console.progress("report") as update:
        page = report_runs(
            paths,
            output,
            threads=thread_count(threads),
            overwrite=overwrite,
            progress=update,
        )
    console.result(page)
