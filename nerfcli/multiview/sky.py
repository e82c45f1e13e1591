"""Pixels of training photos that may show the sky: without texture, above the horizon, alike in all photos that look
the same way wherever these were taken.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from nerfcli.photos.loading import LoadedPhoto

# Size at which photos are compared, and how many others each is compared with.
LONGER_SIDE_PX, OTHERS = 160, 6
# Grey levels of a sky spread by less than this within so many pixels.
MOST_SPREAD, WINDOW_PX = 6.0, 7
# Levels by which photos may differ, their exposures aside; from here on a level is white.
MOST_DIFFERENCE, WHITE = 32.0, 245.0
# Photos that look elsewhere show another part of the sky.
SAME_WAY_COS = np.cos(np.radians(60.0))
# A smaller part of a photo is no sky, nor are fewer pixels that two photos share.
LEAST_PART, FEWEST_SHARED = 0.005, 50
# A region is the sky where this part of it agrees with other photos.
MOST_OF = 0.25


def sky_masks(photos: Sequence[LoadedPhoto], *, threads: int) -> list[np.ndarray]:
    """Return for each photo (H, W) bool which pixels may show the sky.

    A wall of one colour looks the same from everywhere, too: whether these pixels are the sky is left to a trial.
    """
    with ThreadPoolExecutor(max(1, threads)) as pool:
        small = list(pool.map(_Small, photos))
        views = np.array([photo.frame.world_from_cam[:3, 2] for photo in photos])
        up = -np.mean([photo.frame.world_from_cam[:3, 1] for photo in photos], axis=0)

        def mask_of(index: int) -> np.ndarray:
            same_way = np.flatnonzero(views @ views[index] > SAME_WAY_COS)
            same_way = same_way[same_way != index]
            chosen = np.unique(np.linspace(0, len(same_way) - 1, OTHERS).round().astype(int)) if len(same_way) else []
            mask = _agreed(small[index], [small[other] for other in same_way[chosen]], up)
            height, width = photos[index].pixels.shape[:2]
            return cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)

        return list(pool.map(mask_of, range(len(photos))))


class _Small:
    """A reduced photo: its mean levels around each pixel, and where these hardly spread."""

    def __init__(self, photo: LoadedPhoto):
        camera = photo.frame.camera
        scale = min(1.0, LONGER_SIDE_PX / max(camera.width, camera.height))
        self.camera = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        size = (self.camera.width, self.camera.height)
        colours = np.ascontiguousarray(photo.pixels[..., :3])
        levels = cv2.resize(colours, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        window = (WINDOW_PX, WINDOW_PX)
        self.levels = cv2.blur(levels, window)
        spread = cv2.blur(levels * levels, window) - self.levels * self.levels
        self.plain = np.asarray((spread < MOST_SPREAD**2).all(-1))
        if photo.used is not None:
            self.plain &= cv2.resize(photo.used.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        self.turn = photo.frame.world_from_cam[:3, :3]


def _agreed(own: _Small, others: Sequence[_Small], up: np.ndarray) -> np.ndarray:
    """Return (h, w) whether more photos agree with a pixel along its direction than contradict."""
    rays, valid = own.camera.pixel_bearings()
    rays = rays @ own.turn.T
    is_above = np.einsum("pi,i->p", rays, up) > 0
    candidate = np.flatnonzero(own.plain.ravel() & valid & is_above)
    votes, seen_by = np.zeros((2, len(candidate)), dtype=np.int64)
    mine = own.levels.reshape(-1, 3)[candidate]
    for other in others:
        pixels, valid_there = other.camera.project(rays[candidate] @ other.turn)
        inside = (pixels >= 0).all(1) & (pixels < (other.camera.width, other.camera.height)).all(1)
        in_front = np.einsum("pi,i->p", rays[candidate], other.turn[:, 2]) > 0
        seen = valid_there & inside & in_front
        column, row = np.where(seen, pixels.T, 0).astype(np.int64)
        theirs, plain = other.levels[row, column], other.plain[row, column] & seen
        for_gain = plain & (mine < WHITE).all(1) & (theirs < WHITE).all(1)
        gain = np.ones(3)
        if for_gain.sum() >= FEWEST_SHARED:
            gain = np.median(theirs[for_gain] / np.maximum(mine[for_gain], 1.0), axis=0)
        expected = np.minimum(mine * gain, 255.0)
        off = np.abs(np.where(theirs < WHITE, expected - theirs, np.minimum(expected - WHITE, 0.0))).max(1)
        votes += np.where(plain & (off < MOST_DIFFERENCE), 1, np.where(seen, -1, 0))
        seen_by += seen
    return _regions(own.plain.shape, candidate, agreed=votes > 0, seen=seen_by > 0)


def _regions(shape: tuple[int, ...], candidate: np.ndarray, *, agreed: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return (h, w) the connected regions of candidates of which most that other photos see too agree with them."""
    mask = np.zeros(math.prod(shape), dtype=np.uint8)
    mask[candidate] = 1
    count, labels = cv2.connectedComponents(mask.reshape(shape), connectivity=4)
    labels = labels.astype(np.int64)
    of_candidate = labels.ravel()[candidate]
    sizes, agreeing, visible = (np.bincount(of_candidate, which, count) for which in (None, agreed, seen))
    kept = (agreeing > MOST_OF * visible) & (agreeing >= FEWEST_SHARED) & (sizes >= LEAST_PART * mask.size)
    kept[0] = False
    return kept[labels]
