"""nerfcli info: show what a folder or a file contains."""

import json as json_text
import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json
from nerfcli.machine import thread_count

# Maximum number of characters per line of several values; longer lines are wrapped, and their continuations indented.
WIDTH = 110


@command
def info(
    path: Annotated[
        str | None,
        typer.Argument(help="Scene, run, renders, or one of their files; - to read paths from standard input."),
    ] = None,
    machine: Annotated[
        bool, typer.Option("--machine", help="Show processors, GPUs, versions, and which kernels run on each device.")
    ] = False,
    json: Json = False,
) -> None:
    """Show what a scene, a run or one of their files contains.

    \b
    scene       cameras, photos, missing files, split, unit; in any format that nerfcli convert reads
    run         settings, components, decisions, time, metrics, how far refined cameras moved
    depth file  (TIFF, EXR, NPY, PNG; also pictures, videos and folders of renders) definition, axis, unit and its
                source, invalid value, camera, run, range of values; for files of other programs, what is not stated
    splats      (PLY, SPZ) count, degree, extent, frame, background, unit, run
    mesh        (PLY, GLB, OBJ): counts, unit, frame, run
    failure     (saved by train) which numbers became non-finite, where, and whether that repeats

    \b
    Examples:
      nerfcli info photos-scene
      nerfcli info photos-scene-run --json
      nerfcli info --machine
      nerfcli info photos-scene-run/failure-1200.safetensors
      nerfcli info photos-scene-run/renders/test-conditional-z/depth/a.tiff
    """
    from nerfcli.workflows.describe import describe

    console = Console(quiet=True, json_lines=json)
    if machine == (path is not None):
        raise typer.BadParameter("give a path, or --machine", param_hint="PATH")
    if path is None:
        from nerfcli.kernels import describe_machine

        described = describe_machine(thread_count(0))
        typer.echo(json_text.dumps(described) if json else "\n".join(lines_of(described)))
        return

    def work(given: Given) -> None:
        show_facts(given.path, describe(given.path), console)

    for_each_input(path, work, command="info")


def show_facts(path: Path, content: dict[str, Any], console: Console) -> None:
    """Print the facts about a path, one per line below it, or as a line of JSON."""
    console.facts(path, content, "\n".join([str(path), *(f"  {line}" for line in lines_of(content))]))


def lines_of(facts: dict[str, Any]) -> list[str]:
    """Format facts as "key: value"; lists and dictionaries of dictionaries below their key; no line without a value."""
    lines = []
    for key, value in facts.items():
        name = key.replace("_", " ")
        if isinstance(value, dict) and any(isinstance(entry, dict) for entry in value.values()):
            lines += [f"{name}:", *(f"  {line}" for line in lines_of(value))]
        elif isinstance(value, dict):
            listed = ", ".join(f"{part}={_plain(entry)}" for part, entry in value.items() if entry not in (None, []))
            lines += _wrapped(f"{name}: {listed}") if listed else []
        elif isinstance(value, list):
            lines += [f"{name}:", *(f"  {_plain(entry)}" for entry in value)] if value else []
        elif value not in (None, ""):
            lines.append(f"{name}: {_plain(value)}")
    return lines


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return value if isinstance(value, str) else json_text.dumps(value, ensure_ascii=False)
