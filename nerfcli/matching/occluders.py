"""Occluders: what hides a surface in one photo, such as people who pass or leaves in front of the lens.

Where several photos agree on a surface, another photo that looks at it shows its colours and detail. If not, it shows
something nearer. If nothing is known about the depth of that, it would float somewhere on its rays, where no other
photo looks.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.cameras.rigid import apply, inverse
from nerfcli.matching.sky import LONGER_SIDE_PX, MOST_DIFFERENCE, OTHERS, WINDOW_PX
from nerfcli.matching.stereo import DenseDepth
from nerfcli.matching.tracks import MOST_POINTS
from nerfcli.photos.images import reduced
from nerfcli.photos.loading import LoadedPhoto

# Two depths at the same place are of one surface if they differ by less than this fraction. Depths with larger expected
# errors are not used: a wrong surface is contradicted, too.
SAME_SURFACE = 0.03
# Levels that differ by more than `MOST_DIFFERENCE` and by more than this many standard deviations between the other
# photos do not agree; levels that differ by less than the second number agree.
DIFFERENT_SPREADS, ALIKE = 2.0, 16.0
# The correlation of detail below which it is different and above which it is the same, and the standard deviation of
# levels below which there is no detail.
UNLIKE, LIKE, LEAST_DETAIL = 0.4, 0.8, 8.0
# A photo is not judged if less than this fraction of the pixels that agree with others has a depth of its own: stereo
# matching with it has failed, as with a wrong pose.
LEAST_KNOWN = 0.5
# Smallest region of contradictions, as a fraction of the photo, and least fraction of the compared pixels of an
# occluder that are in such regions.
LEAST_PART, MOST_OF = 0.002, 0.5
# An occluder ends at this distance from the contradictions, as a fraction of the longer side.
REACH = 0.06
# An occluder whose extent is not known is kept whole: one of which more than this fraction of the edge is where it ends
# by distance.
MOST_OPEN = 0.25
# A region with a border of which more than the second number is nearer than this fraction of what it hides continues a
# known surface.
NEARER, MOST_NEARER = 0.94, 0.25


def occluder_masks(
    photos: Sequence[LoadedPhoto],
    dense: Sequence[DenseDepth],
    skies: Sequence[np.ndarray],
    log_gains: np.ndarray,
    *,
    threads: int,
) -> list[np.ndarray]:
    """Return for each photo the mask (H, W) of the pixels where something hides what other photos see.

    Pixels contradict a surface on which at least two other photos agree if their colour and their detail are
    different. An occluder consists of pixels without a known depth around such contradictions. If such a region
    continues a nearer surface, it is none, but a side of an object on which stereo matching has failed.

    Args:
        dense: stereo depths of the photos.
        skies: (H, W) masks of pixels that may show the sky, which hides nothing.
        log_gains: (photos, 3) logarithms of the photos' exposures; NaN where unknown.
    """
    gains = np.exp((1.0 / 2.2) * np.nan_to_num(log_gains))  # of sRGB levels, about this power of light
    centres = np.array([photo.frame.centre for photo in photos])
    with ThreadPoolExecutor(max(1, threads)) as pool:
        small = list(pool.map(_Small, photos, dense, skies, gains))

        def mask_of(index: int) -> np.ndarray:
            near = np.argsort(np.linalg.norm(centres - centres[index], axis=1), kind="stable")[1 : OTHERS + 1]
            mask = _hidden(small[index], [small[other] for other in near.tolist()]).astype(np.uint8)
            return cv2.resize(mask, photos[index].frame.camera.size, interpolation=cv2.INTER_NEAREST) > 0

        return list(pool.map(mask_of, range(len(photos))))


class _Small:
    """A reduced photo: its levels, its known distances (NaN elsewhere), and its pixels with a depth as points.

    Args:
        gain: (3,) factors of the photo's levels; `colours` are those of the points without it.
    """

    def __init__(self, photo: LoadedPhoto, depth: DenseDepth, sky: np.ndarray, gain: np.ndarray):
        self.world_from_cam, self.gain = photo.frame.world_from_cam, gain
        self.levels = reduced(np.ascontiguousarray(photo.pixels[..., :3]), LONGER_SIDE_PX).astype(np.float32)
        camera, size = photo.frame.camera, (self.levels.shape[1], self.levels.shape[0])
        self.camera = camera.resized(*size)
        ignored = sky if photo.used is None else sky | ~photo.used
        if photo.pixels.shape[-1] == 4:
            ignored = ignored | (photo.pixels[..., 3] < 255)
        self.ignored = cv2.resize(ignored.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        cells = ((depth.pixels + 0.5) * (size[0] / camera.width, size[1] / camera.height)).astype(np.int64)
        self.distances = np.full(self.levels.shape[:2], np.nan)
        self.distances[cells[:, 1], cells[:, 0]] = depth.distances
        exact = np.flatnonzero(depth.errors < SAME_SURFACE)
        chosen = np.random.default_rng(0).permutation(exact)[:MOST_POINTS]
        self.points = depth.points(photo.frame, chosen)
        self.colours = self.levels[cells[chosen, 1], cells[chosen, 0]] / gain


@dataclass(frozen=True)
class _Expected:
    """The nearest surface on which other photos agree, for each pixel of a small photo; NaN where there is none.

    distances: (h, w). levels: (h, w, 3) at the exposure of the small photo. spreads: (h, w), the largest standard
    deviation of the channels of the levels.
    """

    distances: np.ndarray
    levels: np.ndarray
    spreads: np.ndarray


def _expected(own: _Small, others: Sequence[_Small]) -> _Expected:
    """Return what a small photo should show; `others` are at least two."""
    height, width = own.distances.shape
    count = height * width
    nearest = np.full((len(others), count), np.inf)
    seen = []
    for number, other in enumerate(others):
        in_camera = apply(inverse(own.world_from_cam), other.points)
        pixels, valid = own.camera.project(in_camera)
        shown = valid & own.camera.contains(pixels)
        cells = pixels[shown].astype(np.int64) @ (1, width)
        distances = np.linalg.norm(in_camera[shown], axis=1)
        np.minimum.at(nearest[number], cells, distances)
        seen.append((cells, distances, other.colours[shown]))
    first, second = np.sort(nearest, axis=0)[:2]
    # Nothing is expected where one photo alone has something nearer: the others may just not know it.
    surface = np.where(second <= (1.0 + SAME_SURFACE) * first, first, np.inf)
    cells, distances, colours = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    on_it = np.abs(distances / surface[cells] - 1.0) < SAME_SURFACE
    cells, colours = cells[on_it], colours[on_it] * own.gain
    number = np.bincount(cells, minlength=count)
    means, squares = (
        np.stack([np.bincount(cells, values, count) for values in part.T], axis=-1) / np.maximum(number, 1)[:, None]
        for part in (colours, np.square(colours))
    )
    spreads = np.sqrt(np.maximum(squares - np.square(means), 0.0)).max(-1)
    known = number > 0
    return _Expected(
        np.where(known, surface, np.nan).reshape(height, width),
        np.where(known[:, None], np.minimum(means, 255.0), np.nan).reshape(height, width, 3),
        np.where(known, spreads, np.nan).reshape(height, width),
    )


def _hidden(own: _Small, others: Sequence[_Small]) -> np.ndarray:
    """Return the mask (h, w) of what hides surfaces on which at least two other photos agree."""
    mask = np.zeros(own.distances.shape, bool)
    if len(others) < 2:
        return mask
    expected = _expected(own, others)
    compared, known = np.isfinite(expected.distances), np.isfinite(own.distances)
    agrees, contradicts = _compared(own, expected, compared)
    unknown = ~known & ~agrees & ~own.ignored
    contradicts = _large_regions(contradicts) & unknown
    if not contradicts.any() or (agrees & known).sum() < LEAST_KNOWN * agrees.sum():
        return mask
    away = cv2.distanceTransform((~contradicts).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    within_reach = unknown & (away <= REACH * max(mask.shape))
    count, labels = cv2.connectedComponents(within_reach.astype(np.uint8), connectivity=4)
    for label in range(1, count):
        region = labels == label
        core = region & contradicts & compared
        enough = max(LEAST_PART * mask.size, MOST_OF * (region & compared).sum())
        edge = (cv2.dilate(region.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~region
        if core.sum() < enough or unknown[edge].mean() > MOST_OPEN or _continues(own, expected, core):
            continue
        mask |= region
    # Narrow gaps look like what is hidden by chance; pixels at the edge are mixed with what is behind.
    whole = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((WINDOW_PX, WINDOW_PX), np.uint8))
    return cv2.dilate(whole, np.ones((5, 5), np.uint8)) > 0


def _compared(own: _Small, expected: _Expected, compared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where a photo agrees with the expected levels, and where it contradicts them, both (h, w) bool."""
    square = np.ones((3, 3), np.uint8)  # poses and depths are not exact
    darkest = cv2.erode(np.where(compared[..., None], expected.levels, 255.0), square)
    brightest = cv2.dilate(np.where(compared[..., None], expected.levels, 0.0), square)
    seen = cv2.blur(own.levels, (3, 3))
    outside = np.maximum(darkest - seen, seen - brightest).max(-1)
    correlation, detail = _correlation(own.levels.mean(-1), expected.levels.mean(-1), compared)
    with np.errstate(invalid="ignore"):  # NaN, where nothing is expected, is neither
        agrees = compared & ((outside < ALIKE) | (correlation > LIKE))
        differs = outside > np.maximum(MOST_DIFFERENCE, DIFFERENT_SPREADS * expected.spreads)
    return agrees, compared & differs & (correlation < UNLIKE) & (detail > LEAST_DETAIL)


def _correlation(one: np.ndarray, other: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the correlation of two pictures (h, w) in the window around each pixel, and the larger of their standard
    deviations there, both of valid pixels only.
    """

    def mean_of(values: np.ndarray) -> np.ndarray:
        return cv2.blur(np.where(valid, values, 0.0).astype(np.float32), (WINDOW_PX, WINDOW_PX)) / weight

    weight = np.maximum(cv2.blur(valid.astype(np.float32), (WINDOW_PX, WINDOW_PX)), 1e-6)
    means = mean_of(one), mean_of(other)
    variances = [np.maximum(mean_of(v * v) - m * m, 0.0) for v, m in zip((one, other), means, strict=True)]
    covariance = mean_of(one * other) - means[0] * means[1]
    return covariance / np.sqrt(variances[0] * variances[1] + 1e-3), np.sqrt(np.maximum(*variances))


def _large_regions(mask: np.ndarray) -> np.ndarray:
    """Return the regions of a mask (h, w) that are compact and large enough, without their gaps of single pixels."""
    square = np.ones((3, 3), np.uint8)
    filled = cv2.blur(mask.astype(np.float32), (3, 3)) > 0.5
    opened = cv2.morphologyEx(filled.astype(np.uint8), cv2.MORPH_OPEN, square)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= LEAST_PART * mask.size
    large[0] = False
    return large[labels]


def _continues(own: _Small, expected: _Expected, region: np.ndarray) -> bool:
    """Return whether a region (h, w) borders on known surfaces that are nearer than what it hides there."""
    square = np.ones((5, 5), np.uint8)
    behind = cv2.dilate(np.where(region, expected.distances, 0.0), square)
    border = (behind > 0.0) & ~region & np.isfinite(own.distances)
    nearer = own.distances[border] < NEARER * behind[border]
    return bool(nearer.mean() > MOST_NEARER) if len(nearer) else False
