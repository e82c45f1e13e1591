"""Photos as small pinhole pictures, and semi-global matching of two pictures whose matches are in the same row.

Letters: K is the matrix of a pinhole camera, R its rotation from the scene's axes, rho an inverse depth along the
optical axis. A panorama is six pinhole pictures, the faces of a cube.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.matching.tracks import Tracks
from nerfcli.photos.images import reduced
from nerfcli.photos.loading import WIDEST_DEG, LoadedPhoto, pinhole_of, undistorted

# The fewest points that determine the range of disparities of a pair.
FEWEST_SHARED = 12
BLOCK_PX = 5
# Error of a disparity, pixels: two thirds of the pixels have at most this error.
DISPARITY_ERROR_PX = 0.8


@dataclass(frozen=True)
class View:
    """A photo as a small pinhole picture."""

    grey: np.ndarray  # (h, w) uint8
    shown: np.ndarray  # (h, w) bool
    matrix: np.ndarray  # K, centre of the first pixel at 0 as in OpenCV
    turn: np.ndarray  # R
    centre: np.ndarray
    pinhole: Camera


def view_of(photo: LoadedPhoto, longer_side_px: int) -> View:
    """Reduce a photo and remove its distortion."""
    grey = cv2.cvtColor(np.ascontiguousarray(photo.pixels[..., :3]), cv2.COLOR_RGB2GRAY)
    used = np.full(grey.shape, 255, np.uint8) if photo.used is None else photo.used.astype(np.uint8) * 255
    if photo.pixels.shape[-1] == 4:
        used = np.minimum(used, photo.pixels[..., 3])
    both = np.stack([reduced(part, longer_side_px) for part in (grey, used)], axis=-1)
    small = photo.frame.camera.resized(both.shape[1], both.shape[0])
    pinhole = pinhole_of(small)
    both, seen = undistorted(both, small, pinhole)
    fx, fy, cx, cy = pinhole.params
    turn = photo.frame.world_from_cam[:3, :3].T
    matrix = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    shown = seen & (both[..., 1] == 255)
    return View(np.ascontiguousarray(both[..., 0]), shown, matrix, turn, photo.frame.centre, pinhole)


def per_pixel(matrix: np.ndarray, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Return the three rows of a matrix times (column, row, 1), for all pixels of a picture (h, w), float32."""
    columns, rows = np.arange(shape[1]), np.arange(shape[0])[:, None]
    return [(x * columns + (y * rows + one)).astype(np.float32) for x, y, one in matrix]


def seen_by(
    other: View, view: View, columns: np.ndarray, rows: np.ndarray, rho: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return column and row of the nearest pixel, and the depth times rho, at which another view sees these pixels.

    Args:
        columns, rows: of the pixels of the view.
        rho: their inverse depths.
    """
    turn = (other.matrix @ other.turn @ view.turn.T @ np.linalg.inv(view.matrix)).astype(np.float32)
    move = (other.matrix @ other.turn @ (view.centre - other.centre)).astype(np.float32)
    x, y, z = (a * columns + b * rows + (c + move * rho) for (a, b, c), move in zip(turn, move, strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.rint(x / z), np.rint(y / z), z


def range_of(values: np.ndarray, typical: float) -> tuple[float, float]:
    """Return the range in which to search, from the values (N,) of the points and the typical size of such values."""
    least, most = np.percentile(values, (0.5, 99.5))
    margin = max(0.5 * (most - least), 0.15 * typical)  # surfaces between the points may be nearer or farther
    return least - margin, most + margin


def disparity_count(columns: float) -> int:
    """Return how many disparities to search for a range in columns: a multiple of 16, 256 at most."""
    return 16 * int(np.clip(math.ceil(columns / 16), 1, 16))


def disparities(left: np.ndarray, right: np.ndarray, count: int) -> np.ndarray:
    """Return the disparities (h, w) float32 of the left picture, NaN where the match is ambiguous."""
    squares = BLOCK_PX * BLOCK_PX
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=BLOCK_PX,
        P1=8 * squares,
        P2=32 * squares,
        disp12MaxDiff=1,
        uniquenessRatio=5,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = matcher.compute(left, right).astype(np.float32) / 16.0
    found[found < 0] = np.nan
    return found


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
        """Find the pixels (M, 2) int64 of an original photo that show the same as some pixels of its faces, each once.

        `pixels` are (N_i, 2) int64 columns and rows in each face. Also returns the index (M,) of each in the pixels of
        all faces, one face after another: where two faces show it, that of the first of them.
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
