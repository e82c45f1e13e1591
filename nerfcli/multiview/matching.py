"""Features that two training photos have in common.

They tell of the geometry of a capture before anything is learned: where surfaces are, and whether the lenses fit.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.layout import centres_of, views_of
from nerfcli.photos.loading import Photo

# Features are sought in photos whose longer side is at most this, so that it takes seconds.
LONGER_SIDE_PX = 600
MOST_FEATURES = 1500
# Photos, evenly chosen, that are compared with others, and the others: of those that look about the same way, which
# ones, from the nearest on. Near ones have most in common, far ones tell most.
MOST_PHOTOS = 16
PARTNERS = (1, 3, 9)
SAME_WAY_COS = np.cos(np.radians(40.0))
# A match is kept if the second-best feature is this much farther away. Source: Lowe 2004, section 7.1.
RATIO = 0.75

# Pixels (K, 2) with centres at 0.5, and descriptors (K, 128).
Features = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Matches:
    """What two photos have in common; some of it is wrong.

    Args:
        photos: their numbers.
        pixels: (N, 2) of each, centres at 0.5.
    """

    photos: tuple[int, int]
    pixels: tuple[np.ndarray, np.ndarray]


def match(photos: Sequence[Photo], *, threads: int) -> tuple[Matches, ...]:
    """The matches of `chosen_pairs` that have any."""
    pairs = chosen_pairs(photos)
    wanted = sorted({index for pair in pairs for index in pair})
    own_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # a photo per thread, and no more threads than were asked for
    try:
        with ThreadPoolExecutor(max(1, threads)) as pool:
            features = dict(zip(wanted, pool.map(lambda index: _features(photos[index]), wanted), strict=True))
            found = pool.map(lambda pair: _in_common(pair, (features[pair[0]], features[pair[1]])), pairs)
            return tuple(matches for matches in found if len(matches.pixels[0]))
    finally:
        cv2.setNumThreads(own_threads)


def chosen_pairs(photos: Sequence[Photo]) -> list[tuple[int, int]]:
    """Pairs of photos that look about the same way from different places."""
    frames = [photo.frame for photo in photos]
    centres, views = centres_of(frames), views_of(frames)
    pairs: set[tuple[int, int]] = set()
    for index in np.unique(np.linspace(0, len(frames) - 1, MOST_PHOTOS).round().astype(int)):
        baselines = np.linalg.norm(centres - centres[index], axis=1)
        candidates = np.flatnonzero((views @ views[index] > SAME_WAY_COS) & (baselines > 0))
        candidates = candidates[np.argsort(baselines[candidates], kind="stable")]
        for place in PARTNERS:
            if place <= len(candidates):
                other = int(candidates[place - 1])
                pairs.add((min(int(index), other), max(int(index), other)))
    return sorted(pairs)


def _features(photo: Photo) -> Features:
    grey = cv2.cvtColor(np.ascontiguousarray(photo.pixels[..., :3]), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    scale = min(1.0, LONGER_SIDE_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale < 1 else grey
    used = (
        None if photo.used is None else cv2.resize(photo.used.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    )
    # Without the precise upscaling, OpenCV's keypoints lie a quarter of a pixel off.
    sift = cv2.SIFT.create(nfeatures=MOST_FEATURES, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(small, used)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    # OpenCV's positions have pixel centres at whole numbers.
    found = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64) + 0.5
    return found * (width / size[0], height / size[1]), descriptors


def _in_common(pair: tuple[int, int], features: tuple[Features, Features]) -> Matches:
    """Features of two photos that are each other's nearest, and clearly so."""
    (one_pixels, one), (other_pixels, other) = features
    if min(len(one), len(other)) < 2:
        return Matches(pair, (np.zeros((0, 2)), np.zeros((0, 2))))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {match.queryIdx: match.trainIdx for match in matcher.match(other, one)}
    nearest = matcher.knnMatch(one, other, k=2)
    chosen = [
        (best.queryIdx, best.trainIdx)
        for best, second in nearest
        if best.distance < RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    a, b = np.array(chosen, dtype=int).reshape(-1, 2).T
    return Matches(pair, (one_pixels[a], other_pixels[b]))


def radians_per_pixel(camera: Camera) -> float:
    """At the size in which features are sought."""
    return float(np.radians(max(camera.fov_deg))) / min(LONGER_SIDE_PX, max(camera.width, camera.height))
