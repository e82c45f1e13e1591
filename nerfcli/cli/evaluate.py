"""nerfcli evaluate: held-out numbers of a run."""

import json as json_module
from pathlib import Path
from typing import Annotated, Any

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Device, Json, Overwrite, Quiet, Threads, device_name, thread_count
from nerfcli.errors import UserError


@command
def evaluate(
    run: Annotated[str, typer.Argument(help="The folder that train wrote, or - for runs on standard input.")],
    device: Device = "auto",
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Measure PSNR and SSIM on the photos that training did not see, with training and render time beside them.

    Writes RUN/metrics.json with the protocol's name, per-image and mean values.

    \b
    Examples:
      nerfcli evaluate photos-scene-run
      nerfcli evaluate photos-scene-run --json | jq .mean.psnr
    """
    console = Console(quiet=quiet, json_lines=json)

    def work(folder: Path, one_of_many: bool) -> None:
        path, metrics = evaluate_run(
            folder, device=device_name(device), threads=thread_count(threads), overwrite=overwrite, console=console
        )
        console.result(path, metrics)

    for_each_input(run, work)


def evaluate_run(
    run: Path, *, device: str, threads: int, overwrite: bool, console: Console
) -> tuple[Path, dict[str, Any]]:
    """Write RUN/metrics.json, or keep the one that this very checkpoint already has."""
    import hashlib
    import platform

    import torch

    from nerfcli.atomic import write_json
    from nerfcli.evaluate.protocol import METRICS, HeldOut, evaluate_model
    from nerfcli.render.model import load_model
    from nerfcli.train.exif_exposure import relative_log_exposures
    from nerfcli.train.photos import load_photos
    from nerfcli.train.run_folder import FIELD, LOG, read_cameras, read_config, read_log

    torch.set_num_threads(threads)
    config, cameras = read_config(run), read_cameras(run)
    model = load_model(run / FIELD, device)
    checkpoint = hashlib.sha256((run / FIELD).read_bytes()).hexdigest()
    path = run / METRICS
    if path.exists() and not overwrite:
        metrics = json_module.loads(path.read_text(encoding="utf-8"))
        if metrics.get("checkpoint_sha256") != checkpoint:
            raise UserError(f"{path} belongs to an earlier state of this run", "add --overwrite to replace it")
        console.note(f"{path} is kept; --overwrite measures again")
        return path, metrics

    log = read_log(run)
    if not log:
        raise UserError(f"{run} has no {LOG}, which tells the time of the training", "train again with --overwrite")
    photos = load_photos(cameras["test"], factor=config["settings"]["downscale"], threads=threads)
    gains = relative_log_exposures(cameras["test"], model.log_exposure)
    held_out = [
        HeldOut(photo.frame, photo.pixels, photo.used, log_gain=float(gain))
        for photo, gain in zip(photos, gains, strict=True)
    ]
    with console.progress("evaluate") as update:
        metrics = evaluate_model(
            model, held_out, on_image=lambda done, total: update(done / total, f"{done}/{total} rays")
        )
    metrics["training"] = {
        "seconds": log[-1]["seconds"],
        "steps": log[-1]["step"],
        "samples_per_second": log[-1]["samples"] / log[-1]["seconds"],
        "rays_per_second": log[-1]["rays"] / log[-1]["seconds"],
        "peak_memory_bytes": max(entry["peak_memory_bytes"] for entry in log),
    }
    metrics["device"] = f"{device}, {threads} threads, {platform.machine()}"
    metrics["checkpoint_sha256"] = checkpoint
    write_json(path, metrics)
    console.note(
        f"{run}: PSNR {metrics['mean']['psnr']:.2f} dB, SSIM {metrics['mean']['ssim']:.3f} on {len(photos)} held-out "
        f"photos; trained {metrics['training']['seconds']:.0f} s, "
        f"{metrics['render']['seconds_per_image']:.2f} s a picture"
    )
    return path, metrics
