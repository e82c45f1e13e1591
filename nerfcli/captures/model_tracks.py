"""Tracks of structure from motion, read from the COLMAP model of a scene.

Held-out photos are not used: only the observations in training photos are read, neither those in held-out photos nor
the 3D positions of points, which depend on them.
"""

from collections.abc import Sequence

import numpy as np

from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.colmap import find_model, parse_colmap
from nerfcli.matching.tracks import Tracks, indices_by_value, world_rays
from nerfcli.photos.loading import LoadedPhoto


def tracks_of_model(scene: Capture, photos: Sequence[LoadedPhoto]) -> Tracks:
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
            frame, own = capture.frames[index], of_frame[index]
            # The loaded photo may be downscaled or rotated: observations are in pixels of the model's own camera.
            rays = world_rays(frame.camera.bearings(seen.pixels[own]), frame.world_from_cam)
            parts.append((np.full(len(own), number), seen.point_index[own], rays))
    return Tracks(*(np.concatenate(column) for column in zip(*parts, strict=True)))
