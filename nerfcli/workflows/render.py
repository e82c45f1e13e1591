"""Render pictures, depth maps and videos of a run, resume, or keep existing ones."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.atomic import cannot_write
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.camera_path import losses_camera_path, write_camera_path
from nerfcli.captures.formats.transforms import write_transforms
from nerfcli.errors import UserError
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.render.frames import render_job
from nerfcli.render.job import OUTPUTS, RenderJob, RenderSettings
from nerfcli.render.model import Model
from nerfcli.splats.render import SplatScene
from nerfcli.training.runs.run import Run, load_run
from nerfcli.workflows.photo_depths import depth_errors, photo_depths
from nerfcli.workflows.splats import file_digest, load_splats
from nerfcli.workflows.views import PATHS, Views, chosen_frames, frames_of_file, refuse_z_of_panoramas, usual_depth

RENDERS = "renders"
HELD_OUT = Views("test")


def folder_name(views: Views, settings: RenderSettings, *, of_splats: bool = False) -> str:
    """Return the name of the folder in RUN/renders: the views and, so that conventions never mix, the kind of depth."""
    depth = f"-{settings.depth.convention.replace(':', '-')}-{settings.depth.axis}" if settings.measured else ""
    return f"{views.name}{depth}{'-splats' if of_splats else ''}"


def render_run(
    run: str | Path,
    output: Output = Output(),
    *,
    views: Views = HELD_OUT,
    settings: RenderSettings | None = None,
    splats: str | Path | None = None,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> list[Path]:
    """Render views of a run into a folder, or keep a complete folder with the same views and settings.

    Example:
        >>> import nerfcli
        >>> from nerfcli.workflows.views import Views
        >>> nerfcli.render_run("photos-scene-run", views=Views("orbit", count=120))

    Args:
        run: the folder that `train_scene` wrote.
        output: the folder to write; in RUN/renders by default, named after views and depth.
        views: which cameras; the held-out ones by default.
        settings: outputs, depth, file formats, videos, and steps along rays; colours, depths and opacities by default.
        splats: a .ply or .spz to render instead of the field.
        resources: threads and device.
        reporter: receives messages, and the fraction of the rays that is done.

    Returns:
        The paths to show: videos, or the folders of the outputs; the unfinished folder if only a part is rendered.

    Raises:
        UserError: the run or the cameras do not exist, or the output holds other files.
    """
    trained, torch_device = load_run(run), resources.torch_device
    settings = settings or RenderSettings(outputs=OUTPUTS[:3], depth=usual_depth(trained, views))
    folder = output.at(trained.path / RENDERS / folder_name(views, settings, of_splats=splats is not None))
    resources.begin()
    model = trained.model(torch_device)
    shown: Model | SplatScene = model.stretched(settings.step)
    seen = ()
    provenance: dict[str, Any] = {
        "cameras": views.cameras,
        "run": trained.path.resolve().name,
        "field_sha256": model.sha256,
    }
    if splats is not None:
        shown, of_file = load_splats(splats, notify=reporter.note), file_digest(Path(splats))
        provenance |= {"splats": Path(splats).name, "splats_sha256": of_file}
    if settings.needs_visibility:
        seen = photo_depths(trained, model, reporter)
        provenance["training_photos"] = len(seen)
    errors = None
    if settings.needs_errors:
        errors = depth_errors(trained, model, seen, reporter=reporter)
        provenance["measured_photos"] = errors.photos
    if settings.depth.convention == "background" and settings.depth.background_distance is None:
        farthest = model.marching.far / model.training_from_scene.scale
        settings = replace(settings, depth=replace(settings.depth, background_distance=farthest))
    # The unit of the training frame is about the distance between the cameras and what they look at.
    frames = chosen_frames(trained, views, depth_hint=1.0 / model.training_from_scene.scale)
    if splats is None and "depth" in settings.outputs and settings.depth.axis == "z":
        refuse_z_of_panoramas(frames, notify=reporter.note)
    job = RenderJob(tuple(frames), settings, provenance, seen, errors)
    return render_job(shown, job, replace(output, path=folder), part=views.part, reporter=reporter)


def render_splats(
    file: str | Path,
    output: Output = Output(),
    *,
    views: Views,
    settings: RenderSettings,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> list[Path]:
    """Render splats of any program with the cameras of a file or folder; the other arguments are as for `render_run`.

    Args:
        file: a .ply or .spz.
        output: the folder to write; FILE-renders/CAMERAS beside the file by default.

    Raises:
        UserError: the file cannot be read, the cameras are those of a run, or an output needs training photos.
    """
    path = Path(file)
    if not path.is_file():
        raise UserError(f"{path} does not exist", "give a .ply or .spz of splats")
    if views.cameras in ("test", "train", *PATHS):
        hint = "give a file or folder of cameras, or render the run: nerfcli render RUN --splats FILE"
        raise UserError(f"{path} has no cameras, so --cameras {views.cameras} is not known", hint, exit_code=2)
    if settings.needs_visibility:
        hint = "leave them out, or render the run: nerfcli render RUN --splats FILE"
        raise UserError("coverage, parallax and errors of depth need training photos", hint, exit_code=2)
    if settings.depth.convention == "background" and settings.depth.background_distance is None:
        what = "--depth background of a file of splats needs a distance for light that hits nothing"
        raise UserError(what, "add --background-distance", exit_code=2)
    resources.begin()
    splats = load_splats(path, notify=reporter.note)
    frames = frames_of_file(views)
    provenance = {"cameras": views.cameras, "splats": path.name, "splats_sha256": file_digest(path)}
    folder = output.at(path.with_name(f"{path.stem}-{RENDERS}") / folder_name(views, settings))
    job = RenderJob(tuple(frames), settings, provenance)
    return render_job(splats, job, replace(output, path=folder), part=views.part, reporter=reporter)


def write_cameras(
    run: str | Path, output: Output, views: Views, *, fps: float, reporter: Reporter = Reporter()
) -> Path:
    """Write only the cameras of views of a run into a folder, and return it.

    They are in cameras.json, in transforms format, and in camera_path.json for nerfstudio's viewer.

    Raises:
        UserError: the run or the cameras do not exist, or one of the files exists, or cannot be written.
    """
    trained = Run(Path(run))
    folder = output.at(trained.path / RENDERS / f"{views.name}-cameras")
    frames = chosen_frames(trained, views, depth_hint=1.0 / trained.model().training_from_scene.scale)
    frames = frames[views.part or slice(None)]
    alone = tuple(replace(frame, image=None, mask=None, split=None) for frame in frames)
    capture = Capture(alone, np.zeros((0, 3)), (), None, "camera-path")
    listed, path = folder / "cameras.json", folder / "camera_path.json"
    output.refuse_existing(listed, path)
    for loss in losses_camera_path(capture):
        reporter.warn(f"{path.name} cannot hold {loss}; use {listed.name} instead")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    write_transforms(capture, listed)
    write_camera_path(capture, path, fps=fps)
    return folder
