"""The settings of a bench and their measurement: renderings in interleaved rounds, or trainings one by one.

Every rendering setting renders the same held-out photos. A first round renders the pictures from which errors are
computed, and warms up; its times do not count. Every later round times all settings in a different order, so that a
machine that gets slower in the middle does not make one setting look slow.
"""

import os
import platform
import random
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerfcli import machine
from nerfcli.bench.results import Point, spread
from nerfcli.captures.capture import Capture
from nerfcli.captures.loading import refuse_without_held_out_photos
from nerfcli.errors import UserError
from nerfcli.evaluate.metrics import compare
from nerfcli.evaluate.photos import HeldOutPhoto, background_of, held_out_photos, paired, without_hidden
from nerfcli.evaluate.sampled import SampledPixels
from nerfcli.machine import Resources
from nerfcli.photos.images import downscale
from nerfcli.photos.loading import downscaled_camera
from nerfcli.render.accuracy import TIGHT
from nerfcli.render.model import Model
from nerfcli.render.pictures import RenderedPicture, render_picture
from nerfcli.render.tracing import TOLERANCE
from nerfcli.training.loop import Progress, train
from nerfcli.training.runs.run import Run
from nerfcli.training.runs.settings import TrainSettings

# A training shorter than this learns too little to tell settings apart.
SHORTEST_TRAINING_SECONDS = 8.0


@dataclass(frozen=True)
class RenderSetting:
    """One way to render a trained field: steps along rays, relative to those of the training, and a tolerance."""

    threads: int
    step: float = 1.0
    tolerance: float = TOLERANCE

    def name(self, default: "RenderSetting") -> str:
        """Return what differs from the default."""
        differences = []
        if self.step != default.step:
            differences.append(f"step {self.step:g}")
        if self.tolerance != default.tolerance:
            differences.append(f"tolerance {as_text(self.tolerance)}")
        if self.threads != default.threads:
            differences.append(f"{self.threads} {'thread' if self.threads == 1 else 'threads'}")
        return ", ".join(differences) or "default"


@dataclass(frozen=True)
class TrainSetting:
    """One training: its time relative to the planned one, and what differs from the defaults of `TrainSettings`."""

    name: str
    fraction: float = 1.0
    changed: tuple[tuple[str, int], ...] = ()

    def settings(self, base: TrainSettings, seconds: float) -> TrainSettings:
        """Return the settings of the training, if one of fraction 1 takes these seconds."""
        changed = dict(self.changed)
        return replace(base, budget_seconds=self.fraction * seconds, steps=None, **changed)  # type: ignore[arg-type]


def render_settings(threads: int) -> list[RenderSetting]:
    """List rendering settings: the default, far steps and tolerances on both sides, fewer threads, and both at once."""
    default = RenderSetting(threads)
    fewer = [2**power for power in range(threads.bit_length()) if 2**power < threads][::-1]
    return [
        default,
        *(replace(default, step=step) for step in (2.0, 4.0, 0.5)),
        *(replace(default, tolerance=tolerance) for tolerance in (1 / 255, 1 / 64, 1 / 16, 1 / 4080)),
        *(replace(default, threads=count) for count in fewer),
        *(replace(default, step=step, tolerance=t) for step in (2.0, 4.0) for t in (1 / 255, 1 / 64)),
        *(replace(default, step=step) for step in (8.0, 0.25)),
        replace(default, step=0.5, tolerance=1 / 4080),
    ]


def train_settings() -> list[TrainSetting]:
    """List trainings: other seeds of the default show the noise of all differences."""
    return [
        TrainSetting("default"),
        TrainSetting("seed 1", changed=(("seed", 1),)),
        TrainSetting("2 x time", 2.0),
        TrainSetting("2^15 rows", changed=(("log2_rows", 15),)),
        TrainSetting("2^17 rows", changed=(("log2_rows", 17),)),
        TrainSetting("seed 2", changed=(("seed", 2),)),
        TrainSetting("0.5 x time", 0.5),
        TrainSetting(f"batch {2**15}", changed=(("samples_per_step", 2**15),)),
        TrainSetting(f"batch {2**17}", changed=(("samples_per_step", 2**17),)),
        TrainSetting("2^18 rows", changed=(("log2_rows", 18),)),
        TrainSetting("4 x time", 4.0),
    ]


def affordable(
    settings: Sequence[TrainSetting], seconds: float, *, overhead: float
) -> tuple[list[TrainSetting], float]:
    """Return as many of the first settings as time allows, and the seconds of a training with a fraction of 1.

    These are at least `SHORTEST_TRAINING_SECONDS` if there are two settings or more.

    Args:
        settings: the most informative first; at least one.
        seconds: time limit for all.
        overhead: seconds that each takes besides its training.
    """
    fractions = accumulate(setting.fraction for setting in settings)
    units = [(seconds - overhead * count) / total for count, total in enumerate(fractions, start=1)]
    count = max((n for n, unit in enumerate(units, start=1) if unit >= SHORTEST_TRAINING_SECONDS), default=1)
    return list(settings[:count]), max(units[count - 1], 1.0)


def as_text(value: float) -> str:
    """Format a number, as a fraction such as 1/255 if it is the reciprocal of a whole number."""
    ratio = Fraction(value).limit_denominator(10**6)
    return str(ratio) if ratio.numerator == 1 and value < 1 else f"{value:g}"


def describe_machine(device: str, threads: int) -> dict[str, Any]:
    """Describe the machine: everything that a time depends on besides the settings."""
    return {
        "processor": machine.processor_name(),
        "processors": os.cpu_count(),
        "device": "cpu" if device == "cpu" else torch.cuda.get_device_name(device),
        "threads": threads,
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def load_average() -> float | None:
    """Return the mean number of runnable processes over the last minute, ours included; None if not reported."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def is_busy(load: float | None) -> bool:
    """Return whether a load average from before the start shows that other programs use the processors."""
    # Measured times suffer if other programs use more than a quarter of the processors.
    return load is not None and load > 0.25 * (os.cpu_count() or 1)


def begin_peak(device: str) -> None:
    """Reset the peak memory of this process or, if the device is a GPU, of the GPU."""
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats(device)
    else:
        machine.begin_recent_peak()


def peak_bytes(device: str) -> int | None:
    """Return the peak since `begin_peak`; None if the system does not report it."""
    return machine.recent_peak_bytes() if device == "cpu" else torch.cuda.max_memory_allocated(device)


MOST_PHOTOS = 3
LEAST_ROUNDS, MOST_ROUNDS = 3, 9
# With fewer settings there is nothing to compare; these are measured even if time is short.
LEAST_SETTINGS = 7
# A rendering counts as converged with steps this many times as fine, and next to nothing left out by the early stop.
FINER = 8
# Subfolder for the run that is being measured; a killed bench leaves it.
WORK = ".training"

# Called with the points so far, after each round of renderings and after each training.
Save = Callable[[Sequence[Point]], None]
# Called with (fraction of the time used, current work).
Tell = Callable[[float, str], None]


def measure_renderings(run: Run, *, resources: Resources, seconds: float, save: Save, tell: Tell) -> None:
    """Measure as many rendering settings of a run as time allows.

    Raises:
        UserError: a photo cannot be read, or nothing was held out.
    """
    began = time.monotonic()

    def spent() -> float:
        return min(1.0, (time.monotonic() - began) / seconds)

    device = resources.torch_device
    model = run.model(device)
    photos = held_out_photos(run, run.cameras.test)
    if not photos:
        raise UserError(f"{run.path} has no held-out photos", "train again with --holdout every:8 --overwrite")
    photos, settings = without_hidden(photos), render_settings(resources.cores)
    tell(0.0, "rendering a first picture")
    _render(model, photos[0], settings[0])
    once = _timed(model, photos[:1], settings[0])
    # One photo, and a smaller one, where the least number of rounds would take longer than the time.
    # The first settings take 1.2 times as long as the default.
    needed = once * (FINER + LEAST_SETTINGS * (LEAST_ROUNDS + 1)) * 1.2
    count = max(1, min(MOST_PHOTOS, len(photos), int(seconds / needed)))
    photos = [smaller(photo, (needed / seconds) ** 0.5) for photo in photos[:: -(-len(photos) // count)]]
    tell(spent(), "rendering the converged pictures")
    converged = [_converged(model, photo) for photo in photos]
    pictures: dict[RenderSetting, tuple[float, float]] = {}
    for number, setting in enumerate(settings):
        if number >= LEAST_SETTINGS and spent() > 0.3:
            break
        tell(spent(), f"rendering: {setting.name(settings[0])}")
        pictures[setting] = _errors(model, photos, converged, setting)
    taken: dict[RenderSetting, list[float]] = {setting: [] for setting in pictures}
    peaks: dict[RenderSetting, int | None] = {}
    for number in range(MOST_ROUNDS):
        if number >= LEAST_ROUNDS and spent() > 0.95:
            break
        order = list(pictures)
        random.Random(number).shuffle(order)
        for setting in order:
            tell(spent(), f"timing, round {number + 1}: {setting.name(settings[0])}")
            begin_peak(device)
            taken[setting].append(_timed(model, photos, setting))
            peaks[setting] = peak_bytes(device)
        save(
            [
                Point(
                    setting.name(settings[0]),
                    **spread(taken[setting]),
                    peak_memory_bytes=peaks[setting],
                    psnr=decibels,
                    levels_off=levels,
                )
                for setting, (decibels, levels) in pictures.items()
            ]
        )


def measure_trainings(
    scene: Capture, work: Path, *, resources: Resources, seconds: float, save: Save, tell: Tell
) -> None:
    """Train a scene with as many settings as time allows, each for the same time unless it is the time that varies.

    The runs are in the folder `work` and are deleted again.

    Raises:
        UserError: see `nerfcli.training.loop.train`; or nothing was held out.
    """
    refuse_without_held_out_photos(scene)
    device = resources.torch_device
    base = TrainSettings(device=device, threads=resources.cores)
    chosen, unit = affordable(train_settings(), seconds, overhead=6.0)
    points: list[Point] = []
    folder = work / WORK
    for number, setting in enumerate(chosen):

        def on_progress(progress: Progress, number: int = number, name: str = setting.name) -> None:
            tell((number + progress.fraction) / len(chosen), f"training: {name}, step {progress.step}")

        begin_peak(device)
        shutil.rmtree(folder, ignore_errors=True)
        try:
            wanted = setting.settings(base, unit)
            train(scene, folder, wanted, resume=False, notify=lambda text: None, on_progress=on_progress)
            trained = Run(folder)
            model, summary = trained.model(device), trained.summary
            photos = held_out_photos(trained, scene.test_frames)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        assert summary is not None
        decibels = SampledPixels.drawn(photos, seed=0).psnr(model)
        taken, peak = spread([summary.seconds]), peak_bytes(device)
        points.append(Point(setting.name, **taken, peak_memory_bytes=peak, psnr=decibels, steps=summary.steps))
        save(points)


def smaller(photo: HeldOutPhoto, factor: float) -> HeldOutPhoto:
    """Return the photo with its sides divided by a factor; unchanged if the factor is 1 or less."""
    if factor <= 1.0:
        return photo
    used = None if photo.used is None else downscale(photo.used.astype(np.uint8) * 255, factor) == 255
    frame = replace(photo.frame, camera=downscaled_camera(photo.frame.camera, factor))
    return replace(photo, frame=frame, pixels=downscale(photo.pixels, factor), used=used)


def _render(model: Model, photo: HeldOutPhoto, setting: RenderSetting) -> RenderedPicture:
    machine.use_threads(setting.threads)
    background, fine = background_of(model, photo), model.stretched(setting.step)
    return render_picture(fine, photo.frame, background=background, tolerance=setting.tolerance)


def _timed(model: Model, photos: Sequence[HeldOutPhoto], setting: RenderSetting) -> float:
    """Return the seconds per picture."""
    began = time.perf_counter()
    for photo in photos:
        _render(model, photo, setting)
    return (time.perf_counter() - began) / len(photos)


def _converged(model: Model, photo: HeldOutPhoto) -> np.ndarray:
    background, fine = background_of(model, photo), model.stretched(1 / FINER)
    return render_picture(fine, photo.frame, background=background, tolerance=TIGHT).rgb


def _errors(
    model: Model, photos: Sequence[HeldOutPhoto], converged: Sequence[np.ndarray], setting: RenderSetting
) -> tuple[float, float]:
    """Return the mean PSNR on the photos, and the rms difference from the converged pictures in levels of 255."""
    decibels, squares = [], []
    for photo, fine in zip(photos, converged, strict=True):
        picture = _render(model, photo, setting)
        pair = paired(photo, picture)
        decibels.append(compare(pair.rendered, pair.photo, used=pair.used).psnr)
        squares.append(float(np.square(picture.rgb - fine, dtype=np.float64)[pair.used].mean()))
    return float(np.mean(decibels)), 255.0 * float(np.sqrt(np.mean(squares)))
