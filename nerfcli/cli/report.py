"""nerfcli report: one page about one or more runs."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import STDIN, no_paths, stdin_paths
from nerfcli.cli.console import command
from nerfcli.cli.options import Printing, Threads, Writing
from nerfcli.machine import Resources
from nerfcli.notices import silent
from nerfcli.output import Output


@command
def report(
    runs: Annotated[
        list[str], typer.Argument(help="Run folders written by train, or - to read paths from standard input.")
    ],
    *,
    writing: Writing,
    threads: Threads = 0,
    printing: Printing,
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

    console, output = printing.console, Output(writing.output, writing.overwrite)
    paths = list(stdin_paths()) if runs == [STDIN] else [Path(run) for run in runs]
    if not paths:
        raise no_paths("report")
    with console.stage("report") as reporter:
        page = report_runs(paths, output, resources=Resources(threads), reporter=replace(reporter, note=silent))
    console.result(page)
