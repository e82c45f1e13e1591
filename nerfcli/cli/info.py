"""nerfcli info: what a folder or a file is, and what is in it."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.info_text import cost_lines, lines_of, words_of
from nerfcli.cli.options import Json


@command
def info(
    path: Annotated[
        str, typer.Argument(help="A scene, a run, renders, or one file of them; - for paths on standard input.")
    ],
    json: Json = False,
) -> None:
    """Say what a scene, a run or one of their files holds.

    Of a scene: cameras, photos, missing files, split, unit. Of a run: settings, time, numbers.

    \b
    Of a depth file (TIFF, EXR, NPZ, NPY, PNG), a picture, a video or a folder of renders: which depth it is, along
    which axis, in which unit and how that is known, what stands for no value, which camera saw it, which run it is of,
    and the range of its numbers. Of depth that another program wrote: what can be known, and what nobody states.
    Of a failure that a training kept: which numbers became non-finite, where, and whether they do again.

    \b
    Of a run, by arithmetic: bytes of weights, optimiser (gradients and moments) and what a step keeps; operations and
    memory traffic per sample and per picture, for its field and for the other kinds at equal storage. Where training
    refined cameras: how far they moved, as median and maximum.

    \b
    Examples:
      nerfcli info photos-scene
      nerfcli info photos-scene-run --json
      nerfcli info photos-scene-run/failure-1200.safetensors
      nerfcli info photos-scene-run/renders/test-conditional-z/depth/a.tiff
    """
    from nerfcli.workflows.describe import describe

    console = Console(quiet=True, json_lines=True)

    def work(folder: Path, one_of_many: bool) -> None:
        content = describe(folder)
        if json:
            console.result(folder, content)
        elif "in_words" in content:
            typer.echo("\n".join([str(folder), *(f"  {line}" for line in words_of(content))]))
        else:
            costs = content.pop("cost", {})
            lines = lines_of(content)
            if costs:
                lines += [f"storage and work of the {next(iter(costs))} field, and of others of as many bytes:"]
                lines += [f"  {line}" for line in cost_lines(costs)]
            typer.echo("\n".join([str(folder), *(f"  {line}" for line in lines)]))

    for_each_input(path, work)
