"""Speed and error of rendering a run: one picture on one thread and on all, and a film as `nerfcli render` writes it.

    python benchmarks/pictures.py RUN... [--film] [--repeats 7]

The error is that of the default tolerance: against the same picture rendered with a tolerance of 1e-6, on its pixels.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from nerfcli.render.depth import DepthRequest
from nerfcli.render.pictures import Quality, RenderedPicture, render_picture
from nerfcli.runs.run import Run
from nerfcli.workflows.views import Views, chosen_frames

FILM_VIEWS = 120


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--film", action="store_true", help=f"also time an orbit of {FILM_VIEWS} views with depth")
    parser.add_argument("--repeats", type=int, default=7)
    given = parser.parse_args()
    threads = os.cpu_count() or 1
    print(f"| run | size | s, 1 thread | s, {threads} threads | rms and largest colour error | film, s |")
    print("|---|---|---|---|---|---|")
    for folder in given.runs:
        one, many = (_seconds(folder, count, given.repeats) for count in (1, threads))
        film = f"{_film_seconds(folder):.1f}" if given.film else "-"
        print(f"| {folder.name} | {_size(folder)} | {one} | {many} | {_error(folder)} | {film} |", flush=True)


def _picture(folder: Path, quality: Quality = Quality()) -> RenderedPicture:
    run = Run(folder)
    model = run.model()
    frame = chosen_frames(run, Views("test"), depth_hint=1.0)[0]
    depth = DepthRequest("median", "z", 0.5, None)
    return render_picture(model, frame, background=model.background, depth=depth, quality=quality)


def _seconds(folder: Path, threads: int, repeats: int) -> str:
    """Return median and range of the seconds for the first held-out view."""
    torch.set_num_threads(threads)
    run = Run(folder)
    model = run.model()
    frame = chosen_frames(run, Views("test"), depth_hint=1.0)[0]
    depth = DepthRequest("median", "z", 0.5, None)
    seconds = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        render_picture(model, frame, background=model.background, depth=depth)
        seconds.append(time.perf_counter() - begin)
    seconds = seconds[1:]  # the first may compile
    return f"{statistics.median(seconds):.3f} ({min(seconds):.3f} to {max(seconds):.3f})"


def _error(folder: Path) -> str:
    apart = np.abs(_picture(folder).rgb - _picture(folder, Quality(tolerance=1e-6)).rgb)
    return f"{np.sqrt(np.mean(apart**2)):.1e}, {apart.max():.1e}"


def _size(folder: Path) -> str:
    height, width = _picture(folder).opacity.shape
    return f"{width}x{height}"


def _film_seconds(folder: Path) -> float:
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "nerfcli", "render", str(folder), "--cameras", "orbit", "--video", "-q"]
        begin = time.perf_counter()
        subprocess.run([*command, "--count", str(FILM_VIEWS), "--outputs", "rgb,depth", "-o", out], check=True)
        return time.perf_counter() - begin


if __name__ == "__main__":
    main()
