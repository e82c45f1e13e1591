"""Depth supervision: 3D points seen by several photos."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.rigid import Similarity, apply, inverse
from nerfcli.matching.stereo import DenseDepth
from nerfcli.matching.tracks import Tracks, indices_by_value, triangulate
from nerfcli.training.pool import PixelBatch, PixelPool

# One pixel at a known distance is drawn per this many other pixels.
PIXELS_PER_POINT = 8
# Reprojection error at which a point has half the weight, in pixels of the training photo.
HALF_ERROR_PX = 1.0
# Expected relative error of a stereo distance at which its pixel has half the weight.
HALF_ERROR = 0.05


@dataclass(frozen=True)
class PointDepths:
    """Pixels at known distances: M of them.

    Args:
        numbers: (M,) int64, pixels of the pool.
        distances: (M,) along their rays, training frame.
        trust: (M,) in (0, 1].
    """

    numbers: Tensor
    distances: Tensor
    trust: Tensor

    def among(self, pool: PixelPool) -> "PointDepths":
        """Select the pixels that are usable in a pool."""
        return self._chosen(pool.is_usable(self.numbers))

    def joined(self, other: "PointDepths") -> "PointDepths":
        """Return the pixels of both."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return PointDepths(*(torch.cat(pair) for pair in pairs))

    def draw(self, count: int, generator: torch.Generator) -> "PointDepths":
        """Draw `count` of these pixels at random, with replacement."""
        device = self.numbers.device
        return self._chosen(torch.randint(len(self.numbers), (count,), generator=generator, device=device))

    def _chosen(self, which: Tensor) -> "PointDepths":
        return PointDepths(self.numbers[which], self.distances[which], self.trust[which])


class PointRays:
    """Pixels at known distances that are added to each step.

    Args:
        sets: of pixels; the same number is drawn from each set, whatever its size. Empty sets are dropped.
    """

    def __init__(self, sets: Sequence[PointDepths], pool: PixelPool):
        self.sets = [depths for depths in sets if len(depths.numbers)]
        self._pool = pool

    def added_to(self, drawn: PixelBatch, generator: torch.Generator) -> PixelBatch:
        """Append pixels at known distances to those in `drawn`. Their colours count like all others."""
        count = max(1, len(drawn.numbers) // PIXELS_PER_POINT // len(self.sets))
        chosen = reduce(PointDepths.joined, [depths.draw(count, generator) for depths in self.sets])
        both = self._pool.rays_of(torch.cat([drawn.numbers, chosen.numbers]))
        return both._replace(distances=chosen.distances, trust=chosen.trust)


def point_depths(tracks: Tracks, pool: PixelPool, training_from_scene: Similarity) -> PointDepths:
    """Return the usable pixels that see a triangulated point; empty if there are none.

    trust = 1 / (1 + (reprojection error / 1 px)^2), in pixels of the training photos

    Args:
        tracks: of features in the pool's photos.
    """
    surface = triangulate(pool.frames, tracks)
    kept = np.flatnonzero(np.isfinite(surface.misses_px))
    numbers = np.full(len(kept), -1)
    by_photo = indices_by_value(tracks.photos[kept], len(pool.frames))
    for photo, (frame, own) in enumerate(zip(pool.frames, by_photo, strict=True)):
        points = surface.points[tracks.points[kept[own]]]
        pixels, valid = frame.camera.project(apply(inverse(frame.world_from_cam), points))
        width, height = frame.camera.width, frame.camera.height
        shown = valid & (pixels >= 0).all(1) & (pixels < (width, height)).all(1)
        column, row = np.floor(pixels[shown]).astype(np.int64).T
        numbers[own[shown]] = int(pool.first_pixel[photo]) + row * width + column
    inside = numbers >= 0
    kept = kept[inside]
    centres = np.array([frame.centre for frame in pool.frames])[tracks.photos[kept]]
    distances = np.linalg.norm(surface.points[tracks.points[kept]] - centres, axis=1) * training_from_scene.scale
    trust = 1.0 / (1.0 + (surface.misses_px[kept] / HALF_ERROR_PX) ** 2)
    return _usable(numbers[inside], distances, trust, pool=pool)


def stereo_depths(dense: Sequence[DenseDepth], pool: PixelPool, training_from_scene: Similarity) -> PointDepths:
    """Return the usable pixels of a pool whose depth is known from stereo matching.

    trust = 1 / (1 + (error / 5 %)^2)

    Args:
        dense: the stereo depths of each photo of the pool.
    """
    widths = [frame.camera.width for frame in pool.frames]
    firsts = pool.first_pixel.tolist()
    numbers = [first + depth.pixels @ (1, width) for first, width, depth in zip(firsts, widths, dense, strict=True)]
    distances = np.concatenate([depth.distances for depth in dense]) * training_from_scene.scale
    trust = 1.0 / (1.0 + np.square(np.concatenate([depth.errors for depth in dense]) / HALF_ERROR))
    return _usable(np.concatenate(numbers), distances, trust, pool=pool)


def _usable(numbers: np.ndarray, distances: np.ndarray, trust: np.ndarray, *, pool: PixelPool) -> PointDepths:
    device = pool.colours.device
    known = (torch.from_numpy(values).to(device, torch.float32) for values in (distances, trust))
    return PointDepths(torch.from_numpy(numbers).to(device), *known).among(pool)
