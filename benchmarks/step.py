"""Speed of the whole training step: compiled kernels on one and two threads, and the plain-torch reference.

    python benchmarks/step.py photos-scene
    python benchmarks/step.py lego_400 --warm-up 60

The field is first trained for a while, as the work of a step depends on the density along rays; then steps of the final
size are timed for each path in turn. Only samples that are trained on count, not those that are skipped or hidden
behind surfaces. Run nothing else meanwhile.
"""

import statistics
import time
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.table import Table

from nerfcli import kernels, scene
from nerfcli.fit.extent import choose_extent
from nerfcli.fit.fitting import Fitting
from nerfcli.photos.loading import load_photos
from nerfcli.photos.pool import PixelPool
from nerfcli.runs.settings import TrainSettings, automatic_downscale


def trained(folder: Path, seconds: float, threads: int) -> Fitting:
    """Return a training that has run for some seconds."""
    capture = scene.load(folder)
    first = capture.train_frames[0].camera
    factor = automatic_downscale(first)
    photos = load_photos(capture.train_frames, factor=factor, threads=threads)
    settings = TrainSettings(
        budget_seconds=seconds, threads=threads, first_samples_per_step=TrainSettings.samples_per_step
    )
    fills_frame = any(photo.pixels.shape[-1] == 3 for photo in photos)
    extent = choose_extent(capture, settings, fills_frame=fills_frame)
    pool = PixelPool(photos, extent.training_from_scene, torch.device("cpu"))
    fitting = Fitting(pool, extent.marching, contraction=extent.contraction, settings=settings)
    began = time.perf_counter()
    while (fraction := (time.perf_counter() - began) / seconds) < 1.0:
        fitting.advance(fraction)
    return fitting


def samples_per_second(fitting: Fitting, steps: int) -> list[float]:
    """Return the speed of single steps at the end of the budget."""
    speeds = []
    for _ in range(steps):
        began = time.perf_counter()
        result = fitting.advance(1.0)
        speeds.append(result.samples / (time.perf_counter() - began))
    return speeds


def main(
    folder: Annotated[Path, typer.Argument(help="A scene, as nerfcli train takes it.")],
    warm_up: Annotated[float, typer.Option(help="Seconds of training before anything is timed.")] = 30.0,
    steps: Annotated[int, typer.Option(help="Steps per line; a tenth for the reference.")] = 100,
    threads: Annotated[int, typer.Option(help="Threads of the warm-up and of the largest line.")] = 2,
) -> None:
    """Time the whole training step."""
    torch.set_num_threads(threads)
    kernels.prepare(Console(stderr=True).print)
    fitting = trained(folder, warm_up, threads)
    table = Table(title=f"{folder.name}, steps of about {fitting.settings.samples_per_step} samples")
    for name in ("path", "threads", "M samples/s", "quartiles", "times the reference"):
        table.add_column(name, justify="right")
    for count in sorted({1, threads}):
        torch.set_num_threads(count)
        fitting.field.backend = kernels.backend_for(torch.device("cpu"), torch.float32, wanted="reference")
        reference = statistics.median(samples_per_second(fitting, max(2, steps // 10)))
        fitting.field.backend = kernels.backend_for(torch.device("cpu"), torch.float32)
        speeds = samples_per_second(fitting, steps)
        low, middle, high = statistics.quantiles(speeds, n=4)
        table.add_row("reference", str(count), f"{reference / 1e6:.3f}", "", "1")
        table.add_row(
            "compiled", str(count), f"{middle / 1e6:.2f}", f"{low / 1e6:.2f} {high / 1e6:.2f}",
            f"{middle / reference:.0f}",
        )  # fmt: skip
    Console(width=100).print(table)


if __name__ == "__main__":
    typer.run(main)
