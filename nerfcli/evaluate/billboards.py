"""Baseline without geometry that a field must beat: each training photo on a sphere around its camera.

Any geometry explains any photos if colour may depend arbitrarily on direction (shape-radiance ambiguity: Zhang et al.
2020, NeRF++, arXiv:2010.07492, section 3). Here the geometry carries no information, the photos are the radiance, and
the distance, one per camera, is fitted. If the photos carry three-dimensional information, a field beats this baseline
on views that neither has seen; photos from a camera that only rotated, or only two photos, do not.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import centres_of, focus_point, views_of
from nerfcli.cameras.rigid import apply, inverse
from nerfcli.errors import reason_of
from nerfcli.photos.colours import psnr_of, to_8_bit
from nerfcli.photos.images import downscale

# Largest side of the photos on the billboards; a model without geometry is off by more than one of these pixels.
LONGER_SIDE_PX = 400
# Each billboard is fitted to this many pixels of each of this many nearest other photos, at distances from 1/50 to 100
# times that of the cameras' focus point.
FITTED_PIXELS, FITTED_PHOTOS = 400, 4
DISTANCES = np.geomspace(0.02, 100.0, 64)
# A distance is considered only if it has at least this fraction of the largest number of rays that hit at any distance.
ENOUGH_HITS = 0.5
COMPARED_PIXELS = 4096
# A ray's colour is a mean over the billboards of this many near cameras, weighted with 1 / (angle^2 + LEAST_ANGLE^2),
# where angle is that between the ray and the camera's line of sight at the point that is hit.
BLENDED, LEAST_ANGLE_RAD = 6, math.radians(0.5)
# A gain is significant if it is above this, and above this many standard errors. These come from parts of the photos,
# PARTS x PARTS each: there are often only two photos, whose gains differ because one of them has near neighbours.
LEAST_GAIN_DB, STANDARD_ERRORS = 1.0, 2.0
PARTS = 4
SEED = 7


@dataclass(frozen=True)
class GeometryEvidence:
    """Evidence for geometry, over all held-out photos.

    Args:
        psnr: PSNR of the billboards, mean over the photos, dB.
        field_psnr: PSNR of the field on the same pixels; gain_db is the difference.
        error_db: its standard error, see `gain_error_db`; None if no photo has two parts.
        shown: whether the gain is significant.
        seconds: the time that fitting and comparing took.
    """

    psnr: float
    field_psnr: float
    gain_db: float
    error_db: float | None
    shown: bool
    seconds: float

    def in_words(self) -> str:
        """Return a sentence for people."""
        compared = (
            f"{self.field_psnr:.2f} dB for the field, {self.psnr:.2f} dB for billboards (a model without geometry)"
        )
        if self.shown:
            return f"geometry: {compared}"
        if self.gain_db > 0:
            needed = max(LEAST_GAIN_DB, STANDARD_ERRORS * (self.error_db or 0.0))
            compared = f"{compared}; it takes a gain of {needed:.1f} dB to be sure"
        return (
            f"no evidence of geometry: {compared}. The training was too short, the cameras are wrong, or these photos "
            "do not determine depth (the camera only turned, too few photos, a flat scene): do not trust its depth"
        )


class Billboards:
    """The baseline: photos, and a distance for each. Fitting takes about 0.04 s per photo.

    Args:
        frames: the training views, at least one; their cameras are those of the photos.
        photos: (H, W, 3) uint8, one per frame.
    """

    def __init__(self, frames: Sequence[Frame], photos: Sequence[np.ndarray]):
        began = time.perf_counter()
        self._frames, self._photos = frames, photos
        self._centres, self._axes = centres_of(frames), views_of(frames)
        # If all cameras are in one place, no length is known, and none is needed.
        self._scale = float(np.median(np.linalg.norm(self._centres - focus_point(frames), axis=1))) or 1.0
        self._mean = np.mean([photo.mean(axis=(0, 1)) for photo in photos], axis=0) / 255.0
        generator = np.random.default_rng(SEED)
        self._sampled = [_sample(*pair, generator) for pair in zip(frames, photos, strict=True)]
        self.distances = np.array([self._fit(index) for index in range(len(frames))])
        self.seconds = time.perf_counter() - began

    def colours(self, frame: Frame, pixels: np.ndarray) -> np.ndarray:
        """Return sRGB (N, 3) in [0, 1] of a view's pixels (N, 2); the mean of all photos where no billboard is hit."""
        bearings, _ = frame.camera.bearings(pixels)
        directions = bearings @ frame.world_from_cam[:3, :3].T
        total, weights = np.zeros((len(pixels), 3)), np.zeros((len(pixels), 1))
        for index in self._nearest(frame)[:BLENDED]:
            rgb, hit, angle = self._seen(index, frame.centre, directions, self.distances[index])
            weight = (hit / (angle**2 + LEAST_ANGLE_RAD**2))[:, None]
            total, weights = total + weight * rgb, weights + weight
        return np.where(weights > 0, total / np.maximum(weights, 1e-300), self._mean)

    def _nearest(self, frame: Frame) -> list[int]:
        """Return the indices of the training views, the most similar to `frame` first, without `frame` itself."""
        away = np.linalg.norm(self._centres - frame.centre, axis=1) / self._scale
        turned = np.arccos(np.clip(self._axes @ frame.world_from_cam[:3, 2], -1.0, 1.0))
        order = np.argsort(away + turned, kind="stable").tolist()
        return [index for index in order if self._frames[index].name != frame.name]

    def _fit(self, index: int) -> float:
        """Fit the distance at which a photo is most similar to its neighbours and enough of their rays hit it."""
        others = self._nearest(self._frames[index])[:FITTED_PHOTOS]
        distances = self._scale * DISTANCES
        errors, hits = np.zeros(len(distances)), np.zeros(len(distances))
        for other in others:
            directions, colours = self._sampled[other]
            # All distances at once, each with all rays: NumPy takes longer to call than for the 400 rays of one.
            rays = len(directions)
            rgb, hit, _ = self._seen(
                index, self._centres[other], np.tile(directions, (len(distances), 1)), np.repeat(distances, rays)
            )
            off = np.square(rgb.reshape(-1, rays, 3) - colours).sum(axis=-1) * hit.reshape(-1, rays)
            errors += off.sum(axis=1)
            hits += hit.reshape(-1, rays).sum(axis=1)
        if not hits.any():
            return float(distances[-1])
        enough = hits >= ENOUGH_HITS * hits.max()
        return float(distances[int(np.argmin(np.where(enough, errors / np.maximum(hits, 1.0), np.inf)))])

    def _seen(
        self, index: int, origin: np.ndarray, directions: np.ndarray, distance: float | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what rays see of a photo's billboard at a distance, or of one at the distance of each ray, (N,):
        colours (N, 3), which rays hit it, and the angles between the rays and the camera's lines of sight, in radians.
        """
        frame = self._frames[index]
        # |from_camera + t * direction| = distance, from inside and on the far side.
        from_camera = origin - frame.centre
        along = directions @ from_camera
        inside = along**2 - from_camera @ from_camera + distance**2
        t = np.sqrt(np.maximum(inside, 0.0)) - along
        points = origin + t[:, None] * directions
        pixels, valid = frame.camera.project(apply(inverse(frame.world_from_cam), points))
        hit = valid & (inside >= 0.0) & (t > 0.0)
        hit &= (pixels >= 0.0).all(axis=-1) & (pixels <= (frame.camera.width, frame.camera.height)).all(axis=-1)
        cosine = np.einsum("nd,nd->n", directions, points - frame.centre) / distance
        return _colours_at(self._photos[index], pixels), hit, np.arccos(np.clip(cosine, -1.0, 1.0))


def _sample(frame: Frame, photo: np.ndarray, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return world directions (N, 3) and colours (N, 3) of random pixels of a photo."""
    pixels = random_pixels(frame, np.ones(photo.shape[:2], dtype=bool), FITTED_PIXELS, generator)
    bearings, valid = frame.camera.bearings(pixels)
    return bearings[valid] @ frame.world_from_cam[:3, :3].T, _colours_at(photo, pixels[valid])


def random_pixels(frame: Frame, used: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Return the centres (N, 2) of N random pixels that count, N = `count` or all if there are fewer."""
    numbers = np.flatnonzero(used)
    chosen = generator.choice(numbers, min(count, len(numbers)), replace=False)
    return np.stack([chosen % frame.camera.width, chosen // frame.camera.width], axis=-1) + 0.5


def _colours_at(photo: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return colours (N, 3) in [0, 1], interpolated between pixel centres; the border is extended outwards."""
    places = pixels.astype(np.float32) - 0.5
    # OpenCV treats lists of positions as pictures with at most 32767 rows.
    parts = [
        cv2.remap(photo, part[:, :1], part[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        for part in np.array_split(places, max(1, -(-len(places) // 2**14)))
    ]
    return np.concatenate(parts) / 255.0


def reduction(frame: Frame) -> float:
    """Return the factor, at least 1, by which a view is reduced for the billboards."""
    return max(1.0, max(frame.camera.width, frame.camera.height) / LONGER_SIDE_PX)


class GeometryComparison:
    """Compares a field with billboards, fitted to the training photos, photo by photo.

    A comparison that fails does not stop the evaluation: `failure` then gives the reason, and there is no shape.
    """

    def __init__(self, billboards: Billboards):
        self._billboards = billboards
        self._generator = np.random.default_rng(SEED + 1)
        self._errors: list[np.ndarray] = []  # of each photo, (parts, 3), as for `gain_error_db`
        self._seconds = billboards.seconds
        self.failure: str | None = None

    def add(self, frame: Frame, rendered: np.ndarray, photo: np.ndarray, used: np.ndarray) -> None:
        """Compare random pixels of a photo (H, W, 3) uint8 with the field's sRGB, reduced as the billboards are."""
        if self.failure is None:
            try:
                self._compare(frame, rendered, photo, used)
            except Exception as error:  # it is auxiliary: the photo's metrics are already measured
                self.failure = reason_of(error)

    def _compare(self, frame: Frame, rendered: np.ndarray, photo: np.ndarray, used: np.ndarray) -> None:
        began = time.perf_counter()
        factor = reduction(frame)
        small = downscale(photo, factor)
        height, width = small.shape[:2]
        frame = replace(frame, camera=frame.camera.resized(width, height))
        counting = downscale(np.where(used, np.uint8(255), np.uint8(0)), factor) == 255
        if not counting.any():
            return
        pixels = random_pixels(frame, counting, COMPARED_PIXELS, self._generator)
        columns, rows = pixels.astype(int).T
        truth = small[rows, columns] / 255.0
        of_field = np.square(downscale(to_8_bit(rendered), factor)[rows, columns] / 255.0 - truth).mean(axis=1)
        of_billboards = np.square(self._billboards.colours(frame, pixels) - truth).mean(axis=1)
        parts = PARTS * (PARTS * rows // height) + PARTS * columns // width
        sums = [np.bincount(parts, weights) for weights in (of_field, of_billboards, None)]
        self._errors.append(np.stack(sums, axis=1))
        self._seconds += time.perf_counter() - began

    def shape(self) -> GeometryEvidence | None:
        """Return the evidence for geometry; None if no photo could be compared or a comparison failed."""
        if not self._errors or self.failure is not None:
            return None
        psnrs = np.array([_psnrs(parts.sum(axis=0)) for parts in self._errors])
        field_psnr, psnr = (float(column.mean()) for column in psnrs.T)
        gain, error = field_psnr - psnr, gain_error_db(self._errors)
        shown = gain > LEAST_GAIN_DB and gain > STANDARD_ERRORS * (error or 0.0)
        return GeometryEvidence(psnr, field_psnr, gain, error, shown, self._seconds)


def gain_error_db(errors: Sequence[np.ndarray]) -> float | None:
    """Return the standard error of the mean gain over photos, in dB: the jackknife over their parts.

    sqrt(sum over photos of (n - 1) / n sum over parts of (g - mean of g)^2) / photos,

    where g is the photo's gain without one of its n parts. Source: Shao and Tu 1995, The Jackknife and Bootstrap,
    chapter 6, with photos as strata.

    Args:
        errors: of each photo, (parts, 3): the squared errors of the field and of the billboards, and the number of
            pixels, summed over each part. Parts without pixels do not count.

    Returns:
        None if no photo has two parts.
    """
    variances = []
    for parts in errors:
        used = parts[parts[:, 2] > 0]
        if len(used) > 1:
            without = np.array([np.subtract(*_psnrs(rest)) for rest in used.sum(axis=0) - used])
            variances.append((len(used) - 1) * float(without.var()))
    return math.sqrt(sum(variances)) / len(errors) if variances else None


def _psnrs(sums: np.ndarray) -> tuple[float, float]:
    """Return the PSNR of the field and of the billboards, dB, from sums of squared errors and of pixels, (3,)."""
    of_field, of_billboards, pixels = sums.tolist()
    return psnr_of(of_field / pixels), psnr_of(of_billboards / pixels)
