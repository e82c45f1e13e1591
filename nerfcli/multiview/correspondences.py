"""Correspondences between training photos, computed on first use."""

from collections.abc import Sequence
from functools import cached_property

from nerfcli.multiview.features import Matches
from nerfcli.multiview.tracks import Tracks, tracks_of_matches, tracks_of_model
from nerfcli.multiview.training_matches import LONGER_SIDE_PX, chosen_pairs, match
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.scene import Scene

# What features of a photo take on one thread, and comparing them, for each of the pixels in which they are sought:
# 0.5 to 0.8 us were measured. It decides whether there is time for it, and is no promise.
SECONDS_PER_PIXEL = 0.7e-6


class Shared:
    """Features and 3D points shared by training photos.

    Args:
        scene: may have a COLMAP model.
        photos: to train on.
        threads: that look for features.
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
        """Features of pairs of photos."""
        return match(self._photos, threads=self._threads)

    @cached_property
    def of_model(self) -> Tracks:
        """Points of structure from motion; none where the scene does not give their observations."""
        return tracks_of_model(self._scene, self._photos)

    @cached_property
    def of_matches(self) -> Tracks:
        """Points of matched features."""
        return tracks_of_matches(self._photos, self.matched)

    @property
    def tracks(self) -> Tracks:
        """The best there are."""
        return self.of_model if self.of_model.count else self.of_matches
