"""Tracks: which training photos saw which points. Those of structure from motion: `captures.model_tracks`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.matching.features import Matches
from nerfcli.photos.loading import LoadedPhoto


@dataclass(frozen=True)
class Tracks:
    """Sightings of points.

    Args:
        photos: (O,) int64, the index of the photo of each sighting.
        points: (O,) int64, the index of its point, from 0 on.
        rays: (O, 3) unit directions from the photo's camera, in the scene's frame; NaN where the lens has no ray.
    """

    photos: np.ndarray
    points: np.ndarray
    rays: np.ndarray

    @property
    def count(self) -> int:
        """Number of points."""
        return int(self.points.max(initial=-1)) + 1


def tracks_of_matches(photos: Sequence[LoadedPhoto], matched: Sequence[Matches]) -> Tracks:
    """Return matches as tracks, with a point seen by two photos for each match; some are wrong."""
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))]
    first = 0
    for matches in matched:
        points = first + np.arange(len(matches.pixels[0]))
        first += len(points)
        for number, pixels in zip(matches.photos, matches.pixels, strict=True):
            frame = photos[number].frame
            parts.append(
                (np.full(len(points), number), points, world_rays(frame.camera.bearings(pixels), frame.world_from_cam))
            )
    return Tracks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def indices_by_value(numbers: np.ndarray, count: int) -> list[np.ndarray]:
    """Return the positions of each number from 0 to count - 1, in increasing order; other numbers are ignored."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.searchsorted(numbers[order], np.arange(count + 1)))[1:-1]


def world_rays(bearings: tuple[np.ndarray, np.ndarray], world_from_cam: np.ndarray) -> np.ndarray:
    """Return rays (N, 3) in the scene's frame of bearings (N, 3) and their validity (N,); NaN where not valid."""
    return np.where(bearings[1][:, None], bearings[0], np.nan) @ world_from_cam[:3, :3].T
