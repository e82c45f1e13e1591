"""nerfcli run: all stages, from photos to splats, a video, a report and depth maps."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import command
from nerfcli.cli.poses import PhotoOptions
from nerfcli.errors import in_shell

if TYPE_CHECKING:
    from nerfcli.workflows.evaluate import Evaluation


@command
def run(
    photos: Annotated[
        str,
        typer.Argument(
            help="Folder of photos, zip archive of one, video, or capture with poses; or - to read paths from standard "
            "input."
        ),
    ],
    *,
    writing: options.Writing,
    taken: PhotoOptions,
    budget: Annotated[str, typer.Option(help="Training time: 90s, 5m, 1h. Splats are refined for half of it.")] = "2m",
    training: options.Training,
    require: options.Require = None,
    printing: options.Printing,
) -> None:
    """Run all stages: poses, train, splats, video, evaluate, report.

    Writes PHOTOS-scene/, PHOTOS-scene-run/ and PHOTOS-scene-run-splats.ply next to the photos, or scene/, run/ and
    run-splats.ply inside --output. A capture with poses, such as a COLMAP project or a folder with transforms.json, is
    trained with these. The video is made from the splats. Completed stages are kept: run the same command again to
    resume an interrupted run. For other settings, run the stages one by one.

    \b
    Examples:
      nerfcli run photos/kitchen
      nerfcli run photos/kitchen -o kitchen --budget 5m
      nerfcli run photos/kitchen --intrinsics calibration/cameras.txt
      nerfcli run kitchen.mp4
      nerfcli run colmap-project
      nerfcli run photos/kitchen --require "psnr>=25,registered>=0.9"
    """
    from nerfcli.cli.evaluate import requirements_of, show_evaluation
    from nerfcli.workflows.evaluate import check_requirements
    from nerfcli.workflows.pipeline import run_pipeline
    from nerfcli.workflows.poses import without_suffix

    console, requirements = printing.console, requirements_of(require)
    settings = training.settings(budget)
    poses = taken.settings(training.seed, settings.threads)

    def work(given: Given) -> None:
        field: Evaluation | None = None

        def show(result: "Path | Evaluation") -> None:
            nonlocal field
            if isinstance(result, Path):
                console.result(result)
            else:
                show_evaluation(result, console, field=None if field is None else field.metrics)
                field = field or result

        done = run_pipeline(
            given.path,
            writing.inside(replace(given, path=without_suffix(given.path)), "-scene"),
            poses=poses,
            training=settings,
            frames=taken.frames,
            intrinsics=taken.intrinsics,
            holdout=options.holdout_rule(taken.holdout),
            resources=training.resources,
            reporter=console.reporter,
            show=show,
        )
        console.note(f"report with all results: {done.report}")
        console.note(f"next: open it in a browser, or look around: nerfcli view {in_shell(done.run.path)}")
        check_requirements(done.run, done.evaluation.metrics, requirements)

    for_each_input(photos, work, command="run")
