"""Export a run to files that other programs open: a page, a mesh, points, splats."""

from pathlib import Path

import torch

from nerfcli.atomic import cannot_write, refuse_read_only
from nerfcli.errors import UserError
from nerfcli.export.extent import SurfaceSettings, check_box, scene_box
from nerfcli.machine import device_name, thread_count
from nerfcli.notices import Notify, Progress, no_progress, part_of, silent
from nerfcli.pages.page import write_page
from nerfcli.photos.loading import pinhole_frame
from nerfcli.render.model import Model
from nerfcli.training.runs.run import Run
from nerfcli.viewer.packing import pack_model, seen_cells
from nerfcli.viewer.page import PageNumbers, page_html
from nerfcli.viewer.pictures import page_photos
from nerfcli.viewer.proof import make_proof
from nerfcli.workflows.export_geometry import export_mesh, export_points
from nerfcli.workflows.photo_depths import photo_depths
from nerfcli.workflows.splats import SplatSettings, export_splats

# Maximum size of a page; the field comes first, and photos get the rest.
PAGE_BYTES = 9_700_000
# File suffixes by type of export, the default first.
TARGETS = {
    "page": (".html",),
    "mesh": (".ply", ".glb", ".obj"),
    "points": (".ply",),
    "splats": (".ply", ".spz", ".html"),
}
SURFACE, SPLATS = SurfaceSettings(), SplatSettings()


def export_run(
    run: str | Path,
    target: str | Path | None = None,
    *,
    to: str,
    settings: SurfaceSettings = SURFACE,
    splats: SplatSettings = SPLATS,
    device: str = "auto",
    threads: int = 0,
    overwrite: bool = False,
    notify: Notify = silent,
    progress: Progress = no_progress,
) -> Path:
    """Export a run to a file that other programs open.

    Example:
        >>> import nerfcli
        >>> nerfcli.export_run("photos-scene-run", to="page")

    Args:
        run: the folder that `train_scene` wrote.
        target: the file to write, whose suffix chooses among the formats of `to`; beside the run by default.
        to: one of `TARGETS`.
        settings: region and resolution of a geometry.
        splats: number, refinement and frame of splats.
        device: "auto", "cpu", "cuda" or "cuda:1".
        threads: number of CPU threads; 0 for all.
        overwrite: replace an existing export at `target`.
        notify: called with lines for the user.
        progress: called with the fraction of the work that is done, and a short text.

    Returns:
        The path that was written.

    Raises:
        UserError: the run does not exist, `target` exists, or the field cannot be exported this way.
    """
    trained, torch_device = Run(Path(run)), device_name(device)
    path = Path(target) if target is not None else default_target(trained.path, to)
    suffixes = TARGETS[to]
    if path.suffix.lower() not in suffixes:
        raise UserError(f"{path} does not have the suffix of a {to}", f"use one of {', '.join(suffixes)}", exit_code=2)
    if settings.box is not None:
        check_box(settings.box)
    _ = trained.config
    _refuse_existing(path, overwrite=overwrite)
    torch.set_num_threads(thread_count(threads))
    model = trained.model(torch_device)
    progress(0.0, "")
    if to == "splats":
        export_splats(trained, model, path, settings=splats, notify=notify, progress=progress)
    else:
        _EXPORTS[to](trained, model, path, settings=settings, notify=notify, progress=progress)
    return path


def default_target(run: Path, to: str, suffix: str | None = None) -> Path:
    """Return the default path of an export: beside the run, named after it."""
    place = run.resolve()
    name = place.name if to == "page" else f"{place.name}-{to}"
    return (run if run.name not in ("", "..") else place).with_name(name + (suffix or TARGETS[to][0]))


def _refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Refuse an output path that exists, unless it may be replaced; create its parent folder.

    Raises:
        UserError: the path exists, or cannot be written.
    """
    if path.is_dir():
        raise UserError(f"{path} is a folder", "give a file name with -o")
    if path.exists() and not overwrite:
        raise UserError(f"{path} exists", "add --overwrite to replace it, or choose another path with -o")
    if not path.resolve().parent.is_dir():
        try:
            path.resolve().parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(path, error) from error
    refuse_read_only(path)


def _export_page(
    run: Run, model: Model, path: Path, *, settings: SurfaceSettings, notify: Notify, progress: Progress
) -> None:
    """Write the run as a page."""
    packed = pack_model(model)
    cameras = run.cameras
    frames = [pinhole_frame(frame) for frame in (*cameras.train, *cameras.test)]
    box = settings.box or scene_box(model, frames)
    proof = make_proof(model, frames)
    progress(0.1, "depths of the training photos")
    depths = part_of(progress, 0.1, 0.4, "depths of the training photos")
    seen = photo_depths(run, model, on_progress=depths, notify=notify)
    numbers = PageNumbers.of(packed, proof, seen_cells(model, seen))
    text_bytes = len(numbers.elements)
    photos = page_photos(
        model,
        cameras.train,
        cameras.test,
        room_bytes=PAGE_BYTES - text_bytes - 150_000,
        threads=torch.get_num_threads(),
        on_progress=part_of(progress, 0.4, 1.0, "photos"),
    )
    if photos.missing:
        notify(f"{photos.missing} photos are missing: the page shows only their cameras")
    if text_bytes > PAGE_BYTES:
        notify(f"the field alone needs {text_bytes / 1e6:.0f} MB of text: the page is large and contains no photos")
    write_page(page_html(model, numbers, run=run.path, frames=frames, photos=photos, box=box), path)


_EXPORTS = {
    "page": _export_page,
    "mesh": export_mesh,
    "points": export_points,
}
