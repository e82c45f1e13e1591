"""nerfcli evaluate: held-out numbers of a run, and how much they differ from seed to seed."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli.batch import STDIN, for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.evaluation import (
    billboards_of,
    held_out_photos,
    predictions_are_there,
    saved_predictions,
    tell_numbers,
    tell_spread,
)
from nerfcli.cli.options import Device, Json, Overwrite, Quiet, Require, Threads, device_name, thread_count
from nerfcli.errors import GATE_NOT_MET, UserError

if TYPE_CHECKING:
    from nerfcli.evaluate.requirements import Requirement


@dataclass(frozen=True)
class Wanted:
    """What is to be measured besides: refined poses; predictions to save, "png" or "float"; requirements."""

    align_poses: bool = False
    predictions: str | None = None
    requirements: "tuple[Requirement, ...]" = ()


@command
def evaluate(
    runs: Annotated[list[str], typer.Argument(help="Folders that train wrote, or - for such on standard input.")],
    align: Annotated[
        str | None,
        typer.Option(help="pose: also from a pose refined on the left half of each photo, measured on the right."),
    ] = None,
    seeds: Annotated[
        int, typer.Option(help="Train with this many seeds in all, and tell the spread of the numbers.", min=1)
    ] = 1,
    save_predictions: Annotated[
        str | None, typer.Option(help="png: keep what was compared in RUN/predictions; float: unrounded, too.")
    ] = None,
    require: Require = None,
    device: Device = "auto",
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Measure runs on the photos that training did not see.

    PSNR, SSIM and LPIPS, with training and render time beside them, go to RUN/metrics.json: the protocol's name, means
    and values per photo of 8-bit and of unrounded pictures, after a correction of colours, how far each view is from
    the nearest training view, and which stages have seen the held-out photos. With several runs of one scene, or with
    --seeds, mean and spread over the runs are told, too.

    \b
    Examples:
      nerfcli evaluate photos-scene-run
      nerfcli evaluate photos-scene-run --json | jq .mean.psnr
      nerfcli evaluate photos-scene-run --require "psnr>=25,registered>=0.9"
      nerfcli evaluate photos-scene-run --align pose --save-predictions png --overwrite
      nerfcli evaluate photos-scene-run --seeds 3
      nerfcli evaluate first-run second-run third-run
    """
    from nerfcli.evaluate.predictions import KINDS

    for value, choices, option in ((align, ("pose",), "--align"), (save_predictions, KINDS, "--save-predictions")):
        if value is not None and value not in choices:
            raise typer.BadParameter(f"{value!r}; choose {' or '.join(choices)}", param_hint=option)
    if STDIN in runs and (len(runs) > 1 or seeds > 1):
        raise typer.BadParameter("- stands alone: runs on standard input are measured one by one", param_hint="RUNS")
    if seeds > 1 and len(runs) > 1:
        raise typer.BadParameter("--seeds is for one run, the runs of other seeds are made", param_hint="--seeds")
    console = Console(quiet=quiet, json_lines=json)
    wanted = Wanted(align == "pose", save_predictions, requirements_of(require))
    cores, torch_device = thread_count(threads), device_name(device)

    def measure(folder: Path) -> dict[str, Any]:
        path, metrics = evaluate_run(
            folder, device=torch_device, threads=cores, overwrite=overwrite, console=console, wanted=wanted
        )
        console.result(path, metrics)
        return metrics

    def work(folder: Path, one_of_many: bool) -> None:
        hold_against(folder, measure(folder), wanted.requirements)

    if seeds == 1 and len(runs) == 1:
        for_each_input(runs[0], work)
        return
    folders = [Path(run) for run in runs]
    if seeds > 1:
        from nerfcli.cli.train import train_other_seeds

        folders += train_other_seeds(folders[0], seeds - 1, device=torch_device, threads=cores, console=console)
    measured = [measure(folder) for folder in folders]
    tell_spread(folders, measured, console)
    for folder, metrics in zip(folders, measured, strict=True):
        hold_against(folder, metrics, wanted.requirements)


def requirements_of(text: str | None) -> "tuple[Requirement, ...]":
    """The requirements of --require.

    Raises:
        typer.BadParameter: they cannot be read.
    """
    from nerfcli.evaluate.requirements import parse_requirements

    try:
        return () if text is None else parse_requirements(text)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--require") from error


def hold_against(run: Path, metrics: dict[str, Any], requirements: "tuple[Requirement, ...]") -> None:
    """Raise if a requirement is not met."""
    from nerfcli.evaluate.requirements import known_numbers, unmet
    from nerfcli.runs.folder import read_config

    failures = unmet(requirements, known_numbers(metrics, read_config(run))) if requirements else []
    if failures:
        raise UserError(
            f"{run} does not meet --require {', '.join(failures)}",
            "train longer (--budget, --resume), or find out with `nerfcli doctor` what the photos lack",
            GATE_NOT_MET,
        )


def evaluate_run(
    run: Path, *, device: str, threads: int, overwrite: bool, console: Console, wanted: Wanted = Wanted()
) -> tuple[Path, dict[str, Any]]:
    """Write RUN/metrics.json, or keep the one that this very checkpoint already has.

    Raises:
        UserError: the folder is no run, its split is not the one it was trained with, a photo cannot be read, or
            metrics of another state or without what is wanted stand there.
    """
    import platform

    import torch

    from nerfcli.atomic import clear_leftovers, write_json
    from nerfcli.evaluate.ledger import leak_ledger, told
    from nerfcli.evaluate.perceptual import find_perceptual
    from nerfcli.evaluate.protocol import METRICS, PROTOCOL, Extras, evaluate_model
    from nerfcli.render.model import load_model
    from nerfcli.runs.folder import FIELD, LOG, check_split, read_cameras, read_config, read_log

    torch.set_num_threads(threads)
    config, cameras = read_config(run), read_cameras(run)
    check_split(run, config, cameras["test"])
    clear_leftovers(run)
    model = load_model(run / FIELD, device)
    checkpoint = model.sha256
    assert checkpoint is not None
    path = run / METRICS
    if path.exists() and not overwrite:
        metrics = _kept(path, checkpoint, wanted)
        made_by = metrics["protocol"].split(":")[0]
        older = "" if made_by == PROTOCOL else f" (by {made_by})"
        console.note(f"{path} is kept{older}; --overwrite measures again")
        return path, metrics

    log = read_log(run)
    if not log:
        raise UserError(f"{run} has no {LOG}, which tells the time of the training", "train again with --overwrite")
    training = {
        "seconds": log[-1]["seconds"],
        "steps": log[-1]["step"],
        "samples_per_second": log[-1]["samples"] / log[-1]["seconds"],
        "rays_per_second": log[-1]["rays"] / log[-1]["seconds"],
        "peak_memory_bytes": max(entry["peak_memory_bytes"] for entry in log),
    }
    held_out = held_out_photos(config, cameras["test"], model=model, threads=threads)
    perceptual = find_perceptual(console.note)
    billboards = billboards_of(config, cameras["train"], threads=threads, console=console)
    with (
        saved_predictions(run, cameras["test"], wanted.predictions, checkpoint=checkpoint) as keep,
        console.progress("evaluate") as update,
    ):
        metrics = evaluate_model(
            model,
            held_out,
            on_image=lambda done, total: update(done / total, f"{done}/{total} rays"),
            extras=Extras(cameras["train"], perceptual, billboards, wanted.align_poses, keep),
        )
    ledger = leak_ledger(config)
    metrics["training"] = training
    metrics["ledger"] = [entry.to_json() for entry in ledger]
    metrics["holdout"] = config.get("holdout")
    metrics["split_sha256"] = config["split_sha256"]
    metrics["device"] = f"{device}, {threads} threads, {platform.machine()}"
    metrics["checkpoint_sha256"] = checkpoint
    write_json(path, metrics)
    tell_numbers(run, metrics, console)
    console.note(told(ledger))
    return path, metrics


def _kept(path: Path, checkpoint: str, wanted: Wanted) -> dict[str, Any]:
    """The metrics that are there, if they are of this checkpoint and have all that is wanted."""
    from nerfcli.atomic import read_json
    from nerfcli.evaluate.predictions import PREDICTIONS

    metrics = read_json(path, needed=("protocol", "mean", "images"), hint="add --overwrite to measure again")
    if metrics.get("checkpoint_sha256") != checkpoint:
        raise UserError(f"{path} belongs to an earlier state of this run", "add --overwrite to replace it")
    lacks = []
    if wanted.align_poses and "psnr_pose_aligned" not in metrics["mean"]:
        lacks.append("refined poses")
    if wanted.predictions is not None and not predictions_are_there(
        path.with_name(PREDICTIONS), wanted.predictions, checkpoint=checkpoint
    ):
        lacks.append("saved predictions")
    if lacks:
        raise UserError(f"{path} was made without {' and '.join(lacks)}", "add --overwrite to measure again")
    return metrics
