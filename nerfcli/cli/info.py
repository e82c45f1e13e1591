"""nerfcli info: show what a folder or a file contains."""

from json import dumps
from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.info_text import lines_of, words_of
from nerfcli.cli.options import Json
from nerfcli.workflows.machine import thread_count


@command
def info(
    path: Annotated[
        str | None,
        typer.Argument(help="Scene, run, renders, or one of their files; - to read paths from standard input."),
    ] = None,
    machine: Annotated[
        bool, typer.Option("--machine", help="Show processors, GPUs, versions, and which kernels run on each device.")
    ] = False,
    json: Json = False,
) -> None:
    """Show what a scene, a run or one of their files contains.

    \b
    scene       cameras, photos, missing files, split, unit; also of captures that nerfcli convert makes a scene
    run         settings, time, metrics, how far refined cameras moved; bytes of weights and optimizer, operations and
                memory traffic per sample and picture, next to other types of field of the same size
    depth file  (TIFF, EXR, NPZ, NPY, PNG; also pictures, videos and folders of renders) definition, axis, unit and its
                source, invalid value, camera, run, range of values; for files of other programs, what is not stated
    failure     (saved by train) which numbers became non-finite, where, and whether that repeats

    \b
    Examples:
      nerfcli info photos-scene
      nerfcli info photos-scene-run --json
      nerfcli info --machine
      nerfcli info photos-scene-run/failure-1200.safetensors
      nerfcli info photos-scene-run/renders/test-conditional-z/depth/a.tiff
    """
    from nerfcli.workflows.describe import describe

    console = Console(quiet=True, json_lines=json)
    if machine == (path is not None):
        raise typer.BadParameter("give a path, or --machine", param_hint="PATH")
    if path is None:
        from nerfcli.kernels.devices import describe_machine

        described = describe_machine(thread_count(0))
        typer.echo(dumps(described) if json else "\n".join(f"{name}: {value}" for name, value in described.items()))
        return

    def work(folder: Path, one_of_many: bool) -> None:
        content = describe(folder)
        lines = words_of(content) if "in_words" in content else lines_of(content)
        console.facts(folder, content, "\n".join([str(folder), *(f"  {line}" for line in lines)]))

    for_each_input(path, work, command="info")
