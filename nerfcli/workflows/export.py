"""Export a run to files that other programs open: a page, a mesh, points, splats."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerfcli.cameras.frame import chosen_evenly
from nerfcli.errors import UserError
from nerfcli.export.depth_views import DepthView, depth_views, surface_colours
from nerfcli.export.extent import MOST_VIEWS, Grid, SurfaceSettings, automatic_voxel, scene_box
from nerfcli.export.fusion import agreed_points, fuse
from nerfcli.export.mesh_facts import SUFFIXES as MESH_SUFFIXES
from nerfcli.export.meshes import simplified, surface_of, without_small_pieces, write_glb, write_obj
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.pages.page import write_page
from nerfcli.photos.loading import pinhole_frame
from nerfcli.ply import write_ply
from nerfcli.render.coverage import coverage_and_parallax
from nerfcli.render.model import Model
from nerfcli.training.runs.run import Run
from nerfcli.viewer.packing import pack_model, seen_cells
from nerfcli.viewer.page import numbers_of, page_html, scene_of
from nerfcli.viewer.pictures import make_proof, page_photos
from nerfcli.workflows.photo_depths import photo_depths
from nerfcli.workflows.splats import SplatSettings, export_splats, provenance_of, y_up_from_scene

# Maximum size of a page; the field comes first, and photos get the rest.
PAGE_BYTES = 9_700_000
# File suffixes by type of export, the default first.
TARGETS = {
    "page": (".html",),
    "mesh": MESH_SUFFIXES,
    "points": (".ply",),
    "splats": (".ply", ".spz", ".html"),
}


def export_run(
    run: str | Path,
    output: Output = Output(),
    *,
    to: str,
    settings: SurfaceSettings = SurfaceSettings(),
    splats: SplatSettings = SplatSettings(),
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> Path:
    """Export a run to a file that other programs open.

    Example:
        >>> import nerfcli
        >>> nerfcli.export_run("photos-scene-run", to="page")

    Args:
        run: the folder that `train_scene` wrote.
        output: the file to write, whose suffix chooses among the formats of `to`; beside the run by default.
        to: one of `TARGETS`.
        settings: region and resolution of a geometry.
        splats: number, refinement and frame of splats.
        resources: threads and device.
        reporter: receives messages, and the fraction of the work that is done.

    Returns:
        The path that was written.

    Raises:
        UserError: the run does not exist, the output exists, or the field cannot be exported this way.
    """
    if to not in TARGETS:
        raise UserError(f"unknown kind of export: {to!r}", f"choose {', '.join(TARGETS)}", exit_code=2)
    trained, torch_device = Run(Path(run)), resources.torch_device
    path = output.at(default_target(trained.path, to))
    suffixes = TARGETS[to]
    if path.suffix.lower() not in suffixes:
        raise UserError(f"{path} does not have a suffix of --to {to}", f"use one of {', '.join(suffixes)}", exit_code=2)
    _ = trained.config
    output.claim_file(path)
    resources.begin()
    model = trained.model(torch_device)
    reporter.progress(0.0, "")
    if to == "splats":
        export_splats(trained, model, path, settings=splats, reporter=reporter)
    else:
        write = {"page": _export_page, "mesh": _export_mesh, "points": _export_points}[to]
        write(trained, model, path, settings=settings, reporter=reporter)
    return path


def default_target(run: Path, to: str, suffix: str | None = None) -> Path:
    """Return the default path of an export: beside the run, named after it."""
    place = run.resolve()
    name = place.name if to == "page" else f"{place.name}-{to}"
    return (run if run.name not in ("", "..") else place).with_name(name + (suffix or TARGETS[to][0]))


def _export_page(run: Run, model: Model, path: Path, *, settings: SurfaceSettings, reporter: Reporter) -> None:
    packed = pack_model(model)
    cameras = run.cameras
    frames = [pinhole_frame(frame) for frame in (*cameras.train, *cameras.test)]
    box = settings.box or scene_box(model, [*cameras.train, *cameras.test])
    proof = make_proof(model, frames)
    reporter.progress(0.1, "depths of the training photos")
    seen = photo_depths(run, model, reporter, begin=0.1, end=0.4)
    description, numbers = numbers_of(packed, proof, seen_cells(model, seen))
    text_bytes = len(numbers)
    photos, missing = page_photos(
        run.cameras.exposures,
        cameras.train,
        cameras.test,
        room_bytes=PAGE_BYTES - text_bytes - 150_000,
        on_progress=reporter.part(0.4, 1.0, "photos"),
    )
    if missing:
        reporter.note(f"{missing} photos are missing: the page shows only their cameras")
    if text_bytes > PAGE_BYTES:
        reporter.note(
            f"the field alone needs {text_bytes / 1e6:.0f} MB of text: the page is large and contains no photos"
        )
    scene = scene_of(model, run=run.path, frames=frames, photos=photos, box=box)
    write_page(page_html(scene | description, numbers), path)


FORMAT = "nerfcli geometry 1"
FRAME = "of the scene, as its cameras have it"
PARALLAX = "largest angle between the rays of two photos that see the point"
# Fraction of the work that is spent on rendering depths.
_DEPTHS = 0.7


def _export_mesh(run: Run, model: Model, path: Path, *, settings: SurfaceSettings, reporter: Reporter) -> None:
    views, grid = _seen(run, model, settings, reporter)
    fused = fuse(views, grid, on_progress=reporter.part(_DEPTHS, 0.9, "fusing depths"))
    mesh = without_small_pieces(surface_of(fused, on_progress=reporter.part(0.9, 0.95, "extracting the surface")))
    if not len(mesh.faces):
        raise UserError("no surface found in the box", "use another --box, a larger --voxel-size, or train longer")
    found = len(mesh.faces)
    mesh = simplified(mesh, settings.faces, threads=torch.get_num_threads())
    reporter.progress(0.97, "colours")
    colours = surface_colours(model, mesh.vertices, mesh.normals, voxel_size=grid.voxel_size)
    described = _description(run, model, "mesh", grid) | {
        "faces_before_simplification": found,
        "made_by": "truncated signed distances of median depths, marching cubes",
    }
    match path.suffix.lower():
        case ".glb":
            write_glb(path, mesh, colours=colours, y_up_from_frame=y_up_from_scene(run), description=described)
        case ".obj":
            write_obj(path, mesh, colours=colours, description=described)
        case ".ply":
            photos, parallax = coverage_and_parallax([view.distances() for view in views], mesh.vertices)
            columns = _columns(mesh.vertices, mesh.normals.astype("<f4"), colours)
            columns |= {"photos": photos.astype(np.uint16), "parallax_deg": parallax}
            write_ply(path, columns, faces=mesh.faces, description=described | {"parallax_deg": PARALLAX})
    of_found = f" of {found}" if found != len(mesh.faces) else ""
    reporter.note(f"{len(mesh.faces)} triangles{of_found}, {_grid_in_words(grid, model)}")


def _export_points(run: Run, model: Model, path: Path, *, settings: SurfaceSettings, reporter: Reporter) -> None:
    views, grid = _seen(run, model, settings, reporter)
    points = agreed_points(views, grid, on_progress=reporter.part(_DEPTHS, 1.0, "comparing views"))
    if not len(points.places):
        raise UserError("no two photos see the same point in the box", "use another --box, or train longer")
    columns = _columns(points.places, points.normals, points.colours)
    columns |= {"photos": points.photos, "parallax_deg": points.parallax_deg, "spread": points.spread}
    described = _description(run, model, "points", grid) | {
        "parallax_deg": PARALLAX,
        "spread": "standard deviation of where the light of the pixel ends, in the unit",
    }
    write_ply(path, columns, description=described)
    reporter.note(f"{len(points.places)} points that two photos or more see, {_grid_in_words(grid, model)}")


def _seen(run: Run, model: Model, settings: SurfaceSettings, reporter: Reporter) -> tuple[list[DepthView], Grid]:
    """Return depth maps of the training cameras, and the grid to fuse them in."""
    chosen = chosen_evenly(run.cameras.train, MOST_VIEWS)
    box = settings.box or scene_box(model, run.cameras.train)
    views = depth_views(
        model, chosen, max_size=settings.max_size, on_progress=reporter.part(0.02, _DEPTHS, "rendering depths")
    )
    return views, Grid.over(box, settings.voxel_size or automatic_voxel(views, box))


def _description(run: Run, model: Model, kind: str, grid: Grid) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "holds": kind,
        "frame": FRAME,
        "box": [*grid.low.tolist(), *grid.high.tolist()],
        "voxel_size": grid.voxel_size,
        **provenance_of(run, model),
    }


def _grid_in_words(grid: Grid, model: Model) -> str:
    unit = "m" if model.unit == "metre" else "units of the scene"
    return f"{'x'.join(map(str, grid.shape))} voxels of {grid.voxel_size:.4g} {unit}"


def _columns(places: np.ndarray, normals: np.ndarray, colours: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of a .ply that most programs read, from (N, 3) each."""
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    return dict(zip(names, (*places.T, *normals.T, *colours.T), strict=True))
