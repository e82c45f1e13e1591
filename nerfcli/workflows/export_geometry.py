"""Export the geometry of a run: surfaces, points, volumes, and COLMAP's dense folder, in the scene's frame and unit."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerfcli import __version__
from nerfcli.atomic import atomic_folder
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import up_direction
from nerfcli.cameras.rigid import look_at
from nerfcli.errors import UserError, in_shell
from nerfcli.media.las_files import SUFFIXES as LAS_SUFFIXES
from nerfcli.media.las_files import las_module, write_las
from nerfcli.media.mesh_files import write_glb, write_obj, write_ply
from nerfcli.media.volume_files import Volume, write_nrrd, write_volume_npz
from nerfcli.photos.loading import load_photo
from nerfcli.photos.undistorted import pinhole_frame, pinhole_of, undistorted
from nerfcli.render.model import Model
from nerfcli.render.visibility import coverage_and_parallax
from nerfcli.runs.run import Run
from nerfcli.surface.colmap_dense import photo_name, write_photo, write_sparse, write_stereo
from nerfcli.surface.colours import surface_colours
from nerfcli.surface.extent import Grid, automatic_voxel, scene_box
from nerfcli.surface.fusion import fuse
from nerfcli.surface.marching import SEEN, Mesh, simplified, surface_of, without_small_pieces
from nerfcli.surface.points import agreed_points
from nerfcli.surface.settings import MOST_VIEWS, SurfaceSettings
from nerfcli.surface.views import DepthView, depth_views, spread_frames
from nerfcli.surface.volume import automatic_volume_voxel, sample_volume
from nerfcli.workflows.notices import Notify, Progress, part_of

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
    _write_mesh(path, mesh, colours, description, seen=seen, y_up=_y_up_from_scene(run))
    of_found = f" of {found}" if found != len(mesh.faces) else ""
    notify(f"{len(mesh.faces)} triangles{of_found}, {_grid_in_words(grid, model)}")


def export_points(
    run: Run, model: Model, path: Path, *, settings: SurfaceSettings, notify: Notify, progress: Progress
) -> None:
    """Write points of the surfaces as .ply, .las or .laz."""
    las = path.suffix.lower() in LAS_SUFFIXES
    if las:
        las_module()  # fails before the work if laspy is missing, not after it
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
    origin = run.config.origin
    if las and origin is not None and not origin.in_degrees:
        columns |= {axis: columns[axis] + shift for axis, shift in zip("xyz", origin.coordinates, strict=True)}
        box = np.add(described["box"], 2 * origin.coordinates).tolist()
        described |= {"frame": origin.system, "box": box}
        write_las(path, columns, description=described, system=(origin.system, origin.epsg))
    elif las:
        write_las(path, columns, description=described)
    else:
        write_ply(path, columns, description=described)
    notify(f"{len(points.places)} points that two photos or more see, {_grid_in_words(grid, model)}")


def export_volume(
    run: Run, model: Model, path: Path, *, settings: SurfaceSettings, notify: Notify, progress: Progress
) -> None:
    """Write density and colour on a grid as .npz, or only the density as .nrrd."""
    box = settings.box or scene_box(model, run.cameras.train)
    grid = Grid.over(box, settings.voxel_size or automatic_volume_voxel(box))
    maps = sample_volume(model, grid, on_progress=part_of(progress, 0.05, 1.0, "evaluating the field"))
    per_unit = "1/m" if model.unit == "metre" else "1 / unit"
    described = _description(run, model, "volume", grid) | {
        "density": f"fraction of light that ends per length, {per_unit}; 0 where rays pass over cells",
        "colour": "sRGB, mean over six directions; 0 where a voxel takes less than a thousandth of the light",
    }
    _write_volume(path, Volume(maps, grid.centres(np.zeros(3)), grid.voxel_size, described), "density")
    notify(_grid_in_words(grid, model))


def export_tsdf(
    run: Run, model: Model, path: Path, *, settings: SurfaceSettings, notify: Notify, progress: Progress
) -> None:
    """Write the signed distances that the mesh is made from, with their weights as .npz or without them as .nrrd."""
    views, grid = _seen(run, model, settings, progress)
    fused = fuse(views, grid, on_progress=part_of(progress, _DEPTHS, 1.0, "fuses"))
    distance, weight = fused.dense((0, 0, 0), grid.shape)
    described = _description(run, model, "tsdf", grid) | {
        "distance": "to the surface, positive outside, in the unit; NaN where too few photos see",
        "truncation": fused.truncation,
        "weight": f"sum over photos; {SEEN} and more count as seen",
    }
    maps = {"distance": np.where(weight >= SEEN, distance, np.float32(np.nan)), "weight": weight}
    _write_volume(path, Volume(maps, grid.centres(np.zeros(3)), grid.voxel_size, described), "distance")
    notify(_grid_in_words(grid, model))


def export_colmap_dense(
    run: Run, model: Model, path: Path, *, settings: SurfaceSettings, notify: Notify, progress: Progress
) -> None:
    """Write a folder that COLMAP's fusion reads."""
    factor = run.config.downscale
    there = [frame for frame in run.cameras.train if frame.image is not None]
    frames = [replace(frame, name=photo_name(frame.name)) for frame in spread_frames(there, MOST_VIEWS)]
    if not frames:
        raise UserError(f"{run.path} has no photos", "use a run that was trained on photos")
    views, grid = _seen(run, model, settings, progress, frames=frames)
    points = agreed_points(views, grid)
    if not len(points.places):
        raise UserError("no two photos see the same point in the box", "use another --box, or train longer")
    with atomic_folder(path) as partial:
        cameras = []
        for index, frame in enumerate(frames):
            photo = load_photo(frame, factor, "ignore")
            pinhole = pinhole_of(photo.frame.camera)
            pixels, _ = undistorted(photo.pixels, photo.frame.camera, pinhole)
            write_photo(partial / "images" / frame.name, pixels[..., :3])
            cameras.append(pinhole_frame(photo.frame))
            progress(_DEPTHS + (1 - _DEPTHS) * (index + 1) / len(frames), "photos")
        write_sparse(partial, cameras, points)
        write_stereo(partial, views)
    notify(
        f"{len(frames)} photos share {len(points.places)} points; to fuse them: "
        f"colmap stereo_fusion --workspace_path {in_shell(path)}"
    )
    if model.unit != "arbitrary":
        notify(f"COLMAP's files hold no unit: their lengths are in {model.unit}s, as those of the scene")


def _seen(
    run: Run, model: Model, settings: SurfaceSettings, progress: Progress, *, frames: Sequence[Frame] | None = None
) -> tuple[list[DepthView], Grid]:
    """Return depth maps of the training cameras, and the grid to fuse them in."""
    chosen = spread_frames(run.cameras.train, MOST_VIEWS) if frames is None else frames
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
        **provenance_of(run, model),
    }


def provenance_of(run: Run, model: Model) -> dict[str, Any]:
    """Return the unit of lengths and the origin of an exported file."""
    return {
        "unit": model.unit,
        "unit_source": model.unit_source,
        "nerfcli": __version__,
        "run": run.path.resolve().name,
        "field_sha256": model.sha256,
    }


def _grid_in_words(grid: Grid, model: Model) -> str:
    return f"{'x'.join(map(str, grid.shape))} voxels of {grid.voxel_size:.4g} {unit_of(model)}"


def unit_of(model: Model) -> str:
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


def _write_volume(path: Path, volume: Volume, name: str) -> None:
    if path.suffix.lower() == ".nrrd":
        write_nrrd(volume, name, path)
    else:
        write_volume_npz(volume, path)


def _y_up_from_scene(run: Run) -> np.ndarray:
    """Return the rotation that turns up to +y: z of a georeferenced scene, else the up direction of the cameras."""
    up = up_direction(run.cameras.train) if run.config.origin is None else np.array([0.0, 0.0, 1.0])
    aside = np.eye(3)[np.argmin(np.abs(up))]
    # The axes (right, down, ahead) of a camera whose down direction is -up.
    right, down, ahead = look_at(np.zeros(3), np.cross(up, aside), up)[:3, :3].T
    return np.stack([right, -down, -ahead])
