"""The first Gaussians: flat disks on the surfaces that a field shows from and near its photos.

Detail decides where they are: a picture is cut into squares of 1 to 16 pixels, as large as photo and depth allow, and
each square asks for one disk. Of the squares that photos put at the same place, the smallest is kept.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from nerfcli.cameras.frame import chosen_evenly
from nerfcli.field.background import Colour, SphereBackground, colours_behind
from nerfcli.field.exposure import exposed, linear_from_srgb
from nerfcli.photos.loading import LoadedPhoto, downscaled_camera
from nerfcli.render.coverage import DepthMap, normals_of_points, small_frame
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.splats.gaussians import Gaussians

# All maps together have about this many pixels for each Gaussian, and at most this many; more gain nothing.
PIXELS_EACH, MOST_PIXELS = 40, 3_000_000
# Their sides are those of the photos divided by 2 to 8: where this leaves too many pixels, fewer photos get a map.
LEAST_REDUCTION, LARGEST_REDUCTION = 2.0, 8.0
# A map needs no colours, so the march may skip them all: the median depth stays exact to its rounding.
DEPTH_ONLY = 1.0
# Standard deviation of a disk as a fraction of the spacing, and its thickness as a fraction of that.
SPREAD, FLATNESS = 0.4, 0.2
OPACITY = 0.8
# Sides of squares are 1, 2, ... 2 ** (LEVELS - 1) pixels of a map.
LEVELS = 5
# Less detail than this (deviation of sRGB times side of the square in pixels) is noise and asks for no disk of its own.
LEAST_DETAIL = 0.02
# Radius, in the training frame, of the sphere that shows what has no depth or lies beyond it.
FAR = 30.0
# A learned background is shown where no photo sees it by disks of this spacing, in radians: a cell of its grid.
BACKGROUND_SPACING, BACKGROUND_SPREAD, BACKGROUND_OPACITY = 0.065, 0.8, 0.95
# Levels outside of these are too dark or too bright to tell the gain of a photo, and fewer pixels do not tell it.
TELLING_LEVELS, TELLING_PIXELS = (0.1, 0.97), 50
# Longer side of the pictures that tell the gains.
GAIN_SIZE = 96
# The constant harmonic: a colour c is stored as (c - 1/2) / this.
CONSTANT = 0.28209479177387814


@dataclass(frozen=True)
class Start:
    """The first Gaussians, and what refining them on the photos needs to know.

    Args:
        gaussians: in the scene's frame.
        log_gains: (photos, 3) logarithms of the gains of the photos relative to the field, in linear light.
        background: sRGB to composite the Gaussians on.
    """

    gaussians: Gaussians
    log_gains: np.ndarray
    background: Colour


@dataclass(frozen=True)
class _Squares:
    """Squares of the maps, each of which may become a disk; in the training frame, float32.

    Args:
        places, normals, colours: (N, 3).
        sizes: (N,) side of the square, if it faces the camera.
        enters, leaves: (N,) tolerances t at which it is as large as detail allows: enters <= t < leaves.
    """

    places: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    sizes: np.ndarray
    enters: np.ndarray
    leaves: np.ndarray

    def taken(self, rows: np.ndarray) -> "_Squares":
        return _Squares(*(getattr(self, field.name)[rows] for field in fields(self)))


def count_for(photos: Sequence[LoadedPhoto], *, core_seconds: float) -> int:
    """Return how many Gaussians can be refined on these photos: at most one per 20 pixels of theirs."""
    pixels = sum(photo.pixels.shape[0] * photo.pixels.shape[1] for photo in photos)
    return int(np.clip(600 * core_seconds, 10_000, max(10_000, pixels / 20)))


def gaussians_of_field(
    model: Model,
    photos: Sequence[LoadedPhoto],
    pictures: Sequence[LoadedPhoto] = (),
    *,
    count: int,
    degree: int,
    with_gains: bool,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> Start:
    """Return at most `count` Gaussians that look like the field from near its training photos, before any refinement.

    Args:
        pictures: of the field, from cameras that also see what no photo shows.
        degree: of the harmonics, 0 to 3; those above the constant are 0.
        with_gains: whether the field was trained with exposures of photos; if not, their gains are 1.
    """
    views = [*photos, *pictures]
    maps = field_maps(model, views, count=count, on_progress=on_progress)
    log_gains = log_gains_of_photos(model, photos) if with_gains else np.zeros((len(photos), 3))
    gains = np.concatenate([log_gains, np.zeros((len(pictures), 3))])
    behind, scene_from_training = model.background, model.training_from_scene.inverse()
    alpha = any(photo.pixels.shape[-1] == 4 for photo in photos)
    surrounded = not alpha and (model.contraction != "none" or isinstance(behind, SphereBackground))
    squares = _joined(
        [_squares_of_map(model, views[i], seen, gains[i], surrounded=surrounded) for i, seen in maps.items()]
    )
    if not isinstance(behind, SphereBackground):
        disks = _disks(_chosen(squares, count), degree, SPREAD, OPACITY)
        return Start(disks.moved(scene_from_training), log_gains, behind)
    unseen = _unseen_background(model, behind, list(maps.values()), most=count // 4)
    disks = _disks(_chosen(squares, count - len(unseen.sizes)), degree, SPREAD, OPACITY)
    shell = _disks(unseen, degree, BACKGROUND_SPREAD, BACKGROUND_OPACITY)
    disks = Gaussians(*(np.concatenate(pair) for pair in zip(disks, shell, strict=True)))
    return Start(disks.moved(scene_from_training), log_gains, (0.0, 0.0, 0.0))


def field_maps(
    model: Model,
    photos: Sequence[LoadedPhoto],
    *,
    count: int,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> dict[int, DepthMap]:
    """Return maps for `count` Gaussians by the index of their photo: of all photos, or of evenly spread ones."""
    allowed = min(PIXELS_EACH * count, MOST_PIXELS)
    wanted = max(LEAST_REDUCTION, (sum(photo.pixels[..., 0].size for photo in photos) / allowed) ** 0.5)
    reduction = min(wanted, LARGEST_REDUCTION)
    number = max(1, round(len(photos) * (reduction / wanted) ** 2))
    chosen = chosen_evenly(range(len(photos)), number)
    maps = {}
    for index in chosen:
        frame = photos[index].frame
        small = replace(frame, camera=downscaled_camera(frame.camera, reduction))
        depth = DepthRequest("median", "ray")
        seen = render_picture(model, small, background=model.background, depth=depth, tolerance=DEPTH_ONLY)
        assert seen.depth is not None
        maps[index] = DepthMap(small, seen.depth)
        on_progress(len(maps) / len(chosen))
    return maps


def log_gains_of_photos(model: Model, photos: Sequence[LoadedPhoto]) -> np.ndarray:
    """Estimate the logarithms (P, 3) of the photos' gains: the median ratio of photo and field, in linear light.

    Only levels count that are neither dark nor saturated in both; 0 where there are too few of them.
    """
    log_gains = np.zeros((len(photos), 3))
    low, high = TELLING_LEVELS
    for index, photo in enumerate(photos):
        small = small_frame(photo.frame, GAIN_SIZE)
        seen = render_picture(model, small, background=model.background)
        moments = _moments(photo, seen.rgb.shape[:2])
        measured, used = _colours(moments), _is_used(moments) & seen.valid & (seen.opacity > 0.5)
        telling = (np.minimum(measured, seen.rgb) > low) & (np.maximum(measured, seen.rgb) < high) & used[..., None]
        light, predicted = (linear_from_srgb(torch.from_numpy(np.maximum(x, low))) for x in (measured, seen.rgb))
        ratios = (light / predicted).numpy()
        for channel in range(3):
            here = ratios[..., channel][telling[..., channel]]
            log_gains[index, channel] = np.log(np.median(here)) if len(here) >= TELLING_PIXELS else 0.0
    return log_gains


def _joined(parts: Sequence[_Squares]) -> _Squares:
    return _Squares(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(_Squares)))


def _moments(photo: LoadedPhoto, shape: tuple[int, int]) -> np.ndarray:
    """Return means (H, W, 9) over the pixels of a smaller picture: of used, of used times red, green, blue and alpha,
    and of used times their squares. Colours are sRGB levels times alpha; used is 0 or 1.
    """
    levels = photo.pixels.astype(np.float32) / 255.0
    alpha = levels[..., 3:] if levels.shape[-1] == 4 else np.ones_like(levels[..., :1])
    used = np.ones_like(alpha) if photo.used is None else photo.used[..., None].astype(np.float32)
    levels = used * np.concatenate([alpha * levels[..., :3], alpha], axis=-1)
    sums = np.concatenate([used, levels, levels**2], axis=-1)
    for axis, side in enumerate(shape):
        # A pixel of the photo belongs to the pixel that holds its centre.
        owner = ((np.arange(sums.shape[axis]) + 0.5) * side / sums.shape[axis]).astype(int)
        first = np.searchsorted(owner, np.arange(side + 1))
        counts = np.diff(first).reshape((-1, 1, 1) if axis == 0 else (-1, 1))
        sums = np.add.reduceat(sums, first[:-1], axis=axis) / counts.astype(np.float32)
    return sums


def _is_used(moments: np.ndarray) -> np.ndarray:
    """Return which pixels are nowhere masked and not mostly transparent."""
    return (moments[..., 0] > 0.999) & (moments[..., 4] >= 0.5)


def _colours(moments: np.ndarray) -> np.ndarray:
    return moments[..., 1:4] / np.maximum(moments[..., 4:5], np.float32(1e-6))


def _squares_of_map(
    model: Model, photo: LoadedPhoto, seen: DepthMap, log_gains: np.ndarray, *, surrounded: bool
) -> _Squares:
    """Return the squares of a map that some tolerance above `LEAST_DETAIL` chooses."""
    camera, (height, width) = seen.frame.camera, seen.distances.shape
    pose = model.training_from_scene.apply_pose(seen.frame.world_from_cam)
    bearings, valid = (values.reshape(height, width, -1) for values in camera.pixel_bearings())
    distances = seen.distances * model.training_from_scene.scale
    normals = normals_of_points(bearings * distances[..., None], distances)
    normals = np.where(np.isfinite(normals), normals, -bearings) @ pose[:3, :3].T
    moments = _moments(photo, seen.distances.shape)
    used = _is_used(moments) & valid[..., 0] & (surrounded | np.isfinite(distances))
    directions, centre = bearings @ pose[:3, :3].T, pose[:3, 3]
    along = directions @ centre
    to_sphere = np.sqrt(np.maximum(along**2 - centre @ centre + FAR**2, 0.0)) - along
    distances = np.fmin(distances, np.maximum(to_sphere, FAR / 2))  # from a camera outside of it, all is far enough
    places = directions * distances[..., None] + centre
    parts = []
    for level, (enters, leaves, levels) in enumerate(_tolerances(moments, used)):
        middle = _middles(used.shape, 2**level)
        possible = (enters < leaves) & (leaves > LEAST_DETAIL) & used[middle]
        colours = exposed(torch.from_numpy(levels[possible]), -torch.from_numpy(log_gains)).clamp(0.0, 1.0).numpy()
        sizes = distances[middle][possible] * (2**level / camera.focal_px)
        values = (places[middle][possible], normals[middle][possible], colours, sizes, enters[possible])
        parts.append(_Squares(*(value.astype(np.float32) for value in (*values, leaves[possible]))))
    return _joined(parts)


def _tolerances(moments: np.ndarray, used: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return for squares of every size from which tolerance and up to which they are the largest, and their colours.

    A square's detail is the deviation of its levels and alpha times its side, which is never less than that of its
    quarters. A square whose middle is not used is cut. Edges of depth do not count: held-out photos gain nothing.
    """
    height, width = used.shape
    pads = tuple((0, -side % 2 ** (LEVELS - 1)) for side in (height, width))
    moments, padded = np.pad(moments, (*pads, (0, 0)), mode="edge"), np.pad(used, pads, mode="edge")
    details, colours, some = [np.zeros(padded.shape, dtype=np.float32)], [_colours(moments)], padded
    for level in range(1, LEVELS):
        moments, some = _pooled(moments, np.mean), _pooled(some, np.any)
        means = moments / np.maximum(moments[..., :1], np.float32(1e-6))
        deviation = np.sqrt(np.maximum(means[..., 5:] - means[..., 1:5] ** 2, 0.0).max(-1))
        cut = some & ~padded[_middles(padded.shape, 2**level)]
        details.append(np.where(cut, np.inf, 2**level * deviation))
        colours.append(_colours(moments))
    # A square is part of the smallest around it that is not cut; four of the largest are never one.
    wholes = [np.full_like(details[-1], np.inf)]
    for detail in details[:0:-1]:
        wholes.append(np.minimum(detail, wholes[-1]).repeat(2, 0).repeat(2, 1))
    parts = [np.s_[: -(-height // 2**level), : -(-width // 2**level)] for level in range(LEVELS)]
    return [(details[n][part], wholes[~n][part], colours[n][part]) for n, part in enumerate(parts)]


def _middles(shape: tuple[int, ...], side: int) -> tuple[np.ndarray, ...]:
    """Return the index of the pixels in the middle of all squares of a side, or at the border of a picture."""
    return np.ix_(*(np.minimum(np.arange(-(-size // side)) * side + side // 2, size - 1) for size in shape))


def _pooled(values: np.ndarray, how: Callable[..., np.ndarray]) -> np.ndarray:
    """Return one value for each 2 x 2 values."""
    height, width, *rest = values.shape
    return how(values.reshape(height // 2, 2, width // 2, 2, *rest), axis=(1, 3))


def _chosen(squares: _Squares, count: int) -> _Squares:
    """Return at most `count` squares: those of the smallest tolerance that leaves no more, one at each place."""
    low, high = LEAST_DETAIL, 16.0
    kept = _kept(squares, low)
    if len(kept) > count:
        kept = _kept(squares, high)
        for _ in range(10):
            middle = (low * high) ** 0.5
            if len(found := _kept(squares, middle)) > count:
                low = middle
            else:
                kept, high = found, middle
    if len(kept) > count:
        kept = np.sort(np.random.default_rng(0).choice(kept, count, replace=False))
    return squares.taken(kept)


def _kept(squares: _Squares, tolerance: float) -> np.ndarray:
    """Return the squares of a tolerance without those at the place of a smaller one of about the same size."""
    rows = np.flatnonzero((squares.enters <= tolerance) & (tolerance < squares.leaves))
    rows = rows[np.argsort(squares.sizes[rows], kind="stable")]
    # Places are the cells of grids, one for each range of sizes by the square root of 2.
    octaves = np.round(2.0 * np.log2(squares.sizes[rows])).astype(np.int64)
    cells = np.floor(squares.places[rows] / np.exp2(octaves / 2.0)[:, None]).astype(np.int64) & 0xFFFFF
    keys = (((octaves & 0xF) << 60) ^ (cells[:, 0] << 40)) ^ ((cells[:, 1] << 20) ^ cells[:, 2])
    return np.sort(rows[np.unique(keys, return_index=True)[1]])


def _unseen_background(model: Model, background: SphereBackground, maps: Sequence[DepthMap], *, most: int) -> _Squares:
    """Return squares on a sphere beyond all others for directions in which no map looks past the surfaces."""
    number = np.arange(min(most, round(4.0 * np.pi / BACKGROUND_SPACING**2))) + 0.5
    spacing = (4.0 * np.pi / max(1, len(number))) ** 0.5
    # A Fibonacci lattice, whose points have about equal distances.
    z, angle = 1.0 - 2.0 * number / max(1, len(number)), np.pi * (1.0 + 5.0**0.5) * number
    ring = np.sqrt(1.0 - z**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)
    unseen = np.ones(len(directions), dtype=bool)
    for seen in maps:
        turn = model.training_from_scene.apply_pose(seen.frame.world_from_cam)[:3, :3]
        pixels, valid = seen.frame.camera.project(directions @ turn)
        height, width = seen.distances.shape
        inside = np.flatnonzero(valid & (pixels >= 0).all(1) & (pixels < (width, height)).all(1))
        column, row = pixels[inside].astype(int).T
        unseen[inside] &= np.isfinite(seen.distances[row, column])
    directions = directions[unseen].astype(np.float32)
    with torch.no_grad():
        colours = colours_behind(background, torch.from_numpy(directions)).numpy()
    radius = 1.5 * FAR
    zeros = np.zeros(len(directions), dtype=np.float32)
    return _Squares(radius * directions, -directions, colours, zeros + radius * spacing, zeros, zeros)


def _disks(squares: _Squares, degree: int, spread: float, opacity: float) -> Gaussians:
    """Return a flat Gaussian for each square, in the training frame."""
    count, normals = len(squares.sizes), squares.normals.astype(np.float64)
    across = np.log(spread * squares.sizes.astype(np.float64))
    harmonics = np.zeros((count, (degree + 1) ** 2, 3))
    harmonics[:, 0] = (squares.colours - 0.5) / CONSTANT
    # The shortest turn from the z axis to the normal; half a turn about x where that is not unique.
    turns = np.stack([1.0 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)], axis=-1)
    turns[normals[:, 2] < -0.9999] = (0.0, 1.0, 0.0, 0.0)
    return Gaussians(
        squares.places,
        np.stack([across, across, across + np.log(FLATNESS)], axis=-1),
        turns / np.linalg.norm(turns, axis=1, keepdims=True),
        np.full(count, np.log(opacity / (1.0 - opacity))),
        harmonics,
    )
