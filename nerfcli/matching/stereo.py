"""Dense depth of training photos by stereo matching: semi-global matching of pairs of photos that agree.

rho is an inverse depth along the optical axis.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import apply, inverse
from nerfcli.matching.pair_stereo import forward_depths, sideways_depths
from nerfcli.matching.stereo_view import BLOCK_PX, FACES, FEWEST_SHARED, Faces, View, seen_by, view_of
from nerfcli.matching.tracks import LEAST_ANGLE_RAD, MOST_POINTS, SAME_SIDE_COS, Tracks, triangulate
from nerfcli.photos.loading import LoadedPhoto

# Photos that each photo is matched with, and how many of them have to agree on a depth.
NEIGHBOURS, LEAST_AGREEING = 4, 2
# Largest size at which pictures are matched; below the smaller size, matching finds too little. The size is chosen by
# the measured time per pixel on one thread, which is only an estimate.
LONGER_SIDE_PX, LEAST_SIDE_PX = 480, 160
SECONDS_PER_PIXEL = 1.5e-6
# Depths of two photos at the same place agree within this fraction.
CONSISTENT = 0.02
# Two depths agree within this many times the sum of their standard errors plus this fraction of the depth.
AGREE_ERRORS, AGREE_PART = 0.7, 0.005


@dataclass(frozen=True)
class DenseDepth:
    """Pixels of a photo at known distances.

    Args:
        pixels: (N, 2) int64 column and row in the training photo; each pixel at most once.
        distances: (N,) along their rays, scene units.
        errors: (N,) expected relative errors of the distances.
    """

    pixels: np.ndarray
    distances: np.ndarray
    errors: np.ndarray

    def points(self, frame: Frame, chosen: np.ndarray) -> np.ndarray:
        """Return the points (N, 3), in the scene's frame, of the pixels with these numbers."""
        bearings, _ = frame.camera.bearings(self.pixels[chosen] + 0.5)
        return apply(frame.world_from_cam, bearings * self.distances[chosen, None])


def affordable_side_px(photos: Sequence[LoadedPhoto], *, seconds: float, threads: int) -> int:
    """Return the longer side of the pictures that can be matched in a given time; 0 if it is too short."""
    aspects = [
        FACES if photo.frame.camera.is_spherical else min(photo.pixels.shape[:2]) / max(photo.pixels.shape[:2])
        for photo in photos
    ]
    side = min(LONGER_SIDE_PX, math.sqrt(seconds * threads / (SECONDS_PER_PIXEL * sum(aspects))))
    return int(side) if side >= LEAST_SIDE_PX else 0


def dense_depths(
    photos: Sequence[LoadedPhoto], tracks: Tracks, *, longer_side_px: int, threads: int
) -> list[DenseDepth]:
    """Estimate the distance of the pixels of each photo on which several of its neighbours agree.

    Each photo is matched with up to `NEIGHBOURS` others by semi-global matching, rectified, or sampled along epipolar
    lines where the camera moved along the viewing direction. A depth is accepted if `LEAST_AGREEING` neighbours agree
    on it within the errors (one, where there is only one), and if the depth map of a neighbour confirms it.
    It is the mean of the agreeing depths, weighted by inverse variance. Panoramas are matched by the faces of a cube,
    each like a photo.

    Args:
        tracks: sparse points, which determine the neighbours and the range of depths.
        longer_side_px: longer side of the pictures that are matched.

    Returns:
        One entry per photo, without pixels where nothing is known.

    Source: Hirschmüller 2008, Stereo processing by semi-global matching, TPAMI 30(2); OpenCV's StereoSGBM.
    """
    faces = Faces.of(photos)
    flat, tracks = faces.photos, faces.tracks(tracks)  # no panoramas
    points, shown = _points_shown(flat, tracks)
    near = _neighbours(points, shown, np.array([photo.frame.centre for photo in flat]))
    own_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # each thread processes a photo
    try:
        with ThreadPoolExecutor(max(1, threads)) as pool:
            views = list(pool.map(lambda photo: view_of(photo, longer_side_px), flat))

            def map_of(index: int) -> tuple[np.ndarray, np.ndarray]:
                return _map(views[index], [views[other] for other in near[index]], points[shown[index]])

            maps = list(pool.map(map_of, range(len(flat))))

            def depth_of(index: int) -> DenseDepth:
                others = [(views[other], maps[other][0]) for other in near[index]]
                return _depth(flat[index], views[index], maps[index], others)

            found = list(pool.map(depth_of, range(len(flat))))
    finally:
        cv2.setNumThreads(own_threads)
    depths = []
    for number in range(len(photos)):
        own = found[faces.own(number)]
        pixels, index = faces.joined(number, [depth.pixels for depth in own])
        distances, errors = (np.concatenate([getattr(d, name) for d in own])[index] for name in ("distances", "errors"))
        depths.append(DenseDepth(pixels, distances, errors))
    return depths


def _points_shown(photos: Sequence[LoadedPhoto], tracks: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangulated points (P, 3), and which of them each photo shows, (photos, P) bool."""
    surface = triangulate([photo.frame for photo in photos], tracks)
    found = np.isfinite(surface.misses_px)
    count = tracks.count
    rays = tracks.rays[found].T
    towards = np.stack([np.bincount(tracks.points[found], axis, count).astype(np.float64) for axis in rays], axis=-1)
    finite = np.flatnonzero(np.isfinite(surface.points).all(axis=1))
    finite = finite[:: 1 + len(finite) // MOST_POINTS]
    points, towards = surface.points[finite], towards[finite]
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    shown = np.zeros((len(photos), len(points)), dtype=bool)
    for index, photo in enumerate(photos):
        away = points - photo.frame.centre
        same_side = np.einsum("pi,pi->p", away, towards) > SAME_SIDE_COS * np.linalg.norm(away, axis=1)
        pixels, valid = photo.frame.camera.project(apply(inverse(photo.frame.world_from_cam), points))
        in_front = away @ photo.frame.world_from_cam[:3, 2] > 0
        shown[index] = same_side & valid & photo.frame.camera.contains(pixels) & in_front
    return points, shown


def _neighbours(points: np.ndarray, shown: np.ndarray, centres: np.ndarray) -> list[list[int]]:
    """Return for each photo the photos to match it with, the best first.

    Rays at an angle of 5 degrees are best, and smaller angles worse than larger ones.
    Source: Yao et al. 2018, MVSNet, arXiv:1804.02505, section 4.1.
    """
    rays = (points - centres[:, None]).astype(np.float32)
    rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    found = []
    for index in range(len(centres)):
        own = shown[index]
        both = shown[:, own]
        angles = np.arccos(np.clip(np.einsum("opi,pi->op", rays[:, own], rays[index, own]), -1.0, 1.0))
        off = np.degrees(angles) - 5.0
        fits = np.exp(-0.5 * np.square(off / np.where(off < 0, 1.0, 10.0)))
        scores = np.where(both & (angles > LEAST_ANGLE_RAD), fits, 0.0).sum(1)
        scores[(both.sum(1) < FEWEST_SHARED) | (np.arange(len(centres)) == index)] = 0.0
        order = np.argsort(-scores, kind="stable")[:NEIGHBOURS]
        found.append([int(other) for other in order if scores[other] > 0])
    return found


def _map(view: View, others: Sequence[View], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Match a view with its neighbours; `points` (P, 3) are the ones that the view shows.

    Returns inverse depths (h, w) float32 along the optical axis, NaN where unknown, and their errors.
    """
    pairs = ((view, other, points) for other in others)
    matched = [found for pair in pairs if (found := sideways_depths(*pair) or forward_depths(*pair)) is not None]
    rho, errors, agreeing = _agreed(matched, view.grey.shape)
    rho[(agreeing < max(1, min(LEAST_AGREEING, len(matched)))) | ~view.shown | ~_has_texture(view.grey)] = np.nan
    return rho, errors


def _depth(
    photo: LoadedPhoto, view: View, own: tuple[np.ndarray, np.ndarray], others: Sequence[tuple[View, np.ndarray]]
) -> DenseDepth:
    """Return the pixels of a photo whose depth the inverse depths of a neighbour confirm."""
    rows, columns = np.nonzero(np.isfinite(own[0]))
    rho, errors = (values[rows, columns] for values in own)
    confirmed = np.zeros(len(rho), dtype=bool)
    for other, other_rho in others:
        column, row, z = seen_by(other, view, columns, rows, rho)
        height, width = other_rho.shape
        inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        place = np.where(inside, row * width + column, 0).astype(np.int64)
        with np.errstate(divide="ignore", invalid="ignore"):
            confirmed |= inside & (np.abs(other_rho.ravel()[place] * z / rho - 1.0) < CONSISTENT)
    rows, columns, rho, errors = rows[confirmed], columns[confirmed], rho[confirmed], errors[confirmed]
    bearings, _ = view.pinhole.bearings(np.stack([columns, rows], axis=-1) + 0.5)
    camera = photo.frame.camera
    pixels, valid = camera.project(bearings)
    inside = valid & camera.contains(pixels)
    whole = np.floor(pixels[inside]).astype(np.int64)
    _, first = np.unique(whole @ (1, camera.width), return_index=True)
    distances = 1.0 / (rho * bearings[:, 2])
    return DenseDepth(whole[first], distances[inside][first], (errors / rho)[inside][first])


def _has_texture(grey: np.ndarray) -> np.ndarray:
    """Return the mask (h, w) of pixels around which the grey levels differ by more than noise."""
    levels = grey.astype(np.float32)
    window = (2 * BLOCK_PX + 1, 2 * BLOCK_PX + 1)
    mean = cv2.blur(levels, window)
    return cv2.blur(levels * levels, window) - mean * mean > 3.0**2


def _agreed(
    matched: Sequence[tuple[np.ndarray, np.ndarray]], shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the inverse depths (h, w) that most estimates agree on, their standard errors, and how many agree."""
    best, error = (np.full(shape, np.nan, np.float32) for _ in range(2))
    agreeing = np.zeros(shape, np.int8)
    for one, (rho, errors) in enumerate(matched):
        number = np.zeros(shape, np.int8)
        total, mean = (np.zeros(shape, np.float32) for _ in range(2))
        for other, (other_rho, other_errors) in enumerate(matched):
            within = AGREE_ERRORS * (errors + other_errors) + AGREE_PART * rho
            with np.errstate(invalid="ignore"):  # NaN agrees with nothing
                agree = np.abs(other_rho - rho) <= within
            weights = agree / np.square(other_errors)
            number += agree
            total += weights
            mean += weights * (np.where(agree, other_rho - rho, 0.0) if other != one else 0.0)
        better = number > agreeing
        best[better] = rho[better] + mean[better] / total[better]
        error[better] = 1.0 / np.sqrt(total[better])
        agreeing[better] = number[better]
    return best, error, agreeing
