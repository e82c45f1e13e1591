"""nerfcli ct render: projections of a reconstruction, and slices through it."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.machine import thread_count


@command
def render(
    run: Annotated[
        str, typer.Argument(help="Run folder that nerfcli ct train wrote, or - to read paths from standard input.")
    ],
    cameras: Annotated[str, typer.Option(help="Views: test, the held-out ones, or train.")] = "test",
    outputs: Annotated[
        str, typer.Option(help="Any of projection, transmission, residual, with commas between them.")
    ] = "projection",
    slices: Annotated[
        list[str] | None,
        typer.Option(help="Slices instead of views: z=0.3, a position in the unit of the scan. Repeatable."),
    ] = None,
    output: options.Output = None,
    threads: options.Threads = 0,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
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

    chosen = options.some_of(outputs, OUTPUTS, "--outputs")
    options.one_of(cameras, ("test", "train"), "--cameras")
    cuts = tuple(map(_slice_of, slices or ()))
    console = Console(quiet=quiet, json_lines=json)

    def work(folder: Path, one_of_many: bool) -> None:
        target = folder / "renders" if output is None else output / folder.name if one_of_many else output
        with console.callbacks("render") as callbacks:
            for path in render_scan(
                folder,
                target,
                outputs=chosen,
                views=cameras,
                slices=cuts,
                threads=thread_count(threads),
                overwrite=overwrite,
                **callbacks,
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
