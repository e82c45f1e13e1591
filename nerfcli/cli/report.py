"""nerfcli report: one page about a run, or about several side by side."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import STDIN, stdin_paths
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Device, Json, Output, Overwrite, Quiet, Threads, device_name, one_of, thread_count
from nerfcli.errors import UserError


@command
def report(
    runs: Annotated[list[str], typer.Argument(help="Folders that train wrote, or - for such on standard input.")],
    views: Annotated[int, typer.Option(help="Held-out photos to show at most, from the worst to the best.", min=0)] = 8,
    depth: Annotated[str, typer.Option(help="Convention of the depth shown, as in render.")] = "conditional",
    depth_axis: Annotated[str, typer.Option(help="z or ray.")] = "z",
    output: Output = None,
    device: Device = "auto",
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write a self-contained page about a run, or about several.

    Numbers, everything that was warned about, held-out photos beside what the run renders of them (with a border that
    moves, error maps and depth in its convention), training curves against seconds, capture, poses, speed, settings and
    versions. One run: RUN/report.html; several: report.html beside the first.

    \b
    Examples:
      nerfcli report photos-scene-run
      nerfcli report small-run large-run -o comparison.html
      ls -d *-run/ | nerfcli report - --views 4 -o all.html
    """
    from nerfcli.render.depth import DepthRequest, is_convention
    from nerfcli.workflows.report import report_runs

    if not is_convention(depth) or depth == "background":
        raise typer.BadParameter(f"{depth!r}; choose one that render --help names", param_hint="--depth")
    one_of(depth_axis, ("ray", "z"), "--depth-axis")
    console = Console(quiet=quiet, json_lines=json)
    paths = list(stdin_paths()) if runs == [STDIN] else [Path(run) for run in runs]
    if not paths:
        raise UserError("no run was given", "give the folders that nerfcli train wrote")
    with console.progress("report") as update:
        page = report_runs(
            paths,
            output,
            views=views,
            depth=DepthRequest(convention=depth, axis=depth_axis),
            device=device_name(device),
            threads=thread_count(threads),
            overwrite=overwrite,
            progress=update,
        )
    console.result(page)
