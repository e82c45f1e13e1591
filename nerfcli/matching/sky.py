"""Pixels of training photos that may show the sky.

They have no texture, are above the horizon with nothing else above them, and look alike in all photos that look the
same way, wherever taken.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.matching.exposures import FEWEST_PIXELS
from nerfcli.matching.stereo import DenseDepth
from nerfcli.matching.tracks import MOST_POINTS, Tracks, triangulate
from nerfcli.photos.images import reduced
from nerfcli.photos.loading import LoadedPhoto

# Size at which photos are compared, and number of other photos that each is compared with.
LONGER_SIDE_PX, OTHERS = 160, 6
# Standard deviation of levels below which a pixel has no texture, and the window in which it is measured.
MOST_SPREAD, WINDOW_PX = 6.0, 7
# Largest difference of levels between photos, apart from their exposures; levels from the second number on are white.
MOST_DIFFERENCE, WHITE = 32.0, 245.0
# Photos that look elsewhere show another part of the sky.
SAME_WAY_COS = np.cos(np.radians(60.0))
# Smallest sky region, as a fraction of the photo.
LEAST_PART = 0.005
# A region may be sky if more than this fraction of its pixels that other photos see agrees with them.
MOST_OF = 0.25
# Fewest photos that see a point: among matches of two photos are wrong ones.
FEWEST_SIGHTINGS = 3
# A sky has fewer points before it than this fraction of what it would have as a surface, and fewer than the second
# number. With fewer points than the third number to expect, a wall might have none either.
MOST_BEFORE, FEWEST_BEFORE, FEWEST_EXPECTED = 0.008, 3, 400.0
# Depths by stereo with larger expected errors do not count: at the border of a sky they may be those of the ground.
MOST_ERROR = 0.02
# Poses are not exact: points within this fraction of the longer side of the region's border do not count.
BORDER = 0.02


def sky_masks(photos: Sequence[LoadedPhoto], *, threads: int) -> list[np.ndarray]:
    """Return for each photo the mask (H, W) of the pixels that may show the sky.

    A wall of one colour also looks the same from everywhere, see `points_before`.
    """
    with ThreadPoolExecutor(max(1, threads)) as pool:
        small = list(pool.map(_Small, photos))
        views = np.array([photo.frame.world_from_cam[:3, 2] for photo in photos])
        up = -np.mean([photo.frame.world_from_cam[:3, 1] for photo in photos], axis=0)

        def mask_of(index: int) -> np.ndarray:
            same_way = np.flatnonzero(views @ views[index] > SAME_WAY_COS)
            same_way = same_way[same_way != index]
            chosen = np.unique(np.linspace(0, len(same_way) - 1, OTHERS).round().astype(int)) if len(same_way) else []
            agreed = _agreed(small[index], [small[other] for other in same_way[chosen]], up)
            mask = _up_to_its_border(small[index], agreed).astype(np.uint8)
            return cv2.resize(mask, photos[index].frame.camera.size, interpolation=cv2.INTER_NEAREST) > 0

        return list(pool.map(mask_of, range(len(photos))))


@dataclass(frozen=True)
class PointsBefore:
    """Points in front of the pixels of sky masks: how many were found in all photos, and how many are expected.

    These pixels are expected to be as rich in points as the others.
    """

    found: int
    expected: float

    @property
    def refute(self) -> bool:
        """Whether there are too many for a sky."""
        return self.found >= max(FEWEST_BEFORE, MOST_BEFORE * self.expected)

    @property
    def confirm(self) -> bool:
        """Whether there are so few that it is a sky; not if even a surface might have none."""
        return not self.refute and self.expected >= FEWEST_EXPECTED


def points_of_tracks(photos: Sequence[LoadedPhoto], tracks: Tracks) -> np.ndarray:
    """Return the points (N, 3) of tracks that at least `FEWEST_SIGHTINGS` photos see."""
    surface = triangulate([photo.frame for photo in photos], tracks)
    sightings = np.bincount(tracks.points[np.isfinite(surface.misses_px)], minlength=tracks.count)
    return surface.points[sightings >= FEWEST_SIGHTINGS]


def points_of_depths(photos: Sequence[LoadedPhoto], dense: Sequence[DenseDepth]) -> np.ndarray:
    """Return points (N, 3) of pixels whose depths are known within `MOST_ERROR`, in equal steps over all of them."""
    exact = [np.flatnonzero(depth.errors < MOST_ERROR) for depth in dense]
    step = math.ceil(sum(map(len, exact)) / MOST_POINTS) or 1
    chosen = zip(photos, dense, exact, strict=True)
    points = [depth.points(photo.frame, numbers[::step]) for photo, depth, numbers in chosen]
    return np.concatenate(points)[:MOST_POINTS]


def points_before(masks: Sequence[np.ndarray], photos: Sequence[LoadedPhoto], points: np.ndarray) -> PointsBefore:
    """Count the points (N, 3) of surfaces that are in the sky of a photo, by the masks (H, W) of `sky_masks`.

    A point hides the sky behind it. So a point that some photos see is outside the sky of all others, at any distance.
    A photo of a plain wall, however, has points of its neighbours behind the wall, and a few on it.
    """
    points = points[:: math.ceil(len(points) / MOST_POINTS) or 1]
    found, expected = 0, 0.0
    for photo, mask in zip(photos, masks, strict=True):
        side = 2 * round(BORDER * max(mask.shape)) + 1
        inner = cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8), borderType=cv2.BORDER_REPLICATE) > 0
        in_camera = (points - photo.frame.centre) @ photo.frame.world_from_cam[:3, :3]
        pixels, valid = photo.frame.camera.project(in_camera[in_camera[:, 2] > 0])
        column, row = pixels[valid & photo.frame.camera.contains(pixels)].astype(np.int64).T
        found += int(inner[row, column].sum())
        elsewhere = int((~mask)[row, column].sum())
        expected += elsewhere * float(inner.mean()) / max(1.0 - float(mask.mean()), 1e-6)
    return PointsBefore(found, expected)


class _Small:
    """A reduced photo: its levels, their means around each pixel, and the masks of usable pixels and of plain ones."""

    def __init__(self, photo: LoadedPhoto):
        levels = reduced(np.ascontiguousarray(photo.pixels[..., :3]), LONGER_SIDE_PX).astype(np.float32)
        size, window = (levels.shape[1], levels.shape[0]), (WINDOW_PX, WINDOW_PX)
        self.camera = photo.frame.camera.resized(*size)
        self.sharp, self.levels = levels, cv2.blur(levels, window)
        spread = cv2.blur(levels * levels, window) - self.levels * self.levels
        self.used = np.ones(levels.shape[:2], dtype=bool)
        if photo.used is not None:
            self.used = cv2.resize(photo.used.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        self.plain = np.asarray((spread < MOST_SPREAD**2).all(-1)) & self.used
        self.turn = photo.frame.world_from_cam[:3, :3]


def _agreed(own: _Small, others: Sequence[_Small], up: np.ndarray) -> np.ndarray:
    """Return the mask (h, w) of regions that agree with other photos.

    A pixel agrees if more photos agree with it in its direction than contradict it.
    """
    rays, valid = own.camera.pixel_bearings()
    rays = rays @ own.turn.T
    is_above = np.einsum("pi,i->p", rays, up) > 0
    candidate = np.flatnonzero(own.plain.ravel() & valid & is_above)
    votes, seen_by = np.zeros((2, len(candidate)), dtype=np.int64)
    mine = own.levels.reshape(-1, 3)[candidate]
    for other in others:
        pixels, valid_there = other.camera.project(rays[candidate] @ other.turn)
        inside = other.camera.contains(pixels)
        in_front = np.einsum("pi,i->p", rays[candidate], other.turn[:, 2]) > 0
        seen = valid_there & inside & in_front
        column, row = np.where(seen, pixels.T, 0).astype(np.int64)
        theirs, plain = other.levels[row, column], other.plain[row, column] & seen
        for_gain = plain & (mine < WHITE).all(1) & (theirs < WHITE).all(1)
        gain = np.ones(3)
        if for_gain.sum() >= FEWEST_PIXELS:
            gain = np.median(theirs[for_gain] / np.maximum(mine[for_gain], 1.0), axis=0)
        expected = np.minimum(mine * gain, 255.0)
        off = np.abs(np.where(theirs < WHITE, expected - theirs, np.minimum(expected - WHITE, 0.0))).max(1)
        votes += np.where(plain & (off < MOST_DIFFERENCE), 1, np.where(seen, -1, 0))
        seen_by += seen
    uppermost = _uppermost(valid.reshape(own.plain.shape), up @ own.turn)
    return _regions(own.plain.shape, candidate, agreed=votes > 0, seen=seen_by > 0, uppermost=uppermost)


def _regions(
    shape: tuple[int, ...], candidate: np.ndarray, *, agreed: np.ndarray, seen: np.ndarray, uppermost: np.ndarray
) -> np.ndarray:
    """Return the mask (h, w) of connected regions of candidates of which enough pixels agree with other photos, and
    that extend to the uppermost pixels.
    """
    mask = np.zeros(math.prod(shape), dtype=np.uint8)
    mask[candidate] = 1
    count, labels = cv2.connectedComponents(mask.reshape(shape), connectivity=4)
    labels = labels.astype(np.int64)
    of_candidate = labels.ravel()[candidate]
    sizes, agreeing, visible = (np.bincount(of_candidate, which, count) for which in (None, agreed, seen))
    kept = (agreeing > MOST_OF * visible) & (agreeing >= FEWEST_PIXELS) & (sizes >= LEAST_PART * mask.size)
    kept[0] = False
    # Wires and poles, up to 2 pixels wide and with texture in a window around them, divide a sky, but do not bound it.
    window = np.ones((WINDOW_PX + 2, WINDOW_PX + 2), np.uint8)
    linked = cv2.connectedComponents(cv2.dilate(mask.reshape(shape), window))[1]
    return kept[labels] & np.isin(linked, linked[uppermost & (labels > 0)])


def _up_to_its_border(own: _Small, mask: np.ndarray) -> np.ndarray:
    """Return the mask (h, w) extended to the pixels beside it that have its colour, half a window at most.

    The window of a pixel near the skyline has texture although the pixel itself shows the sky.
    """
    window = (WINDOW_PX, WINDOW_PX)
    part = cv2.blur(mask.astype(np.float32), window)
    of_sky = cv2.blur(own.sharp * mask[..., None], window) / np.maximum(part, 1e-6)[..., None]
    alike = np.abs(own.sharp - of_sky).max(-1) < 2.0 * MOST_SPREAD
    return mask | (alike & (part > 0.5 / WINDOW_PX**2) & own.used)


def _uppermost(valid: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the mask (h, w) of the pixels at the upper border of a photo, or of the part of it that has rays, `valid`.

    `up` is in the camera's axes.
    """
    axis = int(abs(up[1]) >= abs(up[0]))  # the side of the photo that is up, also if the camera was turned
    beyond = np.pad(valid, WINDOW_PX // 2)
    step = int(np.sign(up[axis])) * (WINDOW_PX // 2)
    moved = np.roll(beyond, -step, axis=1 - axis)
    inner = slice(WINDOW_PX // 2, -(WINDOW_PX // 2))
    return valid & ~moved[inner, inner]
