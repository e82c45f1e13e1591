"""Render pictures, depth maps and videos of a run, resume, or keep existing ones."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from nerfcli.errors import UserError
from nerfcli.machine import device_name, thread_count
from nerfcli.notices import Notify, Progress, no_progress, part_of, silent
from nerfcli.render.frames import export_frames, export_part
from nerfcli.render.job import RenderJob, refuse_foreign
from nerfcli.render.outputs import OUTPUTS, ExportSettings
from nerfcli.render.renderable import Renderable
from nerfcli.training.runs.run import Run, load_run
from nerfcli.workflows.photo_depths import depth_errors, photo_depths
from nerfcli.workflows.splats import file_digest, load_splats
from nerfcli.workflows.views import (
    PATHS,
    Views,
    chosen_frames,
    frames_of_file,
    refuse_z_depth_for_equirectangular,
    usual_depth,
)

RENDERS = "renders"
HELD_OUT = Views("test")


def folder_name(views: Views, settings: ExportSettings) -> str:
    """Return the name of the folder in RUN/renders: the views and, so that conventions never mix, the kind of depth."""
    if not settings.measured:
        return views.name
    return f"{views.name}-{settings.depth.convention.replace(':', '-')}-{settings.depth.axis}"


def usual_settings(run: Run, views: Views) -> ExportSettings:
    """Return the settings of colours, depths and opacities, as `nerfcli render` writes them by default."""
    return ExportSettings(outputs=OUTPUTS[:3], depth=usual_depth(run, views))


def render_run(
    run: str | Path,
    target: str | Path | None = None,
    *,
    views: Views = HELD_OUT,
    settings: ExportSettings | None = None,
    splats: str | Path | None = None,
    device: str = "auto",
    threads: int = 0,
    part: slice | None = None,
    overwrite: bool = False,
    notify: Notify = silent,
    progress: Progress = no_progress,
) -> list[Path]:
    """Render views of a run into a folder, or keep a complete folder with the same views and settings.

    Example:
        >>> import nerfcli
        >>> from nerfcli.workflows.views import Views
        >>> nerfcli.render_run("photos-scene-run", views=Views("orbit", count=120))

    Args:
        run: the folder that `train_scene` wrote.
        target: the folder to write; in RUN/renders by default, named after views and depth.
        views: which cameras; the held-out ones by default.
        settings: outputs, depth, file formats, videos, and steps along rays; `usual_settings` by default.
        splats: a .ply or .spz to render instead of the field.
        device: "auto", "cpu", "cuda" or "cuda:1".
        threads: number of CPU threads; 0 for all.
        part: render only these views, for a later call to complete; None for all.
        overwrite: replace existing renders at `target`.
        notify: called with lines for the user.
        progress: called with the fraction of the rays that is done, and a short text.

    Returns:
        The paths to show: videos, or the folders of the outputs; the unfinished folder if only a part is rendered.

    Raises:
        UserError: the run or the cameras do not exist, or `target` holds other files.
    """
    trained, cores, torch_device = Run(Path(run)), thread_count(threads), device_name(device)
    settings = usual_settings(load_run(run), views) if settings is None else settings
    name = folder_name(views, settings) + ("-splats" if splats is not None else "")
    folder = trained.path / RENDERS / name if target is None else Path(target)
    torch.set_num_threads(cores)
    model = trained.model(torch_device)
    shown: Renderable = model.stretched(settings.step)
    seen = ()
    provenance: dict[str, Any] = {"cameras": views.cameras, "run": trained.path.name, "field_sha256": model.sha256}
    if splats is not None:
        shown, of_file = load_splats(splats, notify=notify), file_digest(Path(splats))
        provenance |= {"splats": Path(splats).name, "splats_sha256": of_file}
    if settings.needs_visibility:
        depths = part_of(progress, 0.0, 1.0, "depths of the training photos")
        seen = photo_depths(trained, model, on_progress=depths, notify=notify)
        provenance["training_photos"] = len(seen)
    errors = None
    if settings.needs_errors:
        depths = part_of(progress, 0.0, 1.0, "depth of the held-out photos")
        errors = depth_errors(trained, model, seen, threads=cores, on_progress=depths, notify=notify)
        provenance["measured_photos"] = errors.photos
    if settings.depth.convention == "background" and settings.depth.background_distance is None:
        farthest = model.marching.far / model.training_from_scene.scale
        settings = replace(settings, depth=replace(settings.depth, background_distance=farthest))
    # The unit of the training frame is about the distance between the cameras and what they look at.
    frames = chosen_frames(trained, views, depth_hint=1.0 / model.training_from_scene.scale)
    if "depth" in settings.outputs and settings.depth.axis == "z":
        refuse_z_depth_for_equirectangular(frames, notify=notify)
    job = RenderJob(tuple(frames), settings, provenance, seen, errors)
    return _export(shown, job, folder, part=part, threads=cores, overwrite=overwrite, notify=notify, progress=progress)


def render_splats(
    file: str | Path,
    target: str | Path | None = None,
    *,
    views: Views,
    settings: ExportSettings,
    threads: int = 0,
    part: slice | None = None,
    overwrite: bool = False,
    notify: Notify = silent,
    progress: Progress = no_progress,
) -> list[Path]:
    """Render splats of any program with the cameras of a file or folder; the other arguments are as for `render_run`.

    Args:
        file: a .ply or .spz.
        target: the folder to write; FILE-renders/CAMERAS beside the file by default.

    Raises:
        UserError: the file cannot be read, the cameras are those of a run, or an output needs training photos.
    """
    path, cores = Path(file), thread_count(threads)
    if not path.is_file():
        raise UserError(f"there is no {path}", "give a .ply or .spz of splats")
    if views.cameras in ("test", "train", *PATHS):
        raise UserError(
            f"{path} has no cameras, so --cameras {views.cameras} is not known",
            "give a file or folder of cameras, or render the run: nerfcli render RUN --splats FILE",
            exit_code=2,
        )
    if settings.needs_visibility:
        raise UserError(
            "coverage, parallax and errors of depth need training photos",
            "leave them out, or render the run: nerfcli render RUN --splats FILE",
            exit_code=2,
        )
    torch.set_num_threads(cores)
    splats = load_splats(path, notify=notify)
    frames = frames_of_file(views)
    if "depth" in settings.outputs and settings.depth.axis == "z":
        refuse_z_depth_for_equirectangular(frames, notify=notify)
    provenance = {"cameras": views.cameras, "splats": path.name, "splats_sha256": file_digest(path)}
    folder = path.with_name(f"{path.stem}-{RENDERS}") / folder_name(views, settings) if target is None else Path(target)
    job = RenderJob(tuple(frames), settings, provenance)
    return _export(splats, job, folder, part=part, threads=cores, overwrite=overwrite, notify=notify, progress=progress)


def _export(
    shown: Renderable,
    job: RenderJob,
    folder: Path,
    *,
    part: slice | None,
    threads: int,
    overwrite: bool,
    notify: Notify,
    progress: Progress,
) -> list[Path]:
    """Render an job, or keep a complete folder."""
    frames = job.frames
    chosen = range(len(frames))[part] if part is not None else range(len(frames))
    if not chosen:
        raise UserError(f"--frames: there are only {len(frames)} views", "views are counted from 0", exit_code=2)
    refuse_foreign(folder)
    if not overwrite and job.is_held_by(folder):
        notify(f"{folder} is kept: it is complete and has these settings; add --overwrite to render again")
        return job.results(folder)

    total = sum(map(job.rays, chosen))
    done = 0

    def on_rays(rays: int) -> None:
        nonlocal done
        done += rays
        progress(done / total, f"of {len(chosen)} frames")

    progress(0.0, "")
    if part is not None:
        return [export_part(shown, job, folder, chosen, on_rays=on_rays, notify=notify, threads=threads)]
    return export_frames(shown, job, folder, on_rays=on_rays, notify=notify, threads=threads)
