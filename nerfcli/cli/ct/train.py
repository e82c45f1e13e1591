"""nerfcli ct train: from a scan to a volume."""

import math
from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.cli.train import DEFAULT_BUDGET
from nerfcli.machine import thread_count

_AIR = {"auto": None, "measured": True, "stated": False}


@command
def train(
    scan: Annotated[
        str, typer.Argument(help="Scan folder that nerfcli ct convert wrote, or - to read paths from standard input.")
    ],
    output: options.Output = None,
    budget: Annotated[
        str | None, typer.Option(help="Time for everything: 90s, 5m; 90 is 90 s.  [default: 2m, or none with --passes]")
    ] = None,
    passes: Annotated[
        int | None, typer.Option(help="Total passes over all views; results repeat bit for bit.", min=1)
    ] = None,
    voxel_size: Annotated[
        float | None,
        typer.Option(help="Side of a voxel, in the unit of the scan.  [default: a pixel where the object is]"),
    ] = None,
    tv: Annotated[float, typer.Option(help="Weight of total variation; 1 suits the noise of most scans.")] = 1.0,
    centre: Annotated[
        float | None,
        typer.Option(help="Columns from where the scan says to the centre of rotation.  [default: estimated]"),
    ] = None,
    tilt: Annotated[
        float | None, typer.Option(help="Rotation of the detector in its plane, in degrees.  [default: estimated]")
    ] = None,
    air: Annotated[
        str,
        typer.Option(
            help="Open beam of each view: measured in its pixels beside the object; stated: as the scan says; auto: "
            "measured if it varies by more than the noise."
        ),
    ] = "auto",
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the volume of the run to the new total; without one, start.")
    ] = False,
    threads: options.Threads = 0,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Fit a volume to a scan.

    The likelihood is Poisson's for counts, least squares for line integrals, with a penalty on the total variation.
    Held-out views are not read. What is estimated from the scan is printed. Writes SCAN-run/. Ctrl-C or SIGTERM saves
    the volume; --resume continues from it.

    \b
    Examples:
      nerfcli ct train tooth --budget 2m
      nerfcli ct train tooth --budget 10m --resume
      nerfcli ct train tooth --passes 30 --tv 0.3 --centre 2.5 -o sharp-run
      nerfcli ct train tooth --tilt 0 --air stated
    """
    options.one_of(air, _AIR, "--air")
    if budget is None and passes is None:
        budget = DEFAULT_BUDGET
    seconds = None if budget is None else options.seconds_from_text(budget)
    console = Console(quiet=quiet, json_lines=json)

    def work(folder: Path, one_of_many: bool) -> None:
        from nerfcli.ct.recognise import OWN, recognise
        from nerfcli.errors import UserError, in_shell

        form = recognise(folder)
        if form is None:
            what = "is not a scan folder" if folder.exists() else "does not exist"
            raise UserError(f"{folder} {what}", "give a folder that nerfcli ct convert wrote")
        if form != OWN:
            line = f"nerfcli ct convert {in_shell(folder)} SCAN"
            raise UserError(f"{folder} is a scan in a scanner's format", f"convert it first: {line}")
        from nerfcli.ct.result import ReconstructionSettings
        from nerfcli.ct.train import train_scan

        settings = ReconstructionSettings(
            budget_seconds=seconds,
            passes=passes,
            voxel_size=voxel_size,
            strength=tv,
            centre=centre,
            tilt=None if tilt is None else math.radians(tilt),
            air=_AIR[air],
            threads=thread_count(threads),
        )
        run = result_path(folder, suffix="-run", output=output, one_of_many=one_of_many)
        with console.callbacks(f"train {folder.name}") as callbacks:
            train_scan(folder, run, settings, resume=resume, overwrite=overwrite, warn=console.warn, **callbacks)
        console.result(run)

    for_each_input(scan, work, command="ct train")
