"""Estimate time, memory and disk space of rendering or evaluating a run from a few small pictures."""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.evaluate.protocol import Extras, HeldOutPhoto, evaluate_model
from nerfcli.evaluate.run_photos import held_out_photos_of
from nerfcli.export.frames import MOST_AT_A_TIME, Workers, export_frames
from nerfcli.export.order import Order
from nerfcli.export.settings import ExportSettings
from nerfcli.photos.loading import load_photos
from nerfcli.runs.run import Run, load_run
from nerfcli.train.loop import peak_memory_bytes
from nerfcli.workflows.machine import device_name, thread_count
from nerfcli.workflows.notices import silent
from nerfcli.workflows.render import usual_settings
from nerfcli.workflows.views import Views, chosen_frames

# Number of measured pictures, and their longer side: large enough to need the memory of a full tile of rays.
_MEASURED, _LONGER_SIDE = 3, 160
# Memory per pixel of a picture: maps of all outputs, and encoding or comparing them.
_BYTES_PER_PIXEL = 150
# Bytes per pixel that `evaluate --save-predictions` writes: two 8-bit pictures that hardly compress; and the rendered
# one as float32.
_PREDICTION_BYTES = {None: 0, "png": 6, "float": 18}


@dataclass(frozen=True)
class RenderingPlan:
    """Cost of rendering or evaluating a run, without the time to start the program and to load the model.

    Args:
        pixels: number of pixels of all pictures.
        seconds: time on this machine.
        memory_bytes: peak memory of the process.
        disk_bytes: size of the written files, without videos.
    """

    pictures: int
    pixels: int
    seconds: float
    memory_bytes: int
    disk_bytes: int

    def describe(self) -> str:
        """Return one sentence."""
        return (
            f"{self.pictures} pictures, {self.pixels / 1e6:.1f} million pixels: about {self.seconds:.0f} s, "
            f"{self.memory_bytes / 1e9:.2f} GB of memory, {self.disk_bytes / 1e6:.1f} MB on disk"
        )


def plan_rendering(
    run: str | Path,
    *,
    views: Views,
    settings: ExportSettings | None = None,
    device: str = "auto",
    threads: int = 0,
    step: float = 1.0,
    part: slice | None = None,
) -> RenderingPlan:
    """Estimate the cost of `render_run` by rendering three small pictures into a temporary folder.

    Args:
        run, views, settings, device, threads, step, part: as for `render_run`, with one process.

    Raises:
        UserError: see `render_run`; or an output needs the depths of training photos, or members.
    """
    settings = usual_settings(load_run(run), views) if settings is None else settings
    if settings.needs_visibility or settings.needs_members:
        raise UserError(
            "--dry-run does not cover coverage, parallax, intervals and deviations",
            "leave these outputs and --min-views, --min-parallax out of the dry run",
        )
    trained, cores, torch_device = Run(Path(run)), thread_count(threads), device_name(device)
    torch.set_num_threads(cores)
    model = trained.model(torch_device).stretched(step)
    frames = chosen_frames(trained, views, depth_hint=1.0 / model.training_from_scene.scale)
    chosen = frames if part is None else frames[part]
    small = [replace(frame, camera=_small(frame)) for frame in _spread(chosen)]
    pictures = replace(settings, video=None)
    if pictures.depth.background_distance is None:
        far = model.marching.far / model.training_from_scene.scale
        pictures = replace(pictures, depth=replace(pictures.depth, background_distance=far))
    provenance = {"cameras": views.cameras, "run": trained.path.name, "field_sha256": model.sha256}
    order, workers = Order(tuple(small), pictures, provenance), Workers(1, cores)
    with tempfile.TemporaryDirectory() as folder:
        targets = iter((Path(folder) / "first", Path(folder) / "second"))
        seconds = _second_run(
            lambda: export_frames(
                model, order, next(targets), on_rays=lambda rays: None, notify=silent, workers=workers
            )
        )
        written = sum(file.stat().st_size for file in (Path(folder) / "second").rglob("*") if file.is_file())
    factor = _pixels(chosen) / _pixels(small)
    return _plan(chosen, seconds=factor * seconds, at_once=min(cores, MOST_AT_A_TIME), written=factor * written)


def plan_evaluation(
    run: str | Path,
    *,
    device: str = "auto",
    threads: int = 0,
    align_poses: bool = False,
    align_colours: bool = False,
    predictions: str | None = None,
) -> RenderingPlan:
    """Estimate the cost of `evaluate_run` by evaluating three held-out photos at a smaller size.

    Args:
        run, device, threads, align_poses, align_colours, predictions: as for `evaluate_run`.

    Raises:
        UserError: see `evaluate_run`.
    """
    trained, cores, torch_device = Run(Path(run)), thread_count(threads), device_name(device)
    torch.set_num_threads(cores)
    model = trained.model(torch_device)
    test, train, factor = trained.cameras.test, trained.cameras.train, trained.config.downscale
    begin = time.perf_counter()
    photos = held_out_photos_of(trained.config, _spread(test), model, threads=cores)
    load_photos(_spread(train), factor=factor, threads=1, masks=trained.components.masks)
    reading = (time.perf_counter() - begin) * (len(test) + len(train)) / (len(photos) + len(_spread(train)))
    small = [_fewer_pixels(photo) for photo in photos]
    extras = Extras(train, align_poses=align_poses, align_colours=align_colours)
    seconds = _second_run(lambda: evaluate_model(model, small, on_image=lambda done, total: None, extras=extras))
    frames = [photo.frame for photo in photos]
    fraction = _pixels(frames) / _pixels([photo.frame for photo in small]) * len(test) / len(photos)
    plan = _plan(frames, seconds=reading + fraction * seconds, at_once=1, written=0.0)
    pixels = round(_pixels(frames) * len(test) / len(frames))
    return replace(
        plan,
        pictures=len(test),
        pixels=pixels,
        memory_bytes=plan.memory_bytes + 4 * pixels,  # of the photos, which stay in memory
        disk_bytes=_PREDICTION_BYTES[predictions] * pixels + 2000 * len(test),
    )


def _plan(frames: Sequence[Frame], *, seconds: float, at_once: int, written: float) -> RenderingPlan:
    largest = max(_pixels([frame]) for frame in frames)
    return RenderingPlan(
        pictures=len(frames),
        pixels=_pixels(frames),
        seconds=round(seconds, 1),
        memory_bytes=peak_memory_bytes() + _BYTES_PER_PIXEL * largest * at_once,
        disk_bytes=round(written),
    )


def _spread(frames: Sequence[Frame]) -> list[Frame]:
    """Return at most `_MEASURED` frames, evenly spaced in their order."""
    count = min(_MEASURED, len(frames))
    return [frames[(2 * index + 1) * len(frames) // (2 * count)] for index in range(count)]


def _small(frame: Frame) -> Camera:
    """Return the camera of a frame, reduced to a longer side of at most `_LONGER_SIDE` pixels."""
    width, height = frame.camera.width, frame.camera.height
    reduction = max(1.0, max(width, height) / _LONGER_SIDE)
    return frame.camera.resized(max(1, round(width / reduction)), max(1, round(height / reduction)))


def _fewer_pixels(photo: HeldOutPhoto) -> HeldOutPhoto:
    """Return a photo with every n-th pixel; its content is no longer right, but only its size matters."""
    stride = max(1, max(photo.pixels.shape[:2]) // _LONGER_SIDE)
    pixels = photo.pixels[::stride, ::stride]
    used = None if photo.used is None else photo.used[::stride, ::stride]
    camera = photo.frame.camera.resized(pixels.shape[1], pixels.shape[0])
    return replace(photo, frame=replace(photo.frame, camera=camera), pixels=pixels, used=used)


def _pixels(frames: Sequence[Frame]) -> int:
    return sum(frame.camera.width * frame.camera.height for frame in frames)


def _second_run(work: Callable[[], object]) -> float:
    """Return the seconds that a second call takes, without the one-time costs of the first."""
    work()
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
