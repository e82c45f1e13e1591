"""nerfcli ct convert, doctor, train, info: from a scanner's files to a volume."""

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.convert import place_of
from nerfcli.cli.doctor import GATES, Gate, check_gate, show_findings
from nerfcli.cli.info import show_facts
from nerfcli.cli.options import Json, Overwrite, Printing, Threads, Writing, holdout_rule, one_of, seconds_from_text
from nerfcli.ct.recognise import OWN, recognise
from nerfcli.errors import UserError, in_shell
from nerfcli.machine import thread_count
from nerfcli.output import Output

if TYPE_CHECKING:
    from nerfcli.ct.formats.statement import ScanOptions
    from nerfcli.ct.result import ReconstructionSettings


@dataclass(frozen=True)
class ScanStatements:
    """Options of what the files do not say, or say wrongly."""

    photons: Annotated[
        float | None, typer.Option(help="Photons that an open pixel counts per view.", show_default=False)
    ] = None
    unit: Annotated[
        str | None,
        typer.Option(help="Unit of lengths in the scan, m, cm, mm, um or nm; overrides what it states."),
    ] = None
    mirrored: Annotated[
        bool, typer.Option("--mirrored", help="Columns are numbered from the other side than stated.")
    ] = False
    centre_of_rotation: Annotated[
        float | None, typer.Option(help="The column of the axis of rotation; 0 is the middle of the first.")
    ] = None

    def given(self) -> "ScanOptions":
        """Return the statements."""
        from nerfcli.ct.formats.statement import ScanOptions

        return ScanOptions(self.photons, self.unit, self.centre_of_rotation, mirrored=self.mirrored)


@command
def convert(
    source: Annotated[
        str, typer.Argument(metavar="IN", help="Scan: file or folder, or - to read paths from standard input.")
    ],
    target: Annotated[
        Path, typer.Argument(metavar="SCAN", help="Folder to write; with -, the folder that will contain the results.")
    ],
    *,
    stated: ScanStatements,
    holdout: Annotated[
        str | None,
        typer.Option(help="Views to hold out: every:6, block:0.15, or a file with numbers.", show_default=False),
    ] = None,
    overwrite: Overwrite = False,
    printing: Printing,
) -> None:
    """Convert a scan to a scan folder.

    \b
    Formats read: DataExchange and NXtomo (.h5, .nxs), Nikon (.xtekct), SkyScan (.log), HelTomo (.mat), R2-Gaussian
    (meta_data.json), pictures with a scan.json that states what they are; see docs/tomography.md.

    SCAN/scene.json has ASTRA's vectors.

    \b
    Examples:
      nerfcli ct convert tooth.h5 tooth
      nerfcli ct convert tooth.h5 tooth --centre-of-rotation 295.8 --overwrite
      ls *.xtekct | nerfcli ct convert - scans/
    """
    console, statements = printing.console, replace(stated.given(), holdout=holdout_rule(holdout))

    def work(given: Given) -> None:
        from nerfcli.ct.convert import convert_scan

        place = place_of(given, target)
        record = convert_scan(given.path, Output(place, overwrite), given=statements, reporter=console.reporter)
        console.result(place, record)

    for_each_input(source, work, command="ct convert")


@command
def doctor(
    scan: Annotated[str, typer.Argument(help="Scan in any format, or - to read paths from standard input.")],
    *,
    stated: ScanStatements,
    writing: Writing,
    require: Gate = None,
    printing: Printing,
) -> None:
    """Check a scan for problems before the reconstruction.

    Checks I > I0, drift, rings, counts, truncation, missing directions, the side that columns are numbered from, the
    direction and the centre of rotation, and beam hardening. Prints a table on stderr and writes a page with the
    sinogram next to the scan, SCAN-doctor.html. Each finding is good, look or bad, with its number, its threshold and
    advice.

    \b
    Examples:
      nerfcli ct doctor tooth.h5 --unit um
      nerfcli ct doctor tooth --require look
    """
    one_of(require, GATES, "--require")
    console, statements = printing.console, stated.given()

    def work(given: Given) -> None:
        from nerfcli.ct.examine import examine

        page = writing.beside(given, "-doctor.html")
        with console.stage(f"doctor {given.path.name}") as reporter:
            diagnosis = examine(given.path, page, given=statements, reporter=reporter)
        show_findings(diagnosis, page.at(given.path), diagnosis.record, console)
        check_gate(diagnosis.findings, require)

    for_each_input(scan, work, command="ct doctor")


DEFAULT_BUDGET = "2m"
_AIR = {"auto": None, "measured": True, "stated": False}


@dataclass(frozen=True)
class FitOptions:
    """Options of the fit, and of what is otherwise estimated."""

    budget: Annotated[
        str | None, typer.Option(help="Time for everything: 90s, 5m; 90 is 90 s.  [default: 2m, or none with --passes]")
    ] = None
    passes: Annotated[
        int | None, typer.Option(help="Total passes over all views; results repeat bit for bit.", min=1)
    ] = None
    voxel_size: Annotated[
        float | None,
        typer.Option(help="Side of a voxel, in the unit of the scan.  [default: a pixel where the object is]"),
    ] = None
    tv: Annotated[float, typer.Option(help="Weight of total variation; 1 suits the noise of most scans.")] = 1.0
    centre: Annotated[
        float | None,
        typer.Option(help="Columns from where the scan says to the centre of rotation.  [default: estimated]"),
    ] = None
    tilt: Annotated[
        float | None, typer.Option(help="Rotation of the detector in its plane, in degrees.  [default: estimated]")
    ] = None
    air: Annotated[
        str,
        typer.Option(
            help="Open beam of each view: measured in its pixels beside the object; stated: as the scan says; auto: "
            "measured if it varies by more than the noise."
        ),
    ] = "auto"
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue the run, with its settings, to the new total; start if there is none."),
    ] = False

    def settings(self, threads: int) -> "ReconstructionSettings":
        """Return the settings that the options select.

        Raises:
            typer.BadParameter: a value is unknown or cannot be parsed.
        """
        from nerfcli.ct.result import ReconstructionSettings

        one_of(self.air, _AIR, "--air")
        budget = self.budget or (DEFAULT_BUDGET if self.passes is None else None)
        return ReconstructionSettings(
            budget_seconds=None if budget is None else seconds_from_text(budget),
            passes=self.passes,
            voxel_size=self.voxel_size,
            strength=self.tv,
            centre=None if self.centre is None else -self.centre,  # the detector is moved the other way
            tilt=None if self.tilt is None else math.radians(self.tilt),
            air=_AIR[self.air],
            threads=thread_count(threads),
        )


@command
def train(
    scan: Annotated[
        str, typer.Argument(help="Scan folder that nerfcli ct convert wrote, or - to read paths from standard input.")
    ],
    *,
    writing: Writing,
    fit: FitOptions,
    threads: Threads = 0,
    printing: Printing,
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
    settings, console = fit.settings(threads), printing.console

    def work(given: Given) -> None:
        from nerfcli.ct.train import train_scan

        _refuse_other_formats(given.path)
        run = writing.beside(given, "-run")
        with console.stage(f"train {given.path.name}") as reporter:
            train_scan(given.path, run, settings, resume=fit.resume, reporter=reporter)
        console.result(run.at(given.path))

    for_each_input(scan, work, command="ct train")


def _refuse_other_formats(path: Path) -> None:
    form = recognise(path)
    if form is None:
        what = "is not a scan folder" if os.path.exists(path) else "does not exist"
        raise UserError(f"{path} {what}", "give a folder that nerfcli ct convert wrote")
    if form != OWN:
        line = f"nerfcli ct convert {in_shell(path)} SCAN"
        raise UserError(f"{path} is a scan in a scanner's format", f"convert it first: {line}")


@command
def info(
    path: Annotated[
        str,
        typer.Argument(help="Scan in any format, or run; - to read paths from standard input."),
    ],
    json: Json = False,
) -> None:
    """Show what a scan or a run contains.

    \b
    scan            geometry, beam, values, unit, views held out
    run             voxels, passes, what was decided by the data

    \b
    Examples:
      nerfcli ct info tooth
      nerfcli ct info tooth-run --json
    """
    console = Console(quiet=True, json_lines=json)

    def work(given: Given) -> None:
        from nerfcli.ct.convert import describe

        show_facts(given.path, describe(given.path), console)

    for_each_input(path, work, command="ct info")
