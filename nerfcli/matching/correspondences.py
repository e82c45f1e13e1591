"""Features that training photos have in common, and points that they see, computed on first use.

They show the geometry of a capture before any training: where surfaces are, and whether the focal lengths are right.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.layout import centres_of, views_of
from nerfcli.matching.features import Features, Matches, find_features, mutual_matches
from nerfcli.matching.tracks import SAME_SIDE_COS, Tracks, tracks_of_matches
from nerfcli.photos.loading import LoadedPhoto

# Photos are reduced to this longer side to find features, so that it takes seconds.
LONGER_SIDE_PX = 600


class SharedFeatures:
    """Features and points that training photos share; `model_tracks` reads those of structure from motion, if any."""

    def __init__(self, photos: Sequence[LoadedPhoto], model_tracks: Callable[[], Tracks], *, threads: int):
        self._photos, self._model_tracks, self._threads = photos, model_tracks, threads

    @property
    def matching_seconds(self) -> float:
        """Estimated time of `matched`; 0 if it is already computed."""
        if "matched" in self.__dict__:
            return 0.0
        wanted = {index for pair in chosen_pairs(self._photos) for index in pair}
        sides = [self._photos[index].pixels.shape[:2] for index in wanted]
        pixels = [height * width * min(1.0, LONGER_SIDE_PX / max(height, width)) ** 2 for height, width in sides]
        return 0.7e-6 * sum(pixels) / self._threads  # on one thread, a pixel takes 0.5 to 0.8 us

    @cached_property
    def matched(self) -> tuple[Matches, ...]:
        """Matched features of pairs of photos."""
        return match(self._photos, threads=self._threads)

    @cached_property
    def of_model(self) -> Tracks:
        """Tracks from structure from motion; empty where the scene does not have the observations."""
        return self._model_tracks()

    @cached_property
    def of_matches(self) -> Tracks:
        """Tracks from matched features."""
        return tracks_of_matches(self._photos, self.matched)

    @property
    def tracks(self) -> Tracks:
        """Tracks from structure from motion, or from matched features where there are none."""
        return self.of_model if self.of_model.count else self.of_matches


def match(photos: Sequence[LoadedPhoto], *, threads: int) -> tuple[Matches, ...]:
    """Match the features of `chosen_pairs`; return the pairs that have matches."""
    pairs = chosen_pairs(photos)
    wanted = sorted({index for pair in pairs for index in pair})
    own_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # each thread processes a photo: no more threads than requested
    try:
        with ThreadPoolExecutor(max(1, threads)) as pool:
            features = dict(zip(wanted, pool.map(lambda index: _features(photos[index]), wanted), strict=True))

            def in_common(pair: tuple[int, int]) -> Matches:
                one, other = (features[index] for index in pair)
                a, b = mutual_matches(one.descriptors, other.descriptors)
                return Matches(pair, (one.pixels[a], other.pixels[b]))

            return tuple(matches for matches in pool.map(in_common, pairs) if len(matches.pixels[0]))
    finally:
        cv2.setNumThreads(own_threads)


def chosen_pairs(photos: Sequence[LoadedPhoto]) -> list[tuple[int, int]]:
    """Return pairs of photos that look about the same way from different places."""
    frames = [photo.frame for photo in photos]
    centres, views = centres_of(frames), views_of(frames)
    pairs: set[tuple[int, int]] = set()
    for index in np.unique(np.linspace(0, len(frames) - 1, 16).round().astype(int)):
        baselines = np.linalg.norm(centres - centres[index], axis=1)
        candidates = np.flatnonzero((views @ views[index] > SAME_SIDE_COS) & (baselines > 0))
        candidates = candidates[np.argsort(baselines[candidates], kind="stable")]
        for place in (1, 3, 9):  # near photos have the most in common, far ones constrain the geometry the most
            if place <= len(candidates):
                other = int(candidates[place - 1])
                pairs.add((min(int(index), other), max(int(index), other)))
    return sorted(pairs)


def _features(photo: LoadedPhoto) -> Features:
    grey = cv2.cvtColor(np.ascontiguousarray(photo.pixels[..., :3]), cv2.COLOR_RGB2GRAY)
    return find_features(grey, longer_side_px=LONGER_SIDE_PX, most=1500, used=photo.used)


def radians_per_pixel(camera: Camera) -> float:
    """Return the angle of a pixel at the size used for feature extraction."""
    return float(np.radians(max(camera.fov_deg))) / min(LONGER_SIDE_PX, max(camera.width, camera.height))
