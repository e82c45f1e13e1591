"""nerfcli ct info: what a scan, a reconstruction or a volume contains."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.info import lines_of
from nerfcli.cli.options import Json


@command
def info(
    path: Annotated[
        str,
        typer.Argument(help="Scan in any format, run, or exported volume; - to read paths from standard input."),
    ],
    json: Json = False,
) -> None:
    """Show what a scan, a run or a volume contains.

    \b
    scan            geometry, beam, values, unit, views held out
    run             voxels, passes, what was decided by the data
    volume          (NRRD, MHA, NIfTI, TIFF) voxels, position, unit, range of values

    \b
    Examples:
      nerfcli ct info tooth
      nerfcli ct info tooth-run --json
    """
    console = Console(quiet=True, json_lines=json)

    def work(found: Path, one_of_many: bool) -> None:
        from nerfcli.ct.describe import describe

        content = describe(found)
        console.facts(found, content, "\n".join([str(found), *(f"  {line}" for line in lines_of(content))]))

    for_each_input(path, work, command="ct info")
