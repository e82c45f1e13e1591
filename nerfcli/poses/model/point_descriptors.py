"""Descriptors of a model's points, from the photos that see them, and their matches with the features of a photo."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from nerfcli.poses.model.projection import Array

Indices = NDArray[np.int64]

# Largest distance of a point from its predicted position, as a fraction of the longer side, and at least in pixels.
_TOLERANCE_FRACTION, _LEAST_TOLERANCE_PX = 0.004, 3.0
# A vote counts if the ratio of its distance to that of the nearest other point is below this.
_RATIO = 0.9
# A feature at the predicted position of a point is that point if their descriptors of length 1 are nearer than this.
ALIKE = 0.5
# Features compared at a time.
BLOCK = 256


@dataclass(frozen=True)
class KnownPoints:
    """A model's points: ids (points,), positions `places` (points, 3), and descriptors of length 1.

    of: (descriptors,) index of the point, ascending. photos: (descriptors,) id of the image.
    """

    ids: Indices
    places: Array
    descriptors: NDArray[np.float32]
    of: Indices
    photos: Indices


@dataclass(frozen=True)
class PhotoFeatures:
    """A photo to be located: its camera, and its features with descriptors of length 1."""

    image_id: int
    camera: pycolmap.Camera
    pixels: Array
    descriptors: NDArray[np.float32]

    @property
    def tolerance_px(self) -> float:
        """Largest distance at which a point may be seen from its predicted position."""
        return max(_TOLERANCE_FRACTION * max(self.camera.width, self.camera.height), _LEAST_TOLERANCE_PX)


def known_points(model: pycolmap.Reconstruction, database: pycolmap.Database) -> KnownPoints:
    """Return the points of a model with their descriptors."""
    ids = np.array(sorted(model.point3D_ids()), dtype=np.int64)
    most = max(1, 150_000 // max(len(ids), 1))  # more take time and memory
    features: dict[int, tuple[list[int], list[int]]] = {}  # by photo: features, and their points
    for index, point_id in enumerate(ids):
        for element in model.point3D(int(point_id)).track.elements[:most]:
            numbers, points = features.setdefault(element.image_id, ([], []))
            numbers.append(element.point2D_idx)
            points.append(index)
    photos = sorted(features)
    of = np.concatenate([np.array(features[photo][1], dtype=np.int64) for photo in photos])
    order = np.argsort(of, kind="stable")
    return KnownPoints(
        ids,
        np.array([model.point3D(int(point_id)).xyz for point_id in ids]).reshape(-1, 3),
        np.concatenate([_descriptors(database, photo)[features[photo][0]] for photo in photos])[order],
        of[order],
        np.repeat(np.array(photos, dtype=np.int64), [len(features[photo][1]) for photo in photos])[order],
    )


def photo_features(model: pycolmap.Reconstruction, database: pycolmap.Database, image_id: int) -> PhotoFeatures | None:
    """Return the features of a photo; None if neither EXIF nor placed photos give its focal length."""
    camera_id = database.read_image(image_id).camera_id
    in_use = {model.image(placed).camera_id for placed in model.reg_image_ids()}
    camera = model.camera(camera_id) if camera_id in in_use else database.read_camera(camera_id)
    if camera_id not in in_use and not camera.has_prior_focal_length:
        return None
    pixels = np.asarray(database.read_keypoints(image_id), dtype=np.float64)[:, :2]
    return PhotoFeatures(image_id, camera, pixels, _descriptors(database, image_id))


def resembling(photo: PhotoFeatures, descriptors: NDArray[np.float32]) -> int:
    """Count the features of a photo that look like one of some descriptors (n, 128)."""
    if not len(descriptors):
        return 0
    alike = 1 - ALIKE**2 / 2  # the cosine at this distance
    found = 0
    for start in range(0, len(photo.descriptors), BLOCK):
        found += int(((photo.descriptors[start : start + BLOCK] @ descriptors.T).max(axis=1) > alike).sum())
    return found


def votes(photo: PhotoFeatures, model_points: KnownPoints) -> tuple[Indices, Indices]:
    """Return features and the points that they vote for, each point once."""
    nearest = np.empty(len(photo.pixels), dtype=np.int64)
    ratios = np.empty(len(nearest))
    for start in range(0, len(nearest), BLOCK):
        alike = photo.descriptors[start : start + BLOCK] @ model_points.descriptors.T  # (block, descriptors)
        rows = np.arange(len(alike))
        best = alike.argmax(axis=1)
        points, cosine = model_points.of[best], alike[rows, best]
        own = (np.searchsorted(model_points.of, points, side=side) for side in ("left", "right"))
        for row, first, end in zip(alike, *own, strict=True):
            row[first:end] = -1.0
        second = alike.max(axis=1)
        block = slice(start, start + len(alike))
        nearest[block] = points
        ratios[block] = np.sqrt(np.maximum(2 - 2 * cosine, 0) / np.maximum(2 - 2 * second, 1e-12))
    features = np.flatnonzero(ratios < _RATIO)
    features = features[np.argsort(ratios[features], kind="stable")]
    _, first = np.unique(nearest[features], return_index=True)
    features = features[np.sort(first)][:600]
    return features, nearest[features]


def _descriptors(database: pycolmap.Database, image_id: int) -> NDArray[np.float32]:
    """Return descriptors of length 1."""
    found = np.asarray(database.read_descriptors(image_id).data, dtype=np.float32)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1.0)
