"""nerfcli ct evaluate, render, export: what becomes of a volume."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Overwrite, Printing, Threads, Writing, finite, one_of, some_of
from nerfcli.ct.recognise import VOLUMES
from nerfcli.machine import Resources
from nerfcli.output import Output, beside

if TYPE_CHECKING:
    from nerfcli.ct.evaluate import ScanEvaluation

RunFolder = Annotated[
    str, typer.Argument(help="Run folder that nerfcli ct train wrote, or - to read paths from standard input.")
]


@command
def evaluate(
    run: RunFolder,
    *,
    reference: Annotated[
        Path | None,
        typer.Option(help="Run folder of a reconstruction from more views, to compare with; it is not the truth."),
    ] = None,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    printing: Printing,
) -> None:
    """Evaluate a reconstruction on its held-out views.

    Writes RUN/metrics.json: line integrals of held-out views (rms, dB, chi-square against the noise), the volume where
    the scan names a true one, and the same of filtered back-projection from the same views.

    \b
    Examples:
      nerfcli ct evaluate tooth-run
      nerfcli ct evaluate tooth-run --json | jq .methods.nerfcli.volume.psnr
      nerfcli ct evaluate tooth-15-views-run --reference tooth-run
    """
    from nerfcli.ct.evaluate import evaluate_scan

    console, output, resources = printing.console, Output(None, overwrite), Resources(threads)

    def work(given: Given) -> None:
        with console.stage("evaluate") as reporter:
            found = evaluate_scan(given.path, output, reference=reference, resources=resources, reporter=reporter)
        if not found.is_kept:
            _print_numbers(given.path, found, console)
        console.result(found.path, found.metrics)

    for_each_input(run, work, command="ct evaluate")


def _print_numbers(run: Path, evaluation: "ScanEvaluation", console: Console) -> None:
    metrics = evaluation.metrics
    console.note(f"{run}: {metrics['fitted_views']} fitted views, {metrics['held_out_views']} held out")
    columns = ["", "rms of line integrals", "dB", "chi-square", "volume dB", "SSIM"]
    if metrics["reference"] is not None:
        columns += ["dB to reference", "SSIM"]
    rows = []
    for name, found in metrics["methods"].items():
        cells = [
            *_cells(found["projections"], {"rms": 4, "psnr": 2, "chi_square": 3}),
            *_cells(found["volume"], {"psnr": 2, "ssim": 3}),
            *_cells(found["against_reference"], {"psnr": 2, "ssim": 3}),
        ]
        rows.append((name, *cells[: len(columns) - 1]))
    console.table(columns, rows, styles={})
    if metrics["reference"] is not None:
        console.note(f"the reference {metrics['reference']['run']} is a reconstruction, not the truth")
    peaks = [found["projections"]["peak"] for found in metrics["methods"].values() if found["projections"]]
    if peaks:
        console.note(f"dB of projections refer to a line integral of {max(peaks):.3g}; chi-square: 1 is noise alone")


def _cells(scores: dict[str, Any] | None, digits: dict[str, int]) -> list[str]:
    found = scores or {}
    return ["-" if found.get(name) is None else f"{found[name]:.{count}f}" for name, count in digits.items()]


@command
def render(
    run: RunFolder,
    *,
    cameras: Annotated[str, typer.Option(help="Views: test, the held-out ones, or train.")] = "test",
    outputs: Annotated[
        str, typer.Option(help="Any of projection, transmission, residual, with commas between them.")
    ] = "projection",
    slices: Annotated[
        list[str] | None,
        typer.Option(help="Slices instead of views: z=0.3, a position in the unit of the scan. Repeatable."),
    ] = None,
    writing: Writing,
    threads: Threads = 0,
    printing: Printing,
) -> None:
    """Render projections of a reconstruction, or slices through it.

    Writes float32 TIFF, with a PNG to look at, to RUN/renders/. residual is the measured minus the predicted line
    integral in units of its noise. With a slice come the marks of what the views do not determine.

    \b
    Examples:
      nerfcli ct render tooth-run --outputs projection,residual
      nerfcli ct render tooth-run --slices z=0 --slices x=12.5
    """
    from nerfcli.ct.render import OUTPUTS, render_scan

    chosen = some_of(outputs, OUTPUTS, "--outputs")
    one_of(cameras, ("test", "train"), "--cameras")
    cuts = tuple(map(_slice_of, slices or ()))
    console, resources = printing.console, Resources(threads)

    def work(given: Given) -> None:
        output = writing.inside(given, "")
        with console.stage("render") as reporter:
            for path in render_scan(
                given.path, output, outputs=chosen, views=cameras, slices=cuts, resources=resources, reporter=reporter
            ):
                console.result(path)

    for_each_input(run, work, command="ct render")


def _slice_of(text: str) -> tuple[str, float]:
    axis, _, value = text.partition("=")
    try:
        position = float(value)
    except ValueError:
        position = float("nan")
    if axis not in ("x", "y", "z") or position != position:
        raise typer.BadParameter(f"{text!r}; write x=, y= or z= and a position, as in z=0.3", param_hint="--slices")
    return axis, position


@command
def export(
    run: RunFolder,
    *,
    writing: Writing,
    form: Annotated[
        str | None,
        typer.Option("--format", help="nrrd, mha, nii or tif, unless the suffix of -o determines it.  [default: nrrd]"),
    ] = None,
    water: Annotated[float | None, typer.Option(help="Write Hounsfield units, given the attenuation of water.")] = None,
    printing: Printing,
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
    console = printing.console

    def work(given: Given) -> None:
        from nerfcli.ct.export import export_scan

        usual = beside(given.path, f"-volume.{suffix}")
        target = writing.named(given, usual)
        if form is not None and target.at(usual).suffix.lower() != f".{suffix}":
            message = f"{form!r} contradicts -o {writing.output}; remove one of them"
            raise typer.BadParameter(message, param_hint="--format")
        for path in export_scan(given.path, target, water=water, reporter=console.reporter):
            console.result(path)

    for_each_input(run, work, command="ct export")
