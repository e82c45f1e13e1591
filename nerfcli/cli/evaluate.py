"""nerfcli evaluate: metrics of runs on their held-out photos."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import STDIN, Given, for_each_input, for_each_path
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Computing, Overwrite, Printing, Require, one_of
from nerfcli.output import Output

if TYPE_CHECKING:
    from nerfcli.evaluate.protocol import RunMetrics
    from nerfcli.evaluate.requirements import Requirement
    from nerfcli.workflows.evaluate import Evaluation

_COLUMNS = {"as rendered": "", "unrounded": "_float", "colours aligned": "_colour_aligned"}
_MEASURES = (("psnr", 2), ("ssim", 4), ("lpips", 4))


@command
def evaluate(
    runs: Annotated[
        list[str], typer.Argument(help="Run folders written by train, or - to read paths from standard input.")
    ],
    *,
    save_predictions: Annotated[
        str | None, typer.Option(help="png: save the compared pictures in RUN/predictions; float: also unrounded.")
    ] = None,
    splats: Annotated[
        Path | None, typer.Option(help="A .ply or .spz of splats, measured on the held-out photos beside the field.")
    ] = None,
    require: Require = None,
    computing: Computing,
    overwrite: Overwrite = False,
    printing: Printing,
) -> None:
    """Evaluate runs on their held-out photos.

    Writes RUN/metrics.json: PSNR, SSIM and LPIPS per photo and their means, for 8-bit and for unrounded pictures and
    after a colour correction; training and render time; the distance of each view from the nearest training view; and
    which stages have used held-out photos.

    \b
    Examples:
      nerfcli evaluate photos-scene-run
      nerfcli evaluate photos-scene-run --json | jq .mean.psnr
      nerfcli evaluate photos-scene-run --require "psnr>=25,registered>=0.9"
      nerfcli evaluate photos-scene-run --save-predictions png --overwrite
      nerfcli evaluate first-run second-run third-run
      nerfcli evaluate photos-scene-run --splats photos-scene-run-splats.ply
    """
    from nerfcli.evaluate.photos import KINDS
    from nerfcli.training.runs.run import Run
    from nerfcli.workflows.evaluate import check_requirements, evaluate_run, evaluate_splats

    one_of(save_predictions, KINDS, "--save-predictions")
    if splats is not None and (len(runs) > 1 or STDIN in runs):
        raise typer.BadParameter("give only one run: splats belong to one", param_hint="--splats")
    if splats is not None and not splats.is_file():
        raise typer.BadParameter(f"there is no {splats}", param_hint="--splats")
    if STDIN in runs and len(runs) > 1:
        raise typer.BadParameter("- cannot be combined with other runs", param_hint="RUNS")
    console, requirements = printing.console, requirements_of(require)
    resources, output = computing.resources, Output(None, overwrite)
    _ = resources.torch_device  # refuses an unknown one before anything is read

    def measure(folder: Path) -> "RunMetrics":
        with console.stage("evaluate") as reporter:
            found = evaluate_run(folder, output, predictions=save_predictions, resources=resources, reporter=reporter)
        show_evaluation(found, console)
        return found.metrics

    def work(given: Given) -> None:
        found = measure(given.path)
        if splats is not None:
            with console.stage("evaluate splats") as reporter:
                of_splats = evaluate_splats(given.path, splats, output, resources=resources, reporter=reporter)
            show_evaluation(of_splats, console, field=found)
        check_requirements(Run(given.path), found, requirements)

    if len(runs) == 1:
        for_each_input(runs[0], work, command="evaluate")
        return
    for_each_path(map(Path, runs), work, command="evaluate")


def requirements_of(text: str | None) -> "tuple[Requirement, ...]":
    """Parse the requirements of --require."""
    from nerfcli.evaluate.requirements import parse_requirements

    try:
        return () if text is None else parse_requirements(text)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--require") from error


def show_evaluation(evaluation: "Evaluation", console: Console, *, field: "RunMetrics | None" = None) -> None:
    """Print metrics, those of splats beside those of the field, and their path."""
    if field is not None:
        _print_beside_field(field, evaluation, console)
    elif not evaluation.is_kept:
        _print_numbers(evaluation.path.parent, evaluation.metrics, console)
    console.result(evaluation.path, evaluation.metrics.to_json())


def _print_numbers(run: Path, metrics: "RunMetrics", console: Console) -> None:
    from nerfcli.evaluate.ledger import summary_line

    assert metrics.training is not None
    mean, kinds = metrics.mean, metrics.kinds
    console.note(
        f"{run}: PSNR {mean.psnr:.2f} dB, SSIM {_number(mean.ssim, 3)} on {len(metrics.images)} held-out photos; "
        f"trained {metrics.training.seconds:.0f} s, {metrics.seconds_per_image:.2f} s per picture"
    )
    numbers = vars(mean)
    rows = [
        (name, *(_number(numbers.get(f"{measure}{key}"), digits) for measure, digits in _MEASURES))
        for name, key in _COLUMNS.items()
        if numbers[f"psnr{key}"] is not None
    ]
    console.table(("", "PSNR", "SSIM", "LPIPS"), rows, styles={})
    if metrics.shape is not None and metrics.shape.shown:
        console.note(metrics.shape.in_words())
    if kinds:
        where = {"interpolation": "between", "extrapolation": "beyond"}
        parts = [
            f"{count} {where[kind]} training views, {of_kind.psnr:.2f} dB" for kind, (count, of_kind) in kinds.items()
        ]
        console.note(f"held-out views: {'; '.join(parts)}")
    console.note(summary_line(metrics.ledger))
    for text in metrics.warnings:
        console.warn(text)


def _print_beside_field(field: "RunMetrics", splats: "Evaluation", console: Console) -> None:
    """Print the metrics of splats below those of the field, as rendered in 8 bit."""
    rows = [
        (
            name,
            *(_number(getattr(metrics.mean, measure), digits) for measure, digits in _MEASURES),
            f"{1000 * metrics.seconds_per_image:.0f}",
        )
        for name, metrics in (("field", field), ("splats", splats.metrics))
    ]
    console.table(("", "PSNR", "SSIM", "LPIPS", "ms per picture"), rows, styles={})


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
