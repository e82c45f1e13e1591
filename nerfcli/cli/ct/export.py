"""nerfcli ct export: the volume of a reconstruction for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json, Output, Overwrite, Quiet, one_of
from nerfcli.cli.render_options import finite
from nerfcli.ct.recognise import VOLUMES


@command
def export(
    run: Annotated[
        str, typer.Argument(help="Run folder that nerfcli ct train wrote, or - to read paths from standard input.")
    ],
    output: Output = None,
    form: Annotated[
        str | None,
        typer.Option("--format", help="nrrd, mha, nii or tif, if -o does not say it.  [default: nrrd]"),
    ] = None,
    water: Annotated[
        float | None, typer.Option(help="Attenuation of water, so that values are Hounsfield units.")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Export the volume of a reconstruction.

    Writes RUN-volume.nrrd: attenuation in the inverse of the unit of the scan, with position and size of the voxels;
    NaN where no view sees. A second file marks voxels that the views do not determine; see docs/tomography.md.

    \b
    Examples:
      nerfcli ct export tooth-run -o tooth.nrrd
      nerfcli ct export tooth-run --format mha --water 0.02
    """
    finite(water, "--water")
    if water is not None and water <= 0:
        raise typer.BadParameter(f"{water:g} is not a positive attenuation", param_hint="--water")
    suffix = "nrrd" if form is None else form.lstrip(".").lower()
    one_of(suffix, [known[1:] for known in VOLUMES], "--format")
    console = Console(quiet=quiet, json_lines=json)

    def work(folder: Path, one_of_many: bool) -> None:
        from nerfcli.ct.export import export_scan

        usual = folder.with_name(f"{folder.name}-volume.{suffix}")
        target = usual if output is None else output / usual.name if one_of_many else output
        if form is not None and target.suffix.lower() != f".{suffix}":
            raise typer.BadParameter(f"{form!r} contradicts -o {output}; remove one of them", param_hint="--format")
        for path in export_scan(folder, target, water=water, overwrite=overwrite, notify=console.note):
            console.result(path)

    for_each_input(run, work, command="ct export")
