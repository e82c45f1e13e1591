"""Tracks: which training photos saw which points, from structure from motion or from matched features.

Held-out photos are not used: only the observations in training photos are read from structure from motion, neither
those in held-out photos nor the 3D positions of points, which depend on them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras.formats.colmap import parse_colmap
from nerfcli.cameras.formats.finding import find_model
from nerfcli.multiview.features import Matches
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.scene import Scene


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


def tracks_of_model(scene: Scene, photos: Sequence[LoadedPhoto]) -> Tracks:
    """Return the observations of these photos in the scene's COLMAP model; empty without such a model."""
    folder = find_model(scene.root)
    capture = parse_colmap(folder) if folder is not None else None
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))]
    if capture is not None and capture.observations is not None:
        seen = capture.observations
        index_of = {frame.name: index for index, frame in enumerate(capture.frames)}
        of_frame = indices_by_value(np.where(seen.point_index >= 0, seen.frame_index, -1), len(capture.frames))
        for number, photo in enumerate(photos):
            index = index_of.get(photo.frame.name)
            if index is None:
                continue
            own = of_frame[index]
            # The loaded photo may be downscaled or rotated: observations are in pixels of the model's own camera.
            rays = _rays(capture.frames[index].camera.bearings(seen.pixels[own]), capture.frames[index].world_from_cam)
            parts.append((np.full(len(own), number), seen.point_index[own], rays))
    return Tracks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


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
                (np.full(len(points), number), points, _rays(frame.camera.bearings(pixels), frame.world_from_cam))
            )
    return Tracks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def indices_by_value(numbers: np.ndarray, count: int) -> list[np.ndarray]:
    """Return the positions of each number from 0 to count - 1, in increasing order; other numbers are ignored."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.searchsorted(numbers[order], np.arange(count + 1)))[1:-1]


def _rays(bearings: tuple[np.ndarray, np.ndarray], world_from_cam: np.ndarray) -> np.ndarray:
    """Return rays (N, 3) in the scene's frame of bearings (N, 3) and their validity (N,); NaN where not valid."""
    return np.where(bearings[1][:, None], bearings[0], np.nan) @ world_from_cam[:3, :3].T
