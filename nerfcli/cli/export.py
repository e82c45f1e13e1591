"""nerfcli export: a run as a page, a mesh, points, a volume, or COLMAP's dense folder."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Device, Json, Output, Overwrite, Quiet, Threads, device_name, one_of, thread_count


@command
def export(
    run: Annotated[str, typer.Argument(help="The folder that train wrote, or - for runs on standard input.")],
    to: Annotated[str, typer.Option("--to", help="page.")],
    output: Output = None,
    device: Device = "auto",
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Export a run to a file that other programs open.

    \b
    Examples:
      nerfcli export photos-scene-run --to page
    """
    from nerfcli.workflows.export import TARGETS, default_target, export_run

    one_of(to, tuple(TARGETS), "--to")
    console = Console(quiet=quiet, json_lines=json)

    def work(folder: Path, one_of_many: bool) -> None:
        target = output
        if output is not None and one_of_many:
            target = output / default_target(folder, to).name
        with console.progress(f"export {to}") as update:
            written = export_run(
                folder,
                target,
                to=to,
                device=device_name(device),
                threads=thread_count(threads),
                overwrite=overwrite,
                notify=console.note,
                progress=update,
            )
        console.result(written)

    for_each_input(run, work)
