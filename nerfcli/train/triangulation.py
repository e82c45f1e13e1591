"""Points of the surface, found in the training photos with the poses that the scene gives.

Some capture formats bring cameras and no points. Where the cameras look, nobody knows then how far what they see is
away; matched features tell, within a few seconds.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.layout import centres_of, views_of
from nerfcli.train.photos import Photo

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
# How far a point may be from where its features are; poses and lenses of captures are often off by a pixel or two.
WITHIN_PX = 3.0
# Rays that meet at less than this are as good as parallel: the distance would be made of noise.
LEAST_ANGLE_RAD = np.radians(0.5)

# Pixels (K, 2) with centres at 0.5, and descriptors (K, 128).
Features = tuple[np.ndarray, np.ndarray]


def triangulate(photos: Sequence[Photo], *, threads: int) -> np.ndarray:
    """Points (N, 3) in the scene's frame, float64, that two photos agree on; N is 0 where nothing can be matched.

    Accuracy: a few per cent of the distance at best, and a few wrong ones are among them: good for percentiles.
    """
    pairs = chosen_pairs(photos)
    wanted = sorted({index for pair in pairs for index in pair})
    own_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # a photo per thread, and no more threads than were asked for
    try:
        with ThreadPoolExecutor(max(1, threads)) as pool:
            features = dict(zip(wanted, pool.map(lambda index: _features(photos[index]), wanted), strict=True))
            found = pool.map(
                lambda pair: _points((photos[pair[0]], photos[pair[1]]), (features[pair[0]], features[pair[1]])), pairs
            )
            return np.concatenate([np.zeros((0, 3)), *found])
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


def _points(photos: tuple[Photo, Photo], features: tuple[Features, Features]) -> np.ndarray:
    """The points (M, 3) of the matches of two photos that fit their poses."""
    (one_pixels, one), (other_pixels, other) = features
    if min(len(one), len(other)) < 2:
        return np.zeros((0, 3))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {match.queryIdx: match.trainIdx for match in matcher.match(other, one)}
    nearest = matcher.knnMatch(one, other, k=2)
    chosen = [
        (best.queryIdx, best.trainIdx)
        for best, second in nearest
        if best.distance < RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    if not chosen:
        return np.zeros((0, 3))
    a, b = np.array(chosen).T
    rays = [_world_rays(photo, pixels) for photo, pixels in zip(photos, (one_pixels[a], other_pixels[b]), strict=True)]
    tolerances = tuple(WITHIN_PX * _radians_per_pixel(photo.frame.camera) for photo in photos)
    return meetings(
        (photos[0].frame.centre, photos[1].frame.centre), (rays[0], rays[1]), (tolerances[0], tolerances[1])
    )


def meetings(
    centres: tuple[np.ndarray, np.ndarray], rays: tuple[np.ndarray, np.ndarray], tolerances: tuple[float, float]
) -> np.ndarray:
    """Where rays of two cameras meet, (M, 3): of the pairs that do, the middles of their closest points.

    Args:
        centres: (3,) of each camera.
        rays: (N, 3) unit directions of each; NaN where there is none.
        tolerances: how far a ray may pass beside its point, in radians as its camera sees it.
    """
    (p, q), (d, e) = centres, rays
    baseline = q - p
    cosine = np.einsum("ni,ni->n", d, e)
    along_d, along_e = d @ baseline, e @ baseline
    # Closest points p + s d and q + t e: d and e are both across their connection.
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (along_d - cosine * along_e) / (1 - cosine**2)
        t = (cosine * along_d - along_e) / (1 - cosine**2)
        first, second = p + s[:, None] * d, q + t[:, None] * e
        half_gap = np.linalg.norm(first - second, axis=1) / 2
        angle = np.arctan2(np.linalg.norm(np.cross(d, e), axis=1), cosine)
        good = (s > 0) & (t > 0) & (angle > LEAST_ANGLE_RAD)
        good &= (half_gap < tolerances[0] * s) & (half_gap < tolerances[1] * t)
    return (first[good] + second[good]) / 2


def _world_rays(photo: Photo, pixels: np.ndarray) -> np.ndarray:
    bearings, valid = photo.frame.camera.bearings(pixels)
    return np.where(valid[:, None], bearings, np.nan) @ photo.frame.world_from_cam[:3, :3].T


def _radians_per_pixel(camera: Camera) -> float:
    """At the size in which features are sought."""
    return float(np.radians(max(camera.fov_deg))) / min(LONGER_SIDE_PX, max(camera.width, camera.height))
