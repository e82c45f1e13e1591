"""Points of the surfaces that photos agree on: thinned, with normals, and with how well each is known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.surface.grid import Grid
from nerfcli.surface.views import DepthView

# A depth counts where the pixel is this opaque, and median and mean are within this share of it of each other.
_OPAQUE, _AGREEING = 0.9, 0.02
# Another photo sees a point where its own depth there is within this share of the point's distance from it.
_SAME = 0.01
# From the side a depth is another one within a pixel: the cosine between normal and ray at least.
_FLATTEST = 0.1
# Photos that have to see a point.
LEAST_PHOTOS = 2


@dataclass(frozen=True)
class Points:
    """N points of surfaces.

    Args:
        places: (N, 3) float64, scene's frame.
        normals: (N, 3) float32 unit, towards the camera that saw the point best.
        colours: (N, 3) uint8 sRGB, as that camera sees it.
        photos: (N,) how many see it.
        parallax_deg: (N,) the largest angle between the rays of two photos that do.
        spread: (N,) standard deviation of where light ends, scene units.
        seen: (N, views) bool.
    """

    places: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    photos: np.ndarray
    parallax_deg: np.ndarray
    spread: np.ndarray
    seen: np.ndarray


def agreed_points(
    views: Sequence[DepthView], grid: Grid, *, on_progress: Callable[[float], None] = lambda share: None
) -> Points:
    """Return one point at most for each voxel of a grid: of all depths in it the narrowest, if two photos see it.

    Args:
        views: what the photos' cameras see.
        grid: whose voxels thin the points out.
        on_progress: called with how much is done.
    """
    candidates = _thinned(views, grid)
    count = len(candidates.places)
    seen, towards = np.zeros((count, len(views)), bool), np.zeros((count, len(views), 3), np.float32)
    for index, view in enumerate(views):
        ray = candidates.places - view.frame.centre
        towards[:, index] = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-30)
        facing = -(towards[:, index] * candidates.normals).sum(axis=1)
        seen[:, index] = _sees(view, candidates.places) & (facing > _FLATTEST)
        on_progress((index + 1) / len(views))
    photos = seen.sum(axis=1)
    kept = photos >= LEAST_PHOTOS
    return Points(
        places=candidates.places[kept],
        normals=candidates.normals[kept],
        colours=candidates.colours[kept],
        photos=photos[kept].astype(np.uint16),
        parallax_deg=_parallax_deg(seen[kept], towards[kept]),
        spread=candidates.spread[kept],
        seen=seen[kept],
    )


@dataclass(frozen=True)
class _Candidates:
    places: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    spread: np.ndarray


def _thinned(views: Sequence[DepthView], grid: Grid) -> _Candidates:
    """Of all depths that are sure, the one of each voxel with the smallest spread."""
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
        # Within a view first: most of a view's pixels share voxels with their neighbours.
        best = _best(keys, spread)
        parts.append((keys[best], places[inside][best], normals[best], levels[best], spread[best]))
    keys, places, normals, levels, spread = (np.concatenate(column) for column in zip(*parts, strict=True))
    best = _best(keys, spread)
    return _Candidates(places[best], normals[best].astype(np.float32), levels[best], spread[best].astype(np.float32))


def _best(keys: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Where the smallest spread of each key is, in the order of the keys."""
    order = np.lexsort((spread, keys))
    return order[np.unique(keys[order], return_index=True)[1]]


def _sees(view: DepthView, places: np.ndarray) -> np.ndarray:
    """(N,) whether a view's own depth at the pixel of a point is the point's."""
    pose, camera = view.frame.world_from_cam, view.frame.camera
    fx, fy, cx, cy = camera.params
    x, y, z = ((places - pose[:3, 3]) @ pose[:3, :3]).T
    ahead = z > 0
    deep = np.where(ahead, z, 1.0)
    # Pixel (i, j) covers [j, j + 1) x [i, i + 1).
    column, row = np.floor(fx * x / deep + cx), np.floor(fy * y / deep + cy)
    inside = ahead & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    seen = np.zeros(len(places), dtype=bool)
    at = (row[inside].astype(int), column[inside].astype(int))
    with np.errstate(invalid="ignore"):
        seen[inside] = np.abs(view.depth[at] - z[inside]) <= _SAME * z[inside]
    return seen


def _parallax_deg(seen: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """(N,) the largest angle between two of the rays (N, views, 3) that see a point."""
    largest = np.zeros(len(seen), np.float32)
    for index in range(seen.shape[1]):
        rows = np.flatnonzero(seen[:, index])
        cosine = np.einsum("nvc,nc->nv", towards[rows], towards[rows, index])
        smallest = np.where(seen[rows], cosine, 1.0).min(axis=1, initial=1.0)
        largest[rows] = np.maximum(largest[rows], np.degrees(np.arccos(np.clip(smallest, -1, 1))))
    return largest
