"""Speed of a training step, and of pictures with their error: compiled kernels beside the plain-torch reference.

    python benchmarks/speed.py step photos-scene
    python benchmarks/speed.py pictures photos-scene-run --film

`step` trains the field for a while first, as the work of a step depends on the density along rays, then times steps of
the final size for each path in turn. Only samples that are trained on count. `pictures` times the first held-out view;
its error is against the same picture with a tolerance of 1e-6. Run nothing else meanwhile.
"""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table

from nerfcli import kernels, scene
from nerfcli.fit.extent import choose_extent
from nerfcli.fit.fitting import Fitting
from nerfcli.photos.loading import load_photos
from nerfcli.photos.pool import PixelPool
from nerfcli.render.depth import DepthRequest
from nerfcli.render.pictures import RenderedPicture, render_picture
from nerfcli.render.tracing import TOLERANCE
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings, automatic_downscale
from nerfcli.workflows.views import Views, chosen_frames

FILM_VIEWS = 120

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
Threads = Annotated[int, typer.Option(help="Threads of the last line.")]


def trained(folder: Path, seconds: float, threads: int) -> Fitting:
    """Return a training that has run for some seconds."""
    capture = scene.load(folder)
    factor = automatic_downscale(capture.train_frames[0].camera)
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


@app.command()
def step(
    folder: Annotated[Path, typer.Argument(help="A scene, as nerfcli train takes it.")],
    warm_up: Annotated[float, typer.Option(help="Seconds of training before anything is timed.")] = 30.0,
    steps: Annotated[int, typer.Option(help="Steps per line; a tenth for the reference.")] = 100,
    threads: Threads = 2,
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
        low, middle, high = (speed / 1e6 for speed in statistics.quantiles(samples_per_second(fitting, steps), n=4))
        ratio = f"{1e6 * middle / reference:.0f}"
        table.add_row("reference", str(count), f"{reference / 1e6:.3f}", "", "1")
        table.add_row("compiled", str(count), f"{middle:.2f}", f"{low:.2f} {high:.2f}", ratio)
    Console(width=100).print(table)


def first_view(folder: Path, *, tolerance: float = TOLERANCE, repeats: int = 1) -> tuple[RenderedPicture, str]:
    """Return the first held-out view of a run with its depth, and median and range of the seconds that it takes."""
    run = Run(folder)
    model = run.model()
    frame = chosen_frames(run, Views("test"), depth_hint=1.0)[0]
    how = {"background": model.background, "depth": DepthRequest("median", "z", 0.5, None)}
    picture = render_picture(model, frame, **how, tolerance=tolerance)  # the first may compile
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        render_picture(model, frame, **how, tolerance=tolerance)
        seconds.append(time.perf_counter() - began)
    return picture, f"{statistics.median(seconds):.3f} ({min(seconds):.3f} to {max(seconds):.3f})"


def film_seconds(folder: Path) -> float:
    """Return the seconds of an orbit with depth, as nerfcli render writes it."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "nerfcli", "render", str(folder), "--cameras", "orbit", "--video", "-q"]
        began = time.perf_counter()
        subprocess.run([*command, "--count", str(FILM_VIEWS), "--outputs", "rgb,depth", "-o", out], check=True)
        return time.perf_counter() - began


@app.command()
def pictures(
    runs: Annotated[list[Path], typer.Argument(help="Runs, as nerfcli render takes them.")],
    film: Annotated[bool, typer.Option("--film", help=f"Also time an orbit of {FILM_VIEWS} views with depth.")] = False,
    repeats: Annotated[int, typer.Option(help="Of each picture.")] = 7,
    threads: Threads = 2,
) -> None:
    """Time pictures, and measure their error."""
    table = Table("run", "size", "s, 1 thread", f"s, {threads} threads", "rms, largest colour error", "film, s")
    for folder in runs:
        torch.set_num_threads(1)
        _, alone = first_view(folder, repeats=repeats)
        torch.set_num_threads(threads)
        picture, together = first_view(folder, repeats=repeats)
        apart = np.abs(picture.rgb - first_view(folder, tolerance=1e-6)[0].rgb)
        height, width = picture.opacity.shape
        error = f"{np.sqrt(np.mean(apart**2)):.1e}, {apart.max():.1e}"
        seconds = f"{film_seconds(folder):.1f}" if film else "-"
        table.add_row(folder.name, f"{width}x{height}", alone, together, error, seconds)
    Console(width=120).print(table)


if __name__ == "__main__":
    app()
