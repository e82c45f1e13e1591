"""What is attached to the camera: its mount, a gripper, a bonnet, the frame around a video, a watermark.

It stays in its place in the photos while the camera moves. In a field it would float in front of each camera.

An edge of it has the same direction in all photos of a camera. An edge of the scene may have that too: one at the point
around which the camera moves, or a horizon. But then some distance explains it: a point there hardly moves across the
edge from photo to photo. No distance explains an edge of what is attached.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import PurePosixPath

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import apply, inverse
from nerfcli.photos.images import reduced
from nerfcli.photos.loading import LoadedPhoto

# Size at which photos are compared, and the smoothing of the pictures before their gradients are computed, pixels.
LONGER_SIDE_PX, SMOOTHING_PX = 320, 1.0
# With fewer photos, edges of the scene agree by chance; more than the second number tell nothing new.
FEWEST_PHOTOS, MOST_PHOTOS = 6, 24
# The directions of an edge agree if their mean has this length. Gradients below the second number (levels per pixel)
# count less than their direction: soft shades have one direction over a large area.
LEAST_AGREEMENT, LEAST_GRADIENT = 0.9, 3.0
# A static point at any distance moves by more than this across an edge of what is attached, pixels; so many pixels of
# edges are examined at most, and decide for those around them.
LEAST_MOTION_PX, MOST_PIXELS = 1.5, 4000
# Distances that are tried, in units of the RMS distance of the cameras from their mean; photos whose edges are
# examined, and for each the photos nearest to it that a point is followed to.
DISTANCES, EXAMINED, FOLLOWED = np.geomspace(0.2, 300.0, 48), 6, 6
# Edges and gaps up to this size are one part. A part has at least this fraction of the picture, and begins within the
# last fraction of the longer side from the picture's border: mounts and watermarks are there.
GAP_PX, LEAST_PART, BORDER = 7, 0.002, 0.1
# Pixels whose levels differ between photos as little as those of a part, and by this fraction of what is usual in the
# picture, belong to the part up to the second fraction of the longer side away.
MOST_SPREAD, REACH = 0.2, 0.08
# What a part separates from the rest of the picture belongs to it up to this fraction of the picture.
MOST_ENCLOSED = 0.25
# If more than this fraction of the picture seems attached, it is the scene that does not move. A round picture leaves
# 0.56 of one of 16:9.
MOST_OF_PICTURE = 0.6

Lens = tuple[PurePosixPath, tuple[int, int]]
MotionsAcross = Callable[[np.ndarray, np.ndarray, tuple[int, int]], np.ndarray]


def lens_of(name: str, size: tuple[int, int]) -> Lens:
    """Return what photos of one camera have in common: their folder, and their (width, height)."""
    return PurePosixPath(name).parent, size


def attached_masks(photos: Sequence[LoadedPhoto], *, threads: int) -> Mapping[Lens, np.ndarray]:
    """Return the mask (H, W) of what is attached to each camera, by `lens_of` its photos; none where nothing is.

    Photos with alpha show no surroundings of their object, and are not examined.
    """
    groups: dict[Lens, list[LoadedPhoto]] = {}
    for photo in photos:
        if photo.pixels.shape[-1] == 3:
            groups.setdefault(lens_of(photo.frame.name, photo.frame.camera.size), []).append(photo)
    masks = {}
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for lens, group in groups.items():
            chosen = [group[index] for index in examined(len(group))]
            if chosen:
                pictures = np.stack(list(pool.map(lambda photo: small(photo.pixels), chosen)))
                mask = fixed_mask(pictures, partial(_least_motions, [photo.frame for photo in chosen]))
                if mask is not None:
                    masks[lens] = enlarged(mask, lens[1])
    return masks


def masks_of(
    frames: Sequence[Frame], masks: Mapping[Lens, np.ndarray], *, seen: Sequence[Frame]
) -> dict[str, np.ndarray]:
    """Return the masks of frames by their names, those that have one.

    Args:
        masks: by the lens of the frames that were `seen`. Other frames have the masks of those in their folder, or of
            the only ones of their size.
    """
    lenses = {lens_of(frame.name, frame.camera.size) for frame in seen}
    found = {}
    for frame in frames:
        own = lens_of(frame.name, frame.camera.size)
        alike = [lens for lens in lenses if lens == own or (own not in lenses and lens[1] == own[1])]
        if len(alike) == 1 and alike[0] in masks:
            found[frame.name] = masks[alike[0]]
    return found


def examined(count: int) -> list[int]:
    """Return which of the photos of a camera are examined, evenly chosen; none if they are too few."""
    if count < FEWEST_PHOTOS:
        return []
    return np.linspace(0, count - 1, min(count, MOST_PHOTOS)).round().astype(int).tolist()


def small(pixels: np.ndarray) -> np.ndarray:
    """Return a picture (H, W, 3) uint8 at the size at which photos are compared, (h, w, 3) float32."""
    return reduced(pixels, LONGER_SIDE_PX).astype(np.float32)


def enlarged(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a mask (h, w) of reduced pictures for photos of (width, height)."""
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def fixed_mask(levels: np.ndarray, motions: MotionsAcross | None = None) -> np.ndarray | None:
    """Return the mask (h, w) of what has the same place in all pictures of a camera, near the border; None for nothing.

    Args:
        levels: (n, h, w, 3) of the pictures.
        motions: how far the scene moves across edges, (N,) pixels, from their places (N, 2), normals (N, 2) and the
            (height, width) of the pictures; without it, an edge may be one of the scene that moves only along itself.
    """
    mask = _parts_at_border(_still_edges(levels, motions))
    if not mask.any():
        return None
    mask = _with_enclosed(_with_surroundings(mask, levels))
    mask = cv2.dilate(mask.astype(np.uint8), _square(5)) > 0
    return mask if mask.mean() <= MOST_OF_PICTURE else None


def _still_edges(levels: np.ndarray, motions: MotionsAcross | None) -> np.ndarray:
    """Return the edges (h, w) whose directions agree in all pictures, and which the scene cannot have there."""
    directions = np.mean([_directions(one) for one in levels], axis=0)
    agreement = np.linalg.norm(directions, axis=-1)
    edges = agreement > LEAST_AGREEMENT
    if motions is None or not edges.any():
        return edges
    rows, columns = (places[:: 1 + edges.sum() // MOST_PIXELS] for places in np.nonzero(edges))
    normals = directions[rows, columns] / agreement[rows, columns, None]
    moves = np.full(edges.shape, np.nan)
    moves[rows, columns] = motions(np.stack([columns, rows], axis=-1) + 0.5, normals, edges.shape)
    nearest = distance_transform_edt(np.isnan(moves), return_distances=False, return_indices=True)
    return edges & (moves[tuple(np.asarray(nearest))] > LEAST_MOTION_PX)


def _with_surroundings(parts: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Return parts (h, w) with the pixels around them that are as constant as they are, without gaps."""
    spread = np.median(np.abs(levels - np.median(levels, axis=0)), axis=0).max(-1)
    away = cv2.distanceTransform((~parts).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    constant = spread <= min(np.median(spread[parts]), MOST_SPREAD * np.median(spread))
    near = parts | (constant & (away <= REACH * max(parts.shape)))
    _, labels = cv2.connectedComponents(near.astype(np.uint8), connectivity=4)
    joined = np.isin(labels, np.unique(labels[parts]))
    return cv2.morphologyEx(joined.astype(np.uint8), cv2.MORPH_CLOSE, _square(GAP_PX)) > 0


def _directions(levels: np.ndarray) -> np.ndarray:
    """Return the directions of a picture's edges, (h, w, 2): of length 1, shorter where there is hardly any edge."""
    grey = cv2.GaussianBlur(levels.mean(-1), (0, 0), SMOOTHING_PX)
    gradient = np.stack([cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)], axis=-1) / 8.0
    return gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), LEAST_GRADIENT)


def _least_motions(
    frames: Sequence[Frame], pixels: np.ndarray, normals: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Return how far static points at pixels (N, 2) move across their edges, (N,): at the distance where this is least.

    Of the photos that a point is followed to, the median counts; it has moved far if it is out of their view. Of the
    photos that are examined, the median counts, too.
    """
    cameras = [frame.camera.resized(shape[1], shape[0]) for frame in frames]
    poses = [frame.world_from_cam for frame in frames]
    centres = np.array([frame.centre for frame in frames])
    radius = float(np.sqrt(np.square(centres - centres.mean(0)).sum(1).mean()))
    least = []
    for index in np.unique(np.linspace(0, len(frames) - 1, EXAMINED).round().astype(int)).tolist():
        rays, _ = cameras[index].bearings(pixels)
        near = np.argsort(np.linalg.norm(centres - centres[index], axis=1), kind="stable")
        others = near[near != index][:FOLLOWED].tolist()
        moves = np.full((len(DISTANCES), len(others), len(pixels)), float(max(shape)))
        for row, distance in zip(moves, DISTANCES * (radius or 1.0), strict=True):
            points = apply(poses[index], rays * distance)
            for move, other in zip(row, others, strict=True):
                seen, valid = cameras[other].project(apply(inverse(poses[other]), points))
                shown = valid & cameras[other].contains(seen)
                move[shown] = ((seen - pixels) * normals).sum(-1)[shown]
        # Between two distances from which a point moves to opposite sides, it stays.
        stays = (moves[1:] * moves[:-1] < 0.0) & (np.abs(moves[1:] - moves[:-1]) < max(shape))
        between = np.where(stays, 0.0, np.minimum(np.abs(moves[1:]), np.abs(moves[:-1])))
        least.append(np.median(between, axis=1).min(axis=0))
    return np.median(least, axis=0)


def _parts_at_border(edges: np.ndarray) -> np.ndarray:
    """Return the parts of edges (h, w) that are large enough and begin near the border, without their gaps."""
    joined = cv2.morphologyEx(np.pad(edges, GAP_PX).astype(np.uint8), cv2.MORPH_CLOSE, _square(GAP_PX))
    _, labels, facts, _ = cv2.connectedComponentsWithStats(joined[GAP_PX:-GAP_PX, GAP_PX:-GAP_PX])
    left, top, width, height, area = facts.T
    beside = np.minimum(np.minimum(left, top), np.minimum(edges.shape[1] - left - width, edges.shape[0] - top - height))
    kept = (area >= LEAST_PART * edges.size) & (beside <= BORDER * max(edges.shape))
    kept[0] = False
    return kept[labels]


def _with_enclosed(mask: np.ndarray) -> np.ndarray:
    """Return a mask (h, w) with what it separates from the largest part of the picture."""
    count, labels, facts, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    if count <= 1:
        return mask
    areas = facts[1:, cv2.CC_STAT_AREA]
    enclosed = (areas <= MOST_ENCLOSED * mask.size) & (np.arange(len(areas)) != areas.argmax())
    return mask | np.concatenate([[False], enclosed])[labels]


def _square(side_px: int) -> np.ndarray:
    return np.ones((side_px, side_px), np.uint8)
