"""Correspondences between training photos, computed on first use."""

from collections.abc import Sequence
from functools import cached_property

from nerfcli.multiview.features import Matches
from nerfcli.multiview.tracks import Tracks, tracks_of_matches, tracks_of_model
from nerfcli.multiview.training_matches import LONGER_SIDE_PX, chosen_pairs, match
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.scene import Scene

# Time on one thread to find and match features, per pixel of the photos that are searched: 0.5 to 0.8 us were measured.
# It only serves to decide whether there is enough time.
SECONDS_PER_PIXEL = 0.7e-6


class SharedFeatures:
    """Features and 3D points shared by training photos.

    Args:
        scene: may have a COLMAP model.
        photos: the training photos.
        threads: number of threads that find and match features.
    """

    def __init__(self, scene: Scene, photos: Sequence[LoadedPhoto], *, threads: int):
        self._scene, self._photos, self._threads = scene, photos, threads

    @property
    def matching_seconds(self) -> float:
        """Estimated time of `matched`; 0 if it is already computed."""
        if "matched" in self.__dict__:
            return 0.0
        wanted = {index for pair in chosen_pairs(self._photos) for index in pair}
        sides = [self._photos[index].pixels.shape[:2] for index in wanted]
        pixels = [height * width * min(1.0, LONGER_SIDE_PX / max(height, width)) ** 2 for height, width in sides]
        return SECONDS_PER_PIXEL * sum(pixels) / self._threads

    @cached_property
    def matched(self) -> tuple[Matches, ...]:
        """Matched features of pairs of photos."""
        return match(self._photos, threads=self._threads)

    @cached_property
    def of_model(self) -> Tracks:
        """Tracks from structure from motion; empty where the scene does not have the observations."""
        return tracks_of_model(self._scene, self._photos)

    @cached_property
    def of_matches(self) -> Tracks:
        """Tracks from matched features."""
        return tracks_of_matches(self._photos, self.matched)

    @property
    def tracks(self) -> Tracks:
        """Tracks from structure from motion, or from matched features where there are none."""
        return self.of_model if self.of_model.count else self.of_matches
