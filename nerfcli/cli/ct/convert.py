"""nerfcli ct convert: from a scanner's files to a scan folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json, Overwrite, Quiet, holdout_rule

if TYPE_CHECKING:
    from nerfcli.ct.detect import Judgement


@command
def convert(
    source: Annotated[
        str, typer.Argument(metavar="IN", help="Scan: file or folder, or - to read paths from standard input.")
    ],
    target: Annotated[
        Path | None,
        typer.Argument(metavar="SCAN", help="Folder to write; with -, the folder that will contain the results."),
    ] = None,
    detect: Annotated[
        bool, typer.Option("--detect", help="Write nothing; detect direction, side and centre of rotation.")
    ] = False,
    photons: Annotated[
        float | None, typer.Option(help="Photons that an open pixel counts per view.", show_default=False)
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of lengths in IN, m, mm, um or nm, before what IN says.")
    ] = None,
    mirrored: Annotated[
        bool, typer.Option("--mirrored", help="Columns are numbered from the other side than IN says.")
    ] = False,
    centre_of_rotation: Annotated[
        float | None, typer.Option(help="The column of the axis of rotation; 0 is the middle of the first.")
    ] = None,
    holdout: Annotated[
        str | None,
        typer.Option(help="Views to hold out: every:6, block:0.15, or a file with numbers.", show_default=False),
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Convert a scan to a scan folder.

    \b
    Formats read: DataExchange and NXtomo (.h5, .nxs), Nikon (.xtekct), SkyScan (.log), HelTomo (.mat), R2-Gaussian
    (meta_data.json), pictures with a scan.json that states what they are; see docs/tomography.md.

    SCAN/scene.json has ASTRA's vectors. What was written is read back and compared. --detect ranks the direction of
    rotation, the side that columns are numbered from, and the centre of rotation by how well they predict other views.

    \b
    Examples:
      nerfcli ct convert tooth.h5 tooth
      nerfcli ct convert tooth.h5 --detect
      nerfcli ct convert tooth.h5 tooth --centre-of-rotation 295.8 --overwrite
      ls *.xtekct | nerfcli ct convert - scans/
    """
    if detect and target is not None:
        raise typer.BadParameter("--detect writes nothing; leave SCAN out")
    if not detect and target is None:
        raise typer.BadParameter("missing; give the folder to write", param_hint="SCAN")
    console = Console(quiet=quiet, json_lines=json)
    rule = holdout_rule(holdout)

    def work(path: Path, one_of_many: bool) -> None:
        from nerfcli.ct.formats.scan_options import ScanOptions

        given = ScanOptions(photons, unit, centre_of_rotation, rule, mirrored)
        if target is None:
            from dataclasses import asdict

            from nerfcli.ct.detect import detect_scan

            with console.callbacks(f"detect {path.name}") as callbacks:
                found = detect_scan(path, given=given, **callbacks)
            record = {**asdict(found), "options": found.options}
            console.facts(path, record, "\n".join([str(path), *_table(found)]))
            return
        from nerfcli.ct.convert import convert_scan

        name = path.stem if path.is_file() else path.name
        place = target / name if one_of_many else target
        console.result(place, convert_scan(path, place, given=given, overwrite=overwrite, notify=console.note))

    for_each_input(source, work, command="ct convert")


def _table(found: "Judgement") -> list[str]:
    lines = [f"  {'reading':<52}{'axis at column':>16}{'rms error':>12}"]
    for name, reading in {"as stated": found.as_stated, "mirrored, or reversed": found.mirrored}.items():
        lines.append(f"  {name:<52}{reading.centre_column:>16.2f}{reading.rms:>12.4g}")
    verdict = {
        "holds": "as stated; the mirrored reading is worse",
        "mirrored": "mirrored or reversed; as stated is worse",
        "undecided": "the data do not decide",
    }[found.verdict]
    lines.append(
        f"  direction and side: {verdict} ({found.ratio:.3g} times, {found.standard_errors:.1f} standard errors)"
    )
    centre = f"{found.centre_column:.2f} +- {found.centre_error:.2f}"
    if found.centre_holds:
        lines.append(f"  centre of rotation: column {centre}; {found.stated_column:.2f} as stated fits as well")
    else:
        lines.append(
            f"  centre of rotation: column {centre}; {found.stated_column:.2f} as stated is {found.centre_ratio:.3g} "
            "times worse"
        )
    lines.append(f"  {found.ambiguity}")
    if found.options:
        lines.append(f"  To read it so: nerfcli ct convert IN SCAN {found.options}")
    return lines
