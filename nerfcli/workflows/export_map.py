"""Export an orthophoto and a map of heights of a run, in the coordinate system of its survey."""

from pathlib import Path

import numpy as np

from nerfcli.atomic import atomic_folder
from nerfcli.cameras.world import Origin
from nerfcli.errors import UserError
from nerfcli.media.geodesy import degrees_per_metre
from nerfcli.media.geotiff import MapPlace, write_geotiff
from nerfcli.render.model import Model
from nerfcli.runs.run import Run
from nerfcli.surface.extent import scene_box
from nerfcli.surface.ortho import SEEN, automatic_pixel, check_upright, ortho_of, typical_depth
from nerfcli.surface.settings import MOST_VIEWS, SurfaceSettings
from nerfcli.surface.views import depth_views, spread_frames
from nerfcli.workflows.export_geometry import provenance_of, unit_of
from nerfcli.workflows.notices import Notify, Progress, part_of

# Fraction of the work that is spent on the depths of photos.
_DEPTHS = 0.6


def export_ortho(
    run: Run, model: Model, path: Path, *, settings: SurfaceSettings, notify: Notify, progress: Progress
) -> None:
    """Write a folder with an orthophoto and a map of heights, as GeoTIFF."""
    frames = run.cameras.train
    check_upright(frames)
    box = settings.box or scene_box(model, frames)
    views = depth_views(
        model,
        spread_frames(frames, MOST_VIEWS),
        max_size=settings.max_size,
        on_progress=part_of(progress, 0.02, _DEPTHS, "renders depths"),
    )
    depth = typical_depth(views)
    pixel = settings.voxel_size or automatic_pixel(frames, run.config.downscale, depth, box)
    seen = [view.distances() for view in views]
    made = ortho_of(
        model,
        seen,
        box,
        pixel,
        height_above=depth,
        on_progress=part_of(progress, _DEPTHS, 1.0, "renders from above"),
    )
    shown = np.isfinite(made.heights)
    if not shown.any():
        raise UserError("no surface seen from above is in three photos", "use another --box, or train longer")
    origin = run.config.origin
    place = _place_on_map(made.corner, pixel, origin)
    described = {
        **provenance_of(run, model),
        "box": list(box),
        "seen": f"by {SEEN} photos or more; transparent or NaN elsewhere",
    }
    height = np.float32(origin.coordinates[2] if origin else 0.0)
    with atomic_folder(path) as partial:
        write_geotiff(partial / "orthophoto.tif", made.rgba, place, description={**described, "holds": "orthophoto"})
        write_geotiff(
            partial / "heights.tif", made.heights + height, place, description={**described, "holds": "heights"}
        )
    where = f"coordinates in {place.system}" if origin else "coordinates of the scene, which is not georeferenced"
    notify(
        f"{shown.shape[1]}x{shown.shape[0]} pixels of {pixel:.3g} {unit_of(model)}, three photos see "
        f"{100 * shown.mean():.0f} %; {where}"
    )


def _place_on_map(corner: tuple[float, float], pixel: float, origin: Origin | None) -> MapPlace:
    """Return where a map lies, with its upper left corner given in the scene's frame."""
    if origin is None:
        return MapPlace(corner, (pixel, pixel), None, False, "frame of the scene")
    a, b, height = origin.coordinates
    if not origin.in_degrees:
        return MapPlace((a + corner[0], b + corner[1]), (pixel, pixel), origin.epsg, False, origin.system)
    north, east = degrees_per_metre(a, height)
    return MapPlace(
        (b + east * corner[0], a + north * corner[1]), (east * pixel, north * pixel), origin.epsg, True, origin.system
    )
