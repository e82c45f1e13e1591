"""Six pinhole pictures of each panorama, the faces of a cube, for methods that need pinhole pictures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.matching.tracks import Tracks
from nerfcli.photos.loading import WIDEST_DEG, LoadedPhoto

# Rotations panorama_from_face: front, right, back, left, up, down.
_TURNS = np.array(
    [
        *([[c, 0, s], [0, 1, 0], [-s, 0, c]] for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))),
        *([[1, 0, 0], [0, 0, s], [0, -s, 0]] for s in (-1, 1)),
    ],
    dtype=np.float64,
)
FACES = len(_TURNS)


@dataclass(frozen=True)
class Faces:
    """Photos with the faces of each panorama in turn in its place, and for each original the index of its first one."""

    photos: list[LoadedPhoto]
    first: np.ndarray
    originals: Sequence[LoadedPhoto]

    @classmethod
    def of(cls, originals: Sequence[LoadedPhoto]) -> "Faces":
        """Make the faces of all panoramas among some photos."""
        photos: list[LoadedPhoto] = []
        first = []
        for photo in originals:
            first.append(len(photos))
            spherical = photo.frame.camera.is_spherical
            photos += [_face(photo, turn) for turn in _TURNS] if spherical else [photo]
        return cls(photos, np.array(first, dtype=np.int64), originals)

    def tracks(self, tracks: Tracks) -> Tracks:
        """Return the sightings of the original photos as those of the first of their faces, which has their centre."""
        return replace(tracks, photos=self.first[tracks.photos])

    def own(self, number: int) -> slice:
        """Return which of `photos` stand for an original photo."""
        count = FACES if self.originals[number].frame.camera.is_spherical else 1
        return slice(self.first[number], self.first[number] + count)

    def joined(self, number: int, pixels: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Find the pixels of an original photo that show the same as some pixels of its faces.

        Args:
            number: of the photo.
            pixels: (N_i, 2) int64 column and row in each of its faces.

        Returns:
            pixels (M, 2) int64 of the photo, each once; index (M,) of each in the pixels of all faces, one face after
            another: where two faces show it, that of the first of them.
        """
        camera = self.originals[number].frame.camera
        if not camera.is_spherical:
            return pixels[0], np.arange(len(pixels[0]))
        places = []
        for face, turn, own in zip(self.photos[self.own(number)], _TURNS, pixels, strict=True):
            directions, _ = face.frame.camera.bearings(own + 0.5)
            places.append(_places(camera, directions, turn))
        whole = np.minimum(np.floor(np.concatenate(places)).astype(np.int64), (camera.width - 1, camera.height - 1))
        _, index = np.unique(whole @ (1, camera.width), return_index=True)
        return whole[index], index


def _places(camera: Camera, directions: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return where directions (N, 3) of a face are in the panorama, (N, 2); the very poles, at any longitude."""
    return camera.project(directions @ turn.T + 1e-9)[0]


def _face(photo: LoadedPhoto, turn: np.ndarray) -> LoadedPhoto:
    """Return a face of a panorama, at the panorama's resolution in the middle."""
    camera = photo.frame.camera
    focal_px = camera.width / (2 * math.pi)
    side = max(1, round(2 * focal_px * math.tan(math.radians(WIDEST_DEG / 2))))  # neighbouring faces overlap
    pinhole = Camera.pinhole(side, side, focal_px)
    directions, _ = pinhole.pixel_bearings()
    # The centre of the first pixel is at 0.5 here and at 0 in OpenCV.
    x, y = (_places(camera, directions, turn) - 0.5).astype(np.float32).T.reshape(2, side, side)
    y = np.clip(y, 0, camera.height - 1)  # only the left and the right edge are neighbours
    pixels = cv2.remap(photo.pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    used = None
    if photo.used is not None:
        used = cv2.remap(photo.used.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_WRAP) > 0
    world_from_face = photo.frame.world_from_cam.copy()
    world_from_face[:3, :3] = world_from_face[:3, :3] @ turn
    return LoadedPhoto(replace(photo.frame, camera=pinhole, world_from_cam=world_from_face), pixels, used)
