"""nerfcli ct evaluate: errors of reconstructions on held-out views, beside other methods."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json, Overwrite, Quiet, Threads
from nerfcli.machine import thread_count

if TYPE_CHECKING:
    from nerfcli.ct.evaluate import ScanEvaluation


@command
def evaluate(
    run: Annotated[
        str, typer.Argument(help="Run folder that nerfcli ct train wrote, or - to read paths from standard input.")
    ],
    reference: Annotated[
        Path | None,
        typer.Option(help="Run folder of a reconstruction from more views, to compare with; it is not the truth."),
    ] = None,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Evaluate a reconstruction on its held-out views.

    Writes RUN/metrics.json: line integrals of held-out views (rms, dB, chi-square against the noise), the volume where
    the scan names a true one, and the same of filtered back-projection and of SART with total variation from the same
    views.

    \b
    Examples:
      nerfcli ct evaluate tooth-run
      nerfcli ct evaluate tooth-run --json | jq .methods.nerfcli.volume.psnr
      nerfcli ct evaluate tooth-15-views-run --reference tooth-run
    """
    from nerfcli.ct.evaluate import evaluate_scan

    console = Console(quiet=quiet, json_lines=json)

    def work(folder: Path, one_of_many: bool) -> None:
        with console.callbacks("evaluate") as callbacks:
            found = evaluate_scan(
                folder, threads=thread_count(threads), overwrite=overwrite, reference=reference, **callbacks
            )
        if not found.is_kept:
            _print_numbers(folder, found, console)
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
    return ["-" if scores is None else f"{scores[name]:.{count}f}" for name, count in digits.items()]
