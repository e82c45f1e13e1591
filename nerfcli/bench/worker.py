"""The child process of one training: run as `python -m nerfcli.bench.worker JOB.json`.

It is a separate process, so that its peak memory is that of this training alone. It writes pictures where the job says,
and prints lines of JSON on stdout: {"fraction", "detail"} while it works, then {"result"}, or {"error"} for errors that
the user can fix.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nerfcli import kernels
from nerfcli import scene as scenes
from nerfcli.bench.convergence import quadrature, smaller
from nerfcli.bench.sample_pictures import MOST_ERROR, write_difference, write_picture
from nerfcli.bench.trained_run import training_record
from nerfcli.child import take_stdout
from nerfcli.errors import UserError
from nerfcli.evaluate.metrics import psnr, to_8_bit
from nerfcli.evaluate.protocol import HeldOutPhoto, background_of, compare
from nerfcli.evaluate.run_photos import held_out_photos_of
from nerfcli.evaluate.sampled import SampledPixels
from nerfcli.field.cost import field_bytes
from nerfcli.memory import keep_freed_memory
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings
from nerfcli.train.loop import Progress, train

# Number of timed renderings after the first one; they stop early if one takes longer than this many seconds.
_REPEATS, _SLOW_SECONDS = 3, 3.0
# The longer side of the picture, which is small because every training renders it.
_LONGEST_PX = 360


def main(job_path: str) -> None:
    """Run one job and report its result."""
    keep_freed_memory()
    send = take_stdout()
    job = json.loads(Path(job_path).read_text(encoding="utf-8"))
    try:
        send({"result": _train_and_measure(job, send)})
    except UserError as error:
        send({"error": f"{error.message}; {error.hint}"})


def measure_model(
    model: Model, held_out: list[HeldOutPhoto], *, seed: int, folder: Path, prefix: str, shown: str
) -> dict[str, Any]:
    """Measure the rendering time and the error of a field.

    Args:
        held_out: the held-out photos at the resolution of the training.
        seed: seed for the choice of pixels.
        folder: where the pictures are written, under names that begin with `prefix`.
        shown: the name of the photo that is rendered.
    """
    sample = SampledPixels.drawn(held_out, seed=seed)
    photo = next(photo for photo in held_out if photo.frame.name == shown)
    small = smaller(photo, max(photo.pixels.shape[:2]) / _LONGEST_PX)
    background = background_of(model, small)
    seconds: list[float] = []
    while True:
        began = time.perf_counter()
        picture = render_picture(model, small.frame, background=background)
        seconds.append(time.perf_counter() - began)
        if len(seconds) > _REPEATS or seconds[-1] > _SLOW_SECONDS:
            break
    compared = compare(small, picture)
    rounded, truth = to_8_bit(compared.rendered), compared.photo
    write_picture(folder / f"{prefix}-render.jpg", rounded)
    write_difference(folder / f"{prefix}-error.jpg", compared.rendered, truth / 255.0, most=MOST_ERROR)
    write_picture(folder / f"{prefix}-truth.jpg", truth)
    return {
        "psnr": sample.psnr(model),
        "quadrature": quadrature(sample, model),
        "shown_psnr": psnr(rounded, truth, used=compared.used),
        "render_seconds": seconds[1:] or seconds,  # the first one warms up
        "render_size": [small.frame.camera.width, small.frame.camera.height],
        "field_bytes": field_bytes(model.field),
    }


def _train_and_measure(job: dict[str, Any], send: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    began = time.perf_counter()
    scene, run = scenes.load(Path(job["scene"])), Path(job["run"])
    settings = TrainSettings.from_json(job["settings"])
    reported_at = 0.0

    def on_progress(progress: Progress) -> None:
        nonlocal reported_at
        if time.monotonic() - reported_at > 1.0:
            reported_at = time.monotonic()
            send({"fraction": progress.fraction, "detail": f"step {progress.step}"})

    train(scene, run, settings, resume=False, notify=lambda text: None, on_progress=on_progress)
    trained = Run(run)
    model = trained.model(settings.device)
    send({"fraction": 1.0, "detail": "comparing with held-out photos"})
    held_out = held_out_photos_of(trained.config, scene.test_frames, model, threads=settings.threads)
    return {
        **training_record(trained),
        "compiled": settings.device == "cpu" and kernels.has_compiled(),
        **measure_model(
            model,
            held_out,
            seed=job["pixel_seed"],
            folder=Path(job["pictures"]),
            prefix=job["prefix"],
            shown=job["shown"],
        ),
        "wall_seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    main(sys.argv[1])
