"""nerfcli ct doctor: check a scan before any long work."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.cli.doctor import GATES, Gate, show_findings
from nerfcli.cli.options import Json, Output, Overwrite, Quiet, one_of


@command
def doctor(
    scan: Annotated[str, typer.Argument(help="Scan in any format, or - to read paths from standard input.")],
    output: Output = None,
    require: Gate = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Check a scan for problems before any long work.

    Checks I > I0, drift, rings, counts, truncation, directions and number of views, the centre of rotation and beam
    hardening. Prints a table on stderr and writes a page with the sinogram next to the scan, SCAN-doctor.html. Each
    finding is good, look or bad, with its number, its threshold and advice.

    \b
    Examples:
      nerfcli ct doctor tooth.h5
      nerfcli ct doctor tooth --require look
    """
    one_of(require, GATES, "--require")
    console = Console(quiet=quiet, json_lines=json)

    def work(path: Path, one_of_many: bool) -> None:
        from nerfcli.ct.checks.examine import examine

        page = result_path(path, suffix="-doctor.html", output=output, one_of_many=one_of_many)
        with console.callbacks(f"doctor {path.name}") as callbacks:
            diagnosis = examine(path, page, overwrite=overwrite, **callbacks)
        show_findings(diagnosis, page, diagnosis.record, console, require=require)

    for_each_input(scan, work, command="ct doctor")
