"""Surface points that photos agree on: thinned, with normals, and with measures of their accuracy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.export.depth_views import DepthView
from nerfcli.export.extent import Grid
from nerfcli.render.coverage import largest_angle_deg, sees

# A depth counts if the pixel is at least this opaque, and median and mean differ by at most this fraction of it.
_OPAQUE, _AGREEING = 0.9, 0.02
# Smallest cosine between normal and ray: at grazing angles the depth changes too much within a pixel.
_FLATTEST = 0.1
# Fewest photos that must see a point.
LEAST_PHOTOS = 2


@dataclass(frozen=True)
class Points:
    """N surface points.

    Args:
        places: (N, 3) float64, scene's frame.
        normals: (N, 3) float32 unit, towards the camera that saw the point best.
        colours: (N, 3) uint8 sRGB, as that camera sees it.
        photos: (N,) number of photos that see the point.
        parallax_deg: (N,) the largest angle between the rays of two photos that see it.
        spread: (N,) standard deviation of the depth distribution, scene units.
    """

    places: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    photos: np.ndarray
    parallax_deg: np.ndarray
    spread: np.ndarray


def agreed_points(
    views: Sequence[DepthView], grid: Grid, *, on_progress: Callable[[float], None] = lambda fraction: None
) -> Points:
    """Return at most one point per voxel: the one with the smallest spread of depth, if two photos see it."""
    places, normals, colours, spread = _thinned(views, grid)
    seen = np.zeros((len(places), len(views)), dtype=bool)
    for index, view in enumerate(views):
        ray = places - view.frame.centre
        facing = -(ray * normals).sum(axis=1)
        seen[:, index] = sees(view.distances(), places)
        seen[:, index] &= facing > _FLATTEST * np.linalg.norm(ray, axis=1)
        on_progress((index + 1) / len(views))
    photos = seen.sum(axis=1)
    kept = photos >= LEAST_PHOTOS
    return Points(
        places=places[kept],
        normals=normals[kept],
        colours=colours[kept],
        photos=photos[kept].astype(np.uint16),
        parallax_deg=largest_angle_deg(seen[kept], places[kept], np.stack([view.frame.centre for view in views])),
        spread=spread[kept],
    )


def _thinned(views: Sequence[DepthView], grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the points with the smallest spread in each voxel, among reliable depths: the first fields of `Points`."""
    parts: list[tuple[np.ndarray, ...]] = []
    for view in views:
        with np.errstate(invalid="ignore"):
            sure = (view.opacity >= _OPAQUE) & (view.disagreement <= _AGREEING * view.depth)
            sure &= np.isfinite(view.normals).all(-1)
        places = view.points()[sure]
        cells = np.floor((places - grid.low) / grid.voxel_size).astype(np.int64)
        inside = ((cells >= 0) & (cells < grid.shape)).all(-1)
        normals = view.normals[sure][inside] @ view.frame.world_from_cam[:3, :3].T
        levels = np.rint(255 * np.clip(view.rgb[sure][inside], 0, 1)).astype(np.uint8)
        keys = np.asarray(np.ravel_multi_index(tuple(cells[inside].T), grid.shape))
        spread = np.nan_to_num(view.spread[sure][inside], nan=np.inf)
        # Thin out each view first: most of its pixels share voxels with their neighbours.
        best = _best(keys, spread)
        parts.append((keys[best], places[inside][best], normals[best], levels[best], spread[best]))
    keys, places, normals, levels, spread = (np.concatenate(column) for column in zip(*parts, strict=True))
    best = _best(keys, spread)
    return places[best], normals[best].astype(np.float32), levels[best], spread[best].astype(np.float32)


def _best(keys: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the index of the smallest spread of each key, in the order of the keys."""
    order = np.lexsort((spread, keys))
    return order[np.unique(keys[order], return_index=True)[1]]
