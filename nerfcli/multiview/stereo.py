"""Dense depth of training photos by stereo matching: semi-global matching of rectified pairs that agree.

Letters: K is the matrix of a pinhole camera, R its rotation from the scene's axes, rho an inverse depth along the
optical axis.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.rigid import apply, inverse
from nerfcli.multiview.panorama_faces import FACES, Faces
from nerfcli.multiview.tracks import Tracks
from nerfcli.multiview.triangulation import LEAST_ANGLE_RAD, triangulate
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.photos.undistorted import pinhole_of, undistorted

# Photos that each photo is matched with, and how many of them have to agree on a depth. On the desk scene, 44 % of the
# pixels are within 1 % of the truth with three neighbours and 52 % with four, in 1.3 times the time.
NEIGHBOURS, LEAST_AGREEING = 4, 2
# Largest size at which pictures are matched; below the smaller size, matching finds too little. The size is chosen by
# the measured time per pixel on one thread, which is only an estimate.
LONGER_SIDE_PX, LEAST_SIDE_PX = 480, 160
SECONDS_PER_PIXEL = 1.5e-6
# Best angle between rays of two photos, and how fast pairs at smaller and larger angles get worse. Source: Yao et al.
# 2018, MVSNet, arXiv:1804.02505, section 4.1.
BEST_ANGLE_DEG, SMALLER_DEG, LARGER_DEG = 5.0, 1.0, 10.0
# A point counts as seen by photos that look at it within this angle of a photo in which it was found.
SAME_SIDE_COS = np.cos(np.radians(40.0))
# More points take time and memory, but do not change the result.
MOST_POINTS = 20_000
# Fewest points that two photos must share to be neighbours.
FEWEST_SHARED = 12
# Depths are searched around the plane that fits a photo's points best, between these percentiles of the points' offsets
# from it, extended at either end by this fraction of their difference.
RANGE_PERCENTILES, BEYOND = (0.5, 99.5), 0.5
# Least extension at either end, in inverse depth, as a fraction of the median inverse depth.
LEAST_RANGE = 0.15
PLANE_ROUNDS = 10
# If the plane is narrower or wider than this in the other photo, its view is too oblique for the plane to be used.
LEAST_NARROWING, MOST_NARROWING = 0.3, 3.0
# Pairs cannot be rectified if the cosine between the baseline and the viewing direction is larger than this.
MOST_FORWARD_COS = 0.85
MOST_DISPARITIES, MOST_ENLARGEMENT = 256, 4.0
BLOCK_PX = 5
# Points at a smaller cosine to the common viewing direction of a pair are left out.
LEAST_RISE = 0.2
# Error of a disparity, pixels: two thirds of the pixels of the desk scene have at most this error.
DISPARITY_ERROR_PX = 0.8
# Depths of two photos at the same place agree within this fraction.
CONSISTENT = 0.02
# Two depths agree within this many times the sum of their standard errors plus this fraction of the depth.
AGREE_ERRORS, AGREE_PART = 0.7, 0.005
# Where grey levels spread by less than this, there is nothing to match.
LEAST_SPREAD = 3.0


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


@dataclass(frozen=True)
class _View:
    """A photo as a small pinhole picture."""

    grey: np.ndarray  # (h, w) uint8
    shown: np.ndarray  # (h, w) bool
    matrix: np.ndarray  # K, centre of the first pixel at 0 as in OpenCV
    turn: np.ndarray  # R
    centre: np.ndarray
    pinhole: Camera


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

    Each photo is rectified with up to `NEIGHBOURS` others and matched by semi-global matching. A depth is accepted if
    `LEAST_AGREEING` neighbours agree on it within the errors (one, where there is only one), and if the depth map of a
    neighbour confirms it. It is the mean of the agreeing depths, weighted by inverse variance. Panoramas are matched by
    the faces of a cube, each like a photo.

    Args:
        tracks: sparse points, which determine the neighbours and the range of depths.
        longer_side_px: longer side of the pictures that are matched.
        threads: number of photos processed at a time.

    Returns:
        One entry per photo, without pixels where nothing is known.

    Source: Hirschmüller 2008, Stereo processing by semi-global matching, TPAMI 30(2); OpenCV's StereoSGBM.
    """
    faces = Faces.of(photos)
    found = _depths_of(faces.photos, faces.tracks(tracks), longer_side_px=longer_side_px, threads=threads)
    depths = []
    for number in range(len(photos)):
        own = found[faces.own(number)]
        pixels, index = faces.joined(number, [depth.pixels for depth in own])
        distances, errors = (np.concatenate([getattr(d, name) for d in own])[index] for name in ("distances", "errors"))
        depths.append(DenseDepth(pixels, distances, errors))
    return depths


def _depths_of(photos: Sequence[LoadedPhoto], tracks: Tracks, *, longer_side_px: int, threads: int) -> list[DenseDepth]:
    """Return `dense_depths` of photos that are no panoramas."""
    points, shown = _points_shown(photos, tracks)
    centres = np.array([photo.frame.centre for photo in photos])
    near = _neighbours(points, shown, centres)
    own_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # each thread processes a photo
    try:
        with ThreadPoolExecutor(max(1, threads)) as pool:
            views = list(pool.map(lambda photo: _view(photo, longer_side_px), photos))

            def map_of(index: int) -> tuple[np.ndarray, np.ndarray]:
                return _map(views[index], [views[other] for other in near[index]], points[shown[index]])

            maps = list(pool.map(map_of, range(len(photos))))

            def depth_of(index: int) -> DenseDepth:
                others = [(views[other], maps[other][0]) for other in near[index]]
                return _depth(photos[index], views[index], maps[index], others)

            return list(pool.map(depth_of, range(len(photos))))
    finally:
        cv2.setNumThreads(own_threads)


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
        inside = (pixels >= 0).all(1) & (pixels < (photo.frame.camera.width, photo.frame.camera.height)).all(1)
        in_front = away @ photo.frame.world_from_cam[:3, 2] > 0
        shown[index] = same_side & valid & inside & in_front
    return points, shown


def _neighbours(points: np.ndarray, shown: np.ndarray, centres: np.ndarray) -> list[list[int]]:
    """Return for each photo the photos to match it with, the best first."""
    rays = (points - centres[:, None]).astype(np.float32)
    rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    found = []
    for index in range(len(centres)):
        both = shown & shown[index]
        angles = np.arccos(np.clip(np.einsum("opi,pi->op", rays, rays[index]), -1.0, 1.0))
        off = np.degrees(angles) - BEST_ANGLE_DEG
        fits = np.exp(-0.5 * np.square(off / np.where(off < 0, SMALLER_DEG, LARGER_DEG)))
        scores = np.where(both & (angles > LEAST_ANGLE_RAD), fits, 0.0).sum(1)
        scores[(both.sum(1) < FEWEST_SHARED) | (np.arange(len(centres)) == index)] = 0.0
        order = np.argsort(-scores, kind="stable")[:NEIGHBOURS]
        found.append([int(other) for other in order if scores[other] > 0])
    return found


def _view(photo: LoadedPhoto, longer_side_px: int) -> _View:
    """Reduce a photo and remove its distortion."""
    camera = photo.frame.camera
    scale = min(1.0, longer_side_px / max(camera.width, camera.height))
    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    size = (small.width, small.height)
    grey = cv2.cvtColor(np.ascontiguousarray(photo.pixels[..., :3]), cv2.COLOR_RGB2GRAY)
    used = np.full(grey.shape, 255, np.uint8) if photo.used is None else photo.used.astype(np.uint8) * 255
    if photo.pixels.shape[-1] == 4:
        used = np.minimum(used, photo.pixels[..., 3])
    both = np.stack([cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in (grey, used)], axis=-1)
    pinhole = pinhole_of(small)
    both, seen = undistorted(both, small, pinhole)
    fx, fy, cx, cy = pinhole.params
    turn = photo.frame.world_from_cam[:3, :3].T
    matrix = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    shown = seen & (both[..., 1] == 255)
    return _View(np.ascontiguousarray(both[..., 0]), shown, matrix, turn, photo.frame.centre, pinhole)


def _map(view: _View, others: Sequence[_View], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Match a view with its neighbours; `points` (P, 3) are the ones that the view shows.

    Returns inverse depths (h, w) float32 along the optical axis, NaN where unknown, and their errors.
    """
    matched = [found for other in others if (found := _matched(view, other, points)) is not None]
    rho, errors, agreeing = _agreed(matched, view.grey.shape)
    rho[(agreeing < max(1, min(LEAST_AGREEING, len(matched)))) | ~view.shown | ~_has_texture(view.grey)] = np.nan
    return rho, errors


def _depth(
    photo: LoadedPhoto,
    view: _View,
    own: tuple[np.ndarray, np.ndarray],
    others: Sequence[tuple[_View, np.ndarray]],
) -> DenseDepth:
    """Return the pixels of a photo whose depth the inverse depths of a neighbour confirm."""
    rows, columns = np.nonzero(np.isfinite(own[0]))
    rho, errors = (values[rows, columns] for values in own)
    confirmed = np.zeros(len(rho), dtype=bool)
    for other, other_rho in others:
        turn = (other.matrix @ other.turn @ view.turn.T @ np.linalg.inv(view.matrix)).astype(np.float32)
        move = (other.matrix @ other.turn @ (view.centre - other.centre)).astype(np.float32)
        x, y, z = (a * columns + b * rows + (c + move * rho) for (a, b, c), move in zip(turn, move, strict=True))
        height, width = other_rho.shape
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = np.rint(x / z), np.rint(y / z)
            inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
            place = np.where(inside, row * width + column, 0).astype(np.int64)
            confirmed |= inside & (np.abs(other_rho.ravel()[place] * z / rho - 1.0) < CONSISTENT)
    rows, columns, rho, errors = rows[confirmed], columns[confirmed], rho[confirmed], errors[confirmed]
    bearings, _ = view.pinhole.bearings(np.stack([columns, rows], axis=-1) + 0.5)
    camera = photo.frame.camera
    pixels, valid = camera.project(bearings)
    inside = valid & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    whole = np.floor(pixels[inside]).astype(np.int64)
    _, first = np.unique(whole @ (1, camera.width), return_index=True)
    distances = 1.0 / (rho * bearings[:, 2])
    return DenseDepth(whole[first], distances[inside][first], (errors / rho)[inside][first])


def _has_texture(grey: np.ndarray) -> np.ndarray:
    """Return the mask (h, w) of pixels around which the grey levels differ by more than noise."""
    levels = grey.astype(np.float32)
    window = (2 * BLOCK_PX + 1, 2 * BLOCK_PX + 1)
    mean = cv2.blur(levels, window)
    return cv2.blur(levels * levels, window) - mean * mean > LEAST_SPREAD**2


def _matched(one: _View, other: _View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return inverse depths (h, w) of the first view's pixels by matching a pair, NaN where unknown, and their errors.

    None where the pair cannot be rectified. Both pictures are turned so that the baseline is along their rows: a point
    at z in the turned axes then has the disparity f * baseline / z. The second picture is then stretched so that the
    plane that fits the points best has zero disparity: surfaces near it look alike in both, at any viewing angle.
    """
    baseline = float(np.linalg.norm(other.centre - one.centre))
    forward = one.turn[2] + other.turn[2]
    forward = forward / np.linalg.norm(forward)
    x = (other.centre - one.centre) / max(baseline, 1e-300)
    if baseline == 0.0 or abs(x @ forward) > MOST_FORWARD_COS:
        return None
    y = np.cross(forward, x)
    y /= np.linalg.norm(y)
    turned = np.stack([x, y, np.cross(x, y)])
    focal = one.matrix[0, 0]
    # In the turned axes, the inverse z of a plane is affine in (x / z, y / z).
    seen = (points - one.centre) @ turned.T
    seen = seen[seen[:, 2] > LEAST_RISE * np.linalg.norm(seen, axis=1)]
    if len(seen) < FEWEST_SHARED:
        return None
    inverse_z = 1.0 / seen[:, 2]
    plane = _fitted_plane(seen[:, :2] * inverse_z[:, None], inverse_z)  # by x / z, y / z, and 1
    narrowing = 1.0 - baseline * plane[0]
    if not LEAST_NARROWING < narrowing < MOST_NARROWING:
        plane, narrowing = np.array([0.0, 0.0, np.median(inverse_z)]), 1.0
    off = inverse_z - (seen[:, :2] * inverse_z[:, None]) @ plane[:2] - plane[2]
    least, most = np.percentile(off, RANGE_PERCENTILES)
    margin = max(BEYOND * (most - least), LEAST_RANGE * float(np.median(inverse_z)))
    per_disparity = narrowing / (focal * baseline)  # inverse z
    # The matcher prefers whole disparities: make that of the plane whole.
    least, most = per_disparity * math.floor((least - margin) / per_disparity), most + margin
    count = 16 * int(np.clip(np.ceil((most - least) / per_disparity / 16), 1, MOST_DISPARITIES // 16))
    low, high = _bounds(one, turned, focal)
    other_low, other_high = _bounds(other, turned, focal)
    top, bottom = max(low[1], other_low[1]), min(high[1], other_high[1])
    # The matcher skips as many columns on the left as there are disparities. The least disparity is made 0.
    width, height = int(high[0] - low[0]) + 1 + count, int(bottom - top)
    if height < 2 * BLOCK_PX or width * height > MOST_ENLARGEMENT * one.grey.size:
        return None
    picture = np.array([[focal, 0.0, count - low[0]], [0.0, focal, -top], [0.0, 0.0, 1.0]])
    homography = picture @ turned @ one.turn.T @ np.linalg.inv(one.matrix)
    left = cv2.warpPerspective(one.grey, homography, (width, height), flags=cv2.INTER_LINEAR)
    # On the plane moved by `least`, (x / z, y / z) of the first view is at this place of the second one.
    stretched = np.array([[narrowing, -baseline * plane[1], -baseline * plane[2]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    stretched[0, 2] -= baseline * least
    back = other.matrix @ other.turn @ turned.T @ stretched @ np.linalg.inv(picture)
    right = cv2.warpPerspective(other.grey, back, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    disparities = _disparities(left, right, count)
    ahead_x, ahead_y, rise = _per_pixel(turned @ one.turn.T @ np.linalg.inv(one.matrix), one.grey.shape)
    rise = np.maximum(rise, LEAST_RISE)
    ahead_x, ahead_y = ahead_x / rise, ahead_y / rise
    column = np.float32(focal) * ahead_x + np.float32(picture[0, 2])
    row = np.float32(focal) * ahead_y + np.float32(picture[1, 2])
    nowhere = float("nan")
    found = cv2.remap(disparities, column, row, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=nowhere)
    across, down, middle = plane.astype(np.float32)
    inverse_z = found * np.float32(per_disparity) + ahead_x * across + ahead_y * down + (middle + np.float32(least))
    # A point at depth 1 / rho along the optical axis is at z = rise / rho in the turned axes.
    rho = inverse_z * rise
    rho[~(rho > 0)] = np.nan
    return rho, np.float32(DISPARITY_ERROR_PX * per_disparity) * rise


def _per_pixel(matrix: np.ndarray, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Return the three rows of a matrix times (column, row, 1), for all pixels of a picture (h, w), float32."""
    columns, rows = np.arange(shape[1]), np.arange(shape[0])[:, None]
    return [(x * columns + (y * rows + one)).astype(np.float32) for x, y, one in matrix]


def _fitted_plane(places: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Fit a x + b y + c to values (N,) at (x, y) (N, 2) by least absolute differences; return (a, b, c)."""
    design = np.column_stack([places, np.ones(len(places))])
    floor = 1e-3 * float(np.median(np.abs(values)))
    weights = np.ones(len(values))
    plane = np.zeros(3)
    for _ in range(PLANE_ROUNDS):
        plane = np.linalg.lstsq(design * np.sqrt(weights)[:, None], values * np.sqrt(weights), rcond=None)[0]
        weights = 1.0 / np.maximum(np.abs(design @ plane - values), floor)
    return plane


def _disparities(left: np.ndarray, right: np.ndarray, count: int) -> np.ndarray:
    """Return the disparities (h, w) float32 of the left picture, NaN where the match is ambiguous."""
    squares = BLOCK_PX * BLOCK_PX
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=BLOCK_PX,
        P1=8 * squares,
        P2=32 * squares,
        disp12MaxDiff=1,
        uniquenessRatio=5,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = matcher.compute(left, right).astype(np.float32) / 16.0
    found[found < 0] = np.nan
    return found


def _bounds(view: _View, turned: np.ndarray, focal: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest coordinates (2,) of a view's corners in a turned picture, pixels."""
    height, width = view.grey.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], dtype=np.float64)
    rays = corners @ (turned @ view.turn.T @ np.linalg.inv(view.matrix)).T
    places = (
        focal * rays[:, :2] / np.maximum(rays[:, 2:], LEAST_RISE)
    )  # corners that are turned away further would make the box too large
    return places.min(0), places.max(0)


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
