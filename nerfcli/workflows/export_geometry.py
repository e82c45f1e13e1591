"""Export the geometry of a run, surfaces and points, in the scene's frame and unit."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerfcli.cameras.layout import up_direction
from nerfcli.cameras.rigid import look_at
from nerfcli.errors import UserError
from nerfcli.export.depth_views import DepthView, depth_views, spread_frames, surface_colours
from nerfcli.export.extent import MOST_VIEWS, Grid, SurfaceSettings, automatic_voxel, scene_box
from nerfcli.export.fusion import fuse
from nerfcli.export.marching import Mesh, simplified, surface_of, without_small_pieces
from nerfcli.export.mesh_files import write_glb, write_obj
from nerfcli.export.points import agreed_points
from nerfcli.notices import Notify, Progress, part_of
from nerfcli.ply import write_ply
from nerfcli.render.coverage import coverage_and_parallax
from nerfcli.render.model import Model
from nerfcli.training.runs.run import Run
from nerfcli.version import __version__

FORMAT = "nerfcli geometry 1"
FRAME = "of the scene, as its cameras have it"
PARALLAX = "largest angle between the rays of two photos that see the point"
# Fraction of the work that is spent on rendering depths.
_DEPTHS = 0.7


def export_mesh(
    run: Run, model: Model, path: Path, *, settings: SurfaceSettings, notify: Notify, progress: Progress
) -> None:
    """Write the surface as .ply, .glb or .obj."""
    views, grid = _seen(run, model, settings, progress)
    fused = fuse(views, grid, on_progress=part_of(progress, _DEPTHS, 0.9, "fuses"))
    mesh = without_small_pieces(surface_of(fused, on_progress=part_of(progress, 0.9, 0.95, "marches")))
    if not len(mesh.faces):
        raise UserError("no surface found in the box", "use another --box, a larger --voxel-size, or train longer")
    found = len(mesh.faces)
    mesh = simplified(mesh, settings.faces, threads=torch.get_num_threads())
    progress(0.97, "colours")
    colours = surface_colours(model, mesh.vertices, mesh.normals, voxel_size=grid.voxel_size)
    description = _description(run, model, "mesh", grid) | {
        "faces_before_simplification": found,
        "made_by": "truncated signed distances of median depths, marching cubes",
    }
    seen: dict[str, np.ndarray] = {}
    if path.suffix.lower() == ".ply":
        photos, parallax = coverage_and_parallax([view.distances() for view in views], mesh.vertices)
        seen = {"photos": photos.astype(np.uint16), "parallax_deg": parallax}
        description |= {"parallax_deg": PARALLAX}
    _write_mesh(path, mesh, colours, description, seen=seen, y_up=y_up_from_scene(run))
    of_found = f" of {found}" if found != len(mesh.faces) else ""
    notify(f"{len(mesh.faces)} triangles{of_found}, {_grid_in_words(grid, model)}")


def export_points(
    run: Run, model: Model, path: Path, *, settings: SurfaceSettings, notify: Notify, progress: Progress
) -> None:
    """Write points of the surfaces as .ply."""
    views, grid = _seen(run, model, settings, progress)
    points = agreed_points(views, grid, on_progress=part_of(progress, _DEPTHS, 1.0, "compares"))
    if not len(points.places):
        raise UserError("no two photos see the same point in the box", "use another --box, or train longer")
    columns = dict(zip("xyz", points.places.T, strict=True))
    columns |= dict(zip(("nx", "ny", "nz"), points.normals.T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), points.colours.T, strict=True))
    columns |= {"photos": points.photos, "parallax_deg": points.parallax_deg, "spread": points.spread}
    described = _description(run, model, "points", grid) | {
        "parallax_deg": PARALLAX,
        "spread": "standard deviation of where the light of the pixel ends, in the unit",
    }
    write_ply(path, columns, description=described)
    notify(f"{len(points.places)} points that two photos or more see, {_grid_in_words(grid, model)}")


def _seen(run: Run, model: Model, settings: SurfaceSettings, progress: Progress) -> tuple[list[DepthView], Grid]:
    """Return depth maps of the training cameras, and the grid to fuse them in."""
    chosen = spread_frames(run.cameras.train, MOST_VIEWS)
    box = settings.box or scene_box(model, run.cameras.train)
    views = depth_views(
        model, chosen, max_size=settings.max_size, on_progress=part_of(progress, 0.02, _DEPTHS, "renders depths")
    )
    return views, Grid.over(box, settings.voxel_size or automatic_voxel(views, box))


def _description(run: Run, model: Model, kind: str, grid: Grid) -> dict[str, Any]:
    """Return the description that an exported file contains."""
    return {
        "format": FORMAT,
        "holds": kind,
        "frame": FRAME,
        "box": [*grid.low.tolist(), *grid.high.tolist()],
        "voxel_size": grid.voxel_size,
        **_provenance_of(run, model),
    }


def _provenance_of(run: Run, model: Model) -> dict[str, Any]:
    """Return the unit of lengths and the run of an exported file."""
    return {
        "unit": model.unit,
        "unit_source": model.unit_source,
        "nerfcli": __version__,
        "run": run.path.resolve().name,
        "field_sha256": model.sha256,
    }


def _grid_in_words(grid: Grid, model: Model) -> str:
    return f"{'x'.join(map(str, grid.shape))} voxels of {grid.voxel_size:.4g} {_unit_of(model)}"


def _unit_of(model: Model) -> str:
    """Return the unit of lengths, for messages."""
    return "m" if model.unit == "metre" else "units of the scene"


def _write_mesh(
    path: Path,
    mesh: Mesh,
    colours: np.ndarray,
    description: Mapping[str, Any],
    *,
    seen: Mapping[str, np.ndarray],
    y_up: np.ndarray,
) -> None:
    match path.suffix.lower():
        case ".glb":
            write_glb(
                path,
                mesh.vertices,
                mesh.faces,
                normals=mesh.normals,
                colours=colours,
                y_up_from_frame=y_up,
                description=description,
            )
        case ".obj":
            write_obj(path, mesh.vertices, mesh.faces, colours=colours, description=description)
        case _:
            columns = dict(zip("xyz", mesh.vertices.T, strict=True))
            columns |= dict(zip(("nx", "ny", "nz"), mesh.normals.astype("<f4").T, strict=True))
            columns |= dict(zip(("red", "green", "blue"), colours.T, strict=True))
            write_ply(path, {**columns, **seen}, faces=mesh.faces, description=description)


def y_up_from_scene(run: Run) -> np.ndarray:
    """Return the rotation that turns the up direction of the cameras to +y."""
    up = up_direction(run.cameras.train)
    aside = np.eye(3)[np.argmin(np.abs(up))]
    # The axes (right, down, ahead) of a camera whose down direction is -up.
    right, down, ahead = look_at(np.zeros(3), np.cross(up, aside), up)[:3, :3].T
    return np.stack([right, -down, -ahead])
