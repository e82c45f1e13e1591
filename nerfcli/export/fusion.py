"""Fuse depth maps into a truncated signed distance, averaged over the maps, in blocks near surfaces; or into points.

In a view, the signed distance of a voxel is that from its centre to the tangent plane of the surface at its pixel,
positive on the camera's side: (depth - z) / cosine_axis * cosine_surface. It is clamped to the truncation on the free
side; voxels farther than that behind the surface get nothing from the view. Views are averaged by the pixel's weight,
which decreases behind the surface, where there may be another side (Bylow et al. 2013, Real-time camera tracking and 3D
reconstruction using SDFs). The points are those that photos agree on, thinned.

Source: Curless and Levoy 1996, A volumetric method for building complex models from range images, eq. 3 and 4; blocks
as in Nießner et al. 2013, Real-time 3D reconstruction at scale using voxel hashing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import minimum_filter
from torch import Tensor

from nerfcli.cameras.rigid import apply
from nerfcli.export.depth_views import DepthView, plane_rays
from nerfcli.export.extent import Grid
from nerfcli.photos.colours import to_8_bit
from nerfcli.render.coverage import largest_angle_deg, sees

# Voxels along a side of a block.
SIDE = 8
# Truncation of the signed distance, in voxels.
TRUNCATION = 4.0
# Rays see a surface from this opacity on, and free space only below 0.02; those between are not used.
_OPAQUE = 0.5
# Surfaces seen at a smaller cosine between normal and ray are not used: the depth changes too much within a pixel.
_FLATTEST = 0.1


@dataclass(frozen=True)
class FusedVolume:
    """Signed distances in the blocks of a grid.

    Args:
        index: (Bx, By, Bz) int32, the row of each block; -1 where there is none.
        distance: (blocks, 8, 8, 8) float32, scene units, at most the truncation; 0 where the weight is 0.
        weight: (blocks, 8, 8, 8) float32, the sum of the views' weights.
    """

    grid: Grid
    index: np.ndarray
    distance: np.ndarray
    weight: np.ndarray

    @property
    def truncation(self) -> float:
        """Truncation in scene units."""
        return TRUNCATION * self.grid.voxel_size

    def dense(self, first: tuple[int, int, int], shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return distance and weight of `shape` voxels (x, y, z) from a block's corner `first`; 0 outside blocks."""
        low = [value // SIDE for value in first]
        counts = [-(-length // SIDE) for length in shape]
        rows = np.full(counts, -1, np.int32)
        there = [max(0, min(count, total - at)) for at, count, total in zip(low, counts, self.index.shape, strict=True)]
        part = tuple(slice(at, at + count) for at, count in zip(low, there, strict=True))
        rows[: there[0], : there[1], : there[2]] = self.index[part]
        filled = []
        for values in (self.distance, self.weight):
            blocks = np.where((rows >= 0)[..., None, None, None], values[np.maximum(rows, 0)], 0.0)
            whole = blocks.transpose(0, 3, 1, 4, 2, 5).reshape([count * SIDE for count in counts])
            filled.append(np.ascontiguousarray(whole[: shape[0], : shape[1], : shape[2]], dtype=np.float32))
        return filled[0], filled[1]


def fuse(
    views: Sequence[DepthView], grid: Grid, *, on_progress: Callable[[float], None] = lambda fraction: None
) -> FusedVolume:
    """Fuse depth maps."""
    index = _blocks_near(views, grid)
    corners = np.stack(np.nonzero(index >= 0), axis=-1)[np.argsort(index[index >= 0], kind="stable")] * SIDE
    distance = torch.zeros(len(corners), SIDE**3)
    weight = torch.zeros_like(distance)
    inside = torch.from_numpy(np.stack(np.unravel_index(np.arange(SIDE**3), (SIDE,) * 3), axis=-1).astype(np.float32))
    for count, view in enumerate(views):
        _add(view, grid, corners, inside=inside, distance=distance, weight=weight)
        on_progress((count + 1) / len(views))
    shape = (-1, SIDE, SIDE, SIDE)
    return FusedVolume(grid, index, distance.numpy().reshape(shape), weight.numpy().reshape(shape))


def pixel_weights(view: DepthView, voxel_size: float) -> np.ndarray:
    """Return the weights of depths (H, W): opacity * cosine / (1 + (spread / truncation)^2); 0 for unused depths."""
    cosine = view.cosines()
    with np.errstate(invalid="ignore"):
        narrow = 1.0 / (1.0 + (view.spread / (TRUNCATION * voxel_size)) ** 2)
    used = np.isfinite(view.depth) & (view.opacity >= _OPAQUE) & (cosine >= _FLATTEST)
    return np.where(used, view.opacity * cosine * narrow, 0.0).astype(np.float32)


def _blocks_near(views: Sequence[DepthView], grid: Grid) -> np.ndarray:
    """Number the blocks within the truncation of a surface in memory order; -1 for other blocks."""
    counts = tuple(-(-length // SIDE) for length in grid.shape)
    near = np.zeros(counts, dtype=bool)
    reach = TRUNCATION * grid.voxel_size
    for view in views:
        used = pixel_weights(view, grid.voxel_size) > 0
        rays, depth = plane_rays(view.frame.camera)[used], view.depth[used][:, None]
        lengths = np.linalg.norm(rays, axis=-1, keepdims=True)
        for off in np.linspace(-reach, reach, 5):
            points = apply(view.frame.world_from_cam, rays * (depth + off / lengths))
            blocks = np.floor((points - grid.low) / (SIDE * grid.voxel_size)).astype(np.int64)
            blocks = blocks[((blocks >= 0) & (blocks < counts)).all(-1)]
            near[tuple(blocks.T)] = True
    index = np.full(counts, -1, np.int32)
    index[near] = np.arange(int(near.sum()))
    return index


def _add(view: DepthView, grid: Grid, corners: np.ndarray, *, inside: Tensor, distance: Tensor, weight: Tensor) -> None:
    """Average a view into the blocks, in place."""
    camera, pose = view.frame.camera, view.frame.world_from_cam
    rotation = pose[:3, :3].T
    # From voxel indices to camera coordinates; the offset in float64, as a scene may be far from its origin.
    turn = torch.from_numpy((rotation * grid.voxel_size).astype(np.float32))
    offset = rotation @ (grid.low + 0.5 * grid.voxel_size - pose[:3, 3])
    middles = (rotation * grid.voxel_size) @ (corners + (SIDE - 1) / 2).T + offset[:, None]
    seen = np.flatnonzero(_may_see(camera.params, camera.size, middles, grid.voxel_size))
    maps, width, height = _maps(view, grid.voxel_size), camera.width, camera.height
    fx, fy, cx, cy = camera.params
    starts = (middles - turn.numpy() @ np.full((3, 1), (SIDE - 1) / 2)).T.astype(np.float32)
    steps = inside @ turn.T  # (512, 3)
    truncation = TRUNCATION * grid.voxel_size
    chunk = 2048  # blocks
    for first in range(0, len(seen), chunk):
        rows = torch.from_numpy(seen[first : first + chunk])
        x, y, z = (torch.from_numpy(starts)[rows][:, None, :] + steps).unbind(-1)  # (blocks, 512)
        ahead = z > 1e-6 * truncation
        deep = torch.where(ahead, z, 1.0)
        u, v = fx * x / deep + cx, fy * y / deep + cy
        # Pixel centres are at 0.5: a picture spans [0, width], which is [-1, 1] here.
        places = torch.stack([2 * u / width - 1, 2 * v / height - 1], dim=-1)
        smooth = _sampled(maps[:1], places, "bilinear")[0]
        depth, slant, counts, nearest = _sampled(maps, places, "nearest")
        # Do not interpolate across a depth edge: a mean of two surfaces' depths is worse than either.
        depth = torch.where((smooth - depth).abs() < truncation, smooth, depth)
        off = (depth - z) * slant
        behind = (z - depth) * torch.sqrt(1 + ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2)
        used = ahead & (u >= 0) & (u <= width) & (v >= 0) & (v <= height) & (counts > 0) & (behind < truncation)
        # Beside an outline a pixel may look past the voxel's surface, so its neighbours must see free space there, too.
        used &= (off < truncation) | ((nearest - z) * slant > truncation)
        # The weight decreases with the distance behind a surface, where another side may follow.
        added = torch.where(used, counts * (1 - behind / truncation).clamp(0.0, 1.0), 0.0)
        before, total = weight[rows], weight[rows] + added
        mean = distance[rows] * before + off.clamp(-truncation, truncation) * added
        distance[rows] = torch.where(total > 0, mean / torch.where(total > 0, total, 1.0), 0.0)
        weight[rows] = total


def _maps(view: DepthView, voxel_size: float) -> Tensor:
    """Return maps (4, H, W): depth, factor from axial difference to distance from the tangent plane, weight, and the
    smallest depth of a pixel and its neighbours, 0 if one of them has none."""
    weights = pixel_weights(view, voxel_size)
    lengths = np.linalg.norm(plane_rays(view.frame.camera), axis=-1)
    slant = lengths * view.cosines()
    clear = view.opacity < 0.02
    depth = np.where(clear, 1e9, np.nan_to_num(view.depth))  # beyond every voxel
    nearest = minimum_filter(depth, size=3, mode="nearest")
    maps = np.stack([depth, np.where(clear, 1.0, slant), np.where(clear, 1.0, weights), nearest])
    return torch.from_numpy(maps.astype(np.float32))


def _sampled(maps: Tensor, places: Tensor, mode: str) -> Tensor:
    """Sample maps (C, H, W) at positions in [-1, 1], returning (C, blocks, 512)."""
    found = torch.nn.functional.grid_sample(
        maps[None], places[None], mode=mode, padding_mode="border", align_corners=False
    )
    return found[0]


def _may_see(params: tuple[float, ...], size: tuple[int, int], middles: np.ndarray, voxel_size: float) -> np.ndarray:
    """Mark blocks, with centres (3, N) in camera coordinates, whose bounding spheres may be in the picture."""
    fx, fy, cx, cy = params
    radius = np.sqrt(3.0) * SIDE / 2 * voxel_size
    x, y, z = middles
    inside = z > -radius
    for along, focal, low, high in ((x, fx, -cx, size[0] - cx), (y, fy, -cy, size[1] - cy)):
        for edge, sign in ((low, 1.0), (high, -1.0)):
            inside &= sign * (focal * along - edge * z) / np.hypot(focal, edge) > -radius
    return inside


# A depth counts if the pixel is at least this opaque, and median and mean differ by at most this fraction of it.
_SOLID, _AGREEING = 0.9, 0.02
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
            sure = (view.opacity >= _SOLID) & (view.disagreement <= _AGREEING * view.depth)
            sure &= np.isfinite(view.normals).all(-1)
        places = view.points()[sure]
        cells = np.floor((places - grid.low) / grid.voxel_size).astype(np.int64)
        inside = ((cells >= 0) & (cells < grid.shape)).all(-1)
        normals = view.normals[sure][inside] @ view.frame.world_from_cam[:3, :3].T
        levels = to_8_bit(view.rgb[sure][inside])
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
