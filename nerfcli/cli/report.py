"""nerfcli report: one page about a run, or about several side by side."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import STDIN, stdin_paths
from nerfcli.cli.console import Console, command
from nerfcli.cli.evaluation import held_out_photos
from nerfcli.cli.options import Device, Json, Output, Overwrite, Quiet, Threads, device_name, thread_count
from nerfcli.errors import UserError

if TYPE_CHECKING:
    from nerfcli.render.depth import DepthRequest


@command
def report(
    runs: Annotated[list[str], typer.Argument(help="Folders that train wrote, or - for such on standard input.")],
    views: Annotated[int, typer.Option(help="Held-out photos to show at most, from the worst to the best.", min=0)] = 8,
    depth: Annotated[str, typer.Option(help="Convention of the depth shown, as in render.")] = "conditional",
    depth_axis: Annotated[str, typer.Option(help="z or ray.")] = "z",
    output: Output = None,
    device: Device = "auto",
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write a self-contained page about a run, or about several.

    Numbers, everything that was warned about, held-out photos beside what the run renders of them (with a border that
    moves, error maps and depth in its convention), training curves against seconds, capture, poses, speed, settings and
    versions. One run: RUN/report.html; several: report.html beside the first.

    \b
    Examples:
      nerfcli report photos-scene-run
      nerfcli report small-run large-run -o comparison.html
      ls -d *-run/ | nerfcli report - --views 4 -o all.html
    """
    from nerfcli.pages.page import refuse_foreign, write_page
    from nerfcli.render.depth import DepthRequest, is_convention
    from nerfcli.report.page import mark_of

    if not is_convention(depth) or depth == "background":
        raise typer.BadParameter(f"{depth!r}; choose one that render --help names", param_hint="--depth")
    if depth_axis not in ("ray", "z"):
        raise typer.BadParameter(f"{depth_axis!r}; choose ray or z", param_hint="--depth-axis")
    console = Console(quiet=quiet, json_lines=json)
    paths = list(stdin_paths()) if runs == [STDIN] else [Path(run) for run in runs]
    if not paths:
        raise UserError("no run was given", "give the folders that nerfcli train wrote")
    target = output or (paths[0] / "report.html" if len(paths) == 1 else paths[0].resolve().parent / "report.html")
    if target.is_dir():
        raise UserError(f"{target} is a folder", "give the page's file name with -o")
    if not overwrite:
        refuse_foreign(target, mark_of(paths), about="report")
    request = DepthRequest(convention=depth, axis=depth_axis)
    text = report_page(
        paths, views=views, depth=request, device=device_name(device), threads=thread_count(threads), console=console
    )
    write_page(text, target)
    console.result(target)


def report_page(
    paths: list[Path], *, views: int, depth: "DepthRequest", device: str, threads: int, console: Console
) -> str:
    """The page about some runs, for which it renders held-out photos.

    Raises:
        UserError: a folder is not a run, or its photos cannot be read.
    """
    import hashlib

    import torch

    from nerfcli.export.settings import depth_meta
    from nerfcli.render.model import load_model
    from nerfcli.report.facts import labels_of, read_facts
    from nerfcli.report.page import page_html
    from nerfcli.report.views import common_names, look_at
    from nerfcli.runs.folder import FIELD, read_config

    torch.set_num_threads(threads)
    facts, hashes = [], []
    for path, label in zip(paths, labels_of(paths), strict=True):
        read_config(path)  # says what a folder lacks that is not a run
        hashes.append(hashlib.sha256(_bytes_of(path / FIELD)).hexdigest())
        facts.append(read_facts(path, label, checkpoint_sha256=hashes[-1]))
    names = common_names(facts, views)
    looks, meanings = [], []
    with console.progress("report") as update:
        for index, run in enumerate(facts):

            def on_share(share: float, index: int = index, label: str = run.label) -> None:
                update((index + share) / len(paths), label)

            model = load_model(run.path / FIELD, device)
            if model.sha256 != hashes[index]:
                raise UserError(
                    f"{run.path / FIELD} was replaced while the report was made",
                    "give the command again when the training is over",
                )
            frames = [frame for frame in run.frames["test"] if frame.name in names]
            held_out = held_out_photos(run.config, frames, model=model, threads=threads)
            compared = [photo for photo in held_out if photo.used is None or photo.used.any()]
            looks.append(look_at(model, compared, depth=depth, on_share=on_share))
            meanings.append(depth_meta(model, depth))
    return page_html(facts, looks, depth=meanings[0])


def _bytes_of(field: Path) -> bytes:
    try:
        return field.read_bytes()
    except OSError as error:
        raise UserError(f"{field} cannot be read: {error.strerror}", "train first, or give another run") from error
