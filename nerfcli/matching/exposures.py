"""Exposures of photos, estimated from the ratio of light at pixels that show the same point."""

from collections.abc import Sequence

import cv2
import numpy as np

from nerfcli.cameras.rigid import apply, inverse
from nerfcli.matching.graph import connected_groups, potentials
from nerfcli.matching.stereo import CONSISTENT, DenseDepth
from nerfcli.photos.colours import linear_light
from nerfcli.photos.loading import LoadedPhoto

# Only levels between these are used.
DARKEST, BRIGHTEST = 20, 240
# Fewer common pixels do not tell the difference of two photos' exposures.
FEWEST_PIXELS = 50


def matched_log_gains(photos: Sequence[LoadedPhoto], dense: Sequence[DenseDepth]) -> np.ndarray:
    """Estimate the logarithms (P, 3) of the gains of photos in linear light, per channel, with mean 0.

    They fit the log ratios of pairs, medians over their common pixels, by least absolute errors. NaN for photos that
    share too little with the others to be compared.
    """
    levels = [np.ascontiguousarray(photo.pixels[..., :3]) for photo in photos]
    # Averaged, so that misalignments by a pixel hardly matter.
    around = [cv2.blur(pixels, (3, 3)) for pixels in levels]
    maps = []
    for photo, depth in zip(photos, dense, strict=True):
        distances = np.full(photo.pixels.shape[:2], np.nan, np.float32)
        distances[depth.pixels[:, 1], depth.pixels[:, 0]] = depth.distances
        maps.append(distances)
    centres = np.array([photo.frame.centre for photo in photos])
    pairs, ratios, counts = [], [], []
    generator = np.random.default_rng(0)
    for one, (photo, depth) in enumerate(zip(photos, dense, strict=True)):
        chosen = generator.permutation(len(depth.pixels))[:2000]
        pixels, points = depth.pixels[chosen], depth.points(photo.frame, chosen)
        apart = np.linalg.norm(centres - centres[one], axis=1)
        for other in np.argsort(apart, kind="stable")[1:13].tolist():  # the nearest twelve
            second = photos[other]
            camera = second.frame.camera
            away = np.linalg.norm(points - second.frame.centre, axis=1)
            places, seen = camera.project(apply(inverse(second.frame.world_from_cam), points))
            seen &= camera.contains(places)
            column, row = np.where(seen[:, None], places, 0).astype(np.int64).T
            with np.errstate(invalid="ignore"):
                seen &= np.abs(maps[other][row, column] / np.maximum(away, 1e-12) - 1.0) < CONSISTENT
            both = np.concatenate([levels[one][pixels[:, 1], pixels[:, 0]], levels[other][row, column]], axis=1)
            seen &= ((both > DARKEST) & (both < BRIGHTEST)).all(1)
            if seen.sum() < FEWEST_PIXELS:
                continue
            own, theirs = around[one][pixels[seen, 1], pixels[seen, 0]], around[other][row[seen], column[seen]]
            pairs.append((one, other))
            ratios.append(np.median(np.log(_light(theirs) / _light(own)), axis=0))
            counts.append(min(int(seen.sum()), 500))  # errors of neighbouring pixels are correlated
    return _gains(len(photos), np.array(pairs).reshape(-1, 2), np.array(ratios).reshape(-1, 3), np.array(counts))


def _light(levels: np.ndarray) -> np.ndarray:
    """Return the linear light of levels of 255; not 0, so that logarithms are finite."""
    return linear_light(np.maximum(levels / 255.0, 1e-3))


def _gains(count: int, pairs: np.ndarray, ratios: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fit log gains (count, 3) to log ratios (N, 3) of pairs (N, 2); NaN outside the largest connected group."""
    gains = np.full((count, 3), np.nan)
    group = connected_groups(range(count), pairs.tolist())[0] if count else []
    if len(group) < 2:
        return gains
    for channel, ratio in enumerate(ratios.T):
        found, _ = potentials(count, pairs, ratio, trust=weights, usual_error=0.01)
        gains[group, channel] = found[group] - found[group].mean()
    return gains
