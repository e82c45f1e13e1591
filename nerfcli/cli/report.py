"""nerfcli report: one page about one or more runs."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import STDIN, no_paths, stdin_paths
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Device, Json, Output, Overwrite, Quiet, Threads, one_of
from nerfcli.workflows.machine import device_name, thread_count


@command
def report(
    runs: Annotated[
        list[str], typer.Argument(help="Run folders written by train, or - to read paths from standard input.")
    ],
    views: Annotated[
        int, typer.Option(help="Maximum number of held-out photos to show, from the worst to the best.", min=0)
    ] = 8,
    depth: Annotated[str, typer.Option(help="Definition of depth, as in render.")] = "conditional",
    depth_axis: Annotated[
        str | None,
        typer.Option(help="z: along the optical axis; ray: along the ray.  [default: z, ray for panoramas]"),
    ] = None,
    output: Output = None,
    device: Device = "auto",
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
      ls -d *-run/ | nerfcli report - --views 4 -o all.html
    """
    from nerfcli.render.depth import CONVENTIONS, DepthRequest, is_convention
    from nerfcli.runs.run import load_run
    from nerfcli.workflows.report import report_runs
    from nerfcli.workflows.views import Views, usual_axis

    if not is_convention(depth) or depth == "background":
        choices = ", ".join(name for name in CONVENTIONS if name != "background")
        raise typer.BadParameter(f"{depth!r}; choose {choices} or quantile:Q with 0 < Q < 1", param_hint="--depth")
    one_of(depth_axis, ("ray", "z"), "--depth-axis")
    console = Console(quiet=quiet, json_lines=json)
    paths = list(stdin_paths()) if runs == [STDIN] else [Path(run) for run in runs]
    if not paths:
        raise no_paths("report")
    with console.progress("report") as update:
        page = report_runs(
            paths,
            output,
            views=views,
            depth=DepthRequest(convention=depth, axis=depth_axis or usual_axis(load_run(paths[0]), Views("test"))),
            device=device_name(device),
            threads=thread_count(threads),
            overwrite=overwrite,
            progress=update,
        )
    console.result(page)
