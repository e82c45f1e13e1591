"""Evidence for a convention: by how many pixels photos and cameras contradict each other.

Each kind of evidence computes one error for every item, from the poses and from the viewing directions of pixels, which
depend only on the intrinsics. An item behind a camera has an infinite error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Capture
from nerfcli.convert.axes import for_picture, shifted
from nerfcli.convert.probes import distinct, rows_of_each
from nerfcli.multiview.epipolar import sampson_angles
from nerfcli.multiview.features import Matches

# Most observations used: enough for a median, few enough to try hundreds of hypotheses.
_MOST_OBSERVATIONS = 20_000
_MOST_FRAMES = 60

# The rays of a match must be this far from parallel for their distances to the intersection to be meaningful.
_LEAST_PARALLAX_PX = 3.0


@dataclass(frozen=True)
class Intrinsics:
    """A hypothesis about intrinsics: see `Convention`."""

    scale: float = 1.0
    pixel_centre: float = 0.5


class ObservationEvidence:
    """Observations of world points in photos.

    The error of an observation is the angle between the viewing direction of its pixel and the direction to its point,
    times the focal length.
    """

    threshold_px = 4.0

    def __init__(self, capture: Capture):
        seen = capture.observations
        assert seen is not None
        rows = np.flatnonzero(seen.point_index >= 0)
        if len(rows) > _MOST_OBSERVATIONS:
            rows = np.sort(np.random.default_rng(0).choice(rows, _MOST_OBSERVATIONS, replace=False))
        self.groups = seen.frame_index[rows]
        self._points = capture.points[seen.point_index[rows]]
        self._pixels = seen.pixels[rows]
        self._cameras = [frame.camera for frame in capture.frames]
        self.name = f"{len(rows)} observations of points in {len(np.unique(self.groups))} photos"

    def directions(self, intrinsics: Intrinsics) -> tuple[np.ndarray, ...]:
        """Return the unit viewing directions of the pixels, (M, 3), their validity and their pixels per radian."""
        return _directions(self._cameras, self.groups, self._pixels, intrinsics)

    def errors_px(self, directions: tuple[np.ndarray, ...], world_from_cam: np.ndarray) -> np.ndarray:
        """Return the error of each observation, (M,)."""
        seen, valid, focal_px = directions
        cam_from_world = rigid.inverse(world_from_cam)[self.groups]
        towards = np.einsum("mij,mj->mi", cam_from_world[:, :3, :3], self._points) + cam_from_world[:, :3, 3]
        angle = np.arctan2(np.linalg.norm(np.cross(seen, towards), axis=1), np.einsum("mi,mi->m", seen, towards))
        # A point 90 degrees or more off its pixel's direction counts as behind the camera, for wide cameras too.
        return np.where(valid & (angle < np.pi / 2), focal_px * angle, np.inf)


class MatchEvidence:
    """Matches, points that two photos both show.

    The error of a match is its Sampson distance to the epipolar geometry of the two poses, as an angle times the focal
    length.
    """

    threshold_px = 4.0

    def __init__(self, pairs: Sequence[Matches], cameras: dict[int, Camera], num_frames: int):
        self.groups = np.repeat(np.arange(len(pairs)), [len(pair.pixels[0]) for pair in pairs])
        self._pairs = np.array([pair.photos for pair in pairs]).T
        self._first, self._second = self._pairs[:, self.groups]
        self._first_pixels = np.concatenate([pair.pixels[0] for pair in pairs])
        self._second_pixels = np.concatenate([pair.pixels[1] for pair in pairs])
        stand_in = next(iter(cameras.values()))
        self._cameras = [cameras.get(index, stand_in) for index in range(num_frames)]
        self.name = f"{len(self.groups)} SIFT matches in {len(pairs)} pairs of photos"

    def directions(self, intrinsics: Intrinsics) -> tuple[np.ndarray, ...]:
        """Return unit viewing directions of both pixels of each match, (M, 3) twice, validity, pixels per radian."""
        first, valid1, focal1 = _directions(self._cameras, self._first, self._first_pixels, intrinsics)
        second, valid2, focal2 = _directions(self._cameras, self._second, self._second_pixels, intrinsics)
        return first, second, valid1 & valid2, (focal1 + focal2) / 2

    def errors_px(self, directions: tuple[np.ndarray, ...], world_from_cam: np.ndarray) -> np.ndarray:
        """Return the error of each match, (M,)."""
        first, second, valid, focal_px = directions
        firsts, seconds = self._pairs
        second_from_first = (rigid.inverse(world_from_cam[seconds]) @ world_from_cam[firsts])[self.groups]
        rotation, t = second_from_first[:, :3, :3], second_from_first[:, :3, 3]
        sampson, behind = sampson_angles(first, second, rotation, t)
        turned = np.einsum("mij,mj->mi", rotation, first)  # the first direction in the second camera's axes
        parallax = np.linalg.norm(np.cross(turned, second), axis=1) * focal_px > _LEAST_PARALLAX_PX
        return np.where(valid & ~(behind & parallax) & np.isfinite(sampson), focal_px * sampson, np.inf)


class FrustumEvidence:
    """Visibility of scene points, of which each photo should show some: the error is 0 for a visible point.

    It determines axes and directions, but not intrinsics: the wider the pictures, the more points they show.
    """

    threshold_px = 0.0

    def __init__(self, capture: Capture):
        rng = np.random.default_rng(0)
        frames = np.unique(np.linspace(0, len(capture.frames) - 1, _MOST_FRAMES).round().astype(int))
        chosen = rng.choice(len(capture.points), min(len(capture.points), 300), replace=False)
        self.groups = np.repeat(frames, len(chosen))
        self._points = np.tile(capture.points[chosen], (len(frames), 1))
        self._cameras = [frame.camera for frame in capture.frames]
        self.name = f"the visibility of {len(chosen)} points in {len(frames)} photos"

    def errors_px(self, world_from_cam: np.ndarray) -> np.ndarray:
        """Return 0 or infinity for each pair of a photo and a point, (M,)."""
        cam_from_world = rigid.inverse(world_from_cam)[self.groups]
        in_camera = np.einsum("mij,mj->mi", cam_from_world[:, :3, :3], self._points) + cam_from_world[:, :3, 3]
        cameras, camera_of_frame = distinct(self._cameras)
        shown = np.zeros(len(self.groups), dtype=bool)
        for camera, rows in zip(cameras, rows_of_each(camera_of_frame[self.groups], len(cameras)), strict=True):
            shown[rows] = camera.shows(in_camera[rows])
        return np.where(shown, 0.0, np.inf)


def _directions(
    cameras: Sequence[Camera], frame_index: np.ndarray, pixels: np.ndarray, intrinsics: Intrinsics
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the unit viewing directions (M, 3) of pixels of frames, their validity, and pixels per radian."""
    each, camera_of_frame = distinct(cameras)
    directions, valid = np.zeros((len(pixels), 3)), np.zeros(len(pixels), dtype=bool)
    focal_px = np.zeros(len(pixels))
    for camera, rows in zip(each, rows_of_each(camera_of_frame[frame_index], len(each)), strict=True):
        corrected = for_picture(shifted(camera, 0.5 - intrinsics.pixel_centre), intrinsics.scale)
        directions[rows], valid[rows] = corrected.bearings(pixels[rows])
        focal_px[rows] = corrected.focal_px
    return directions, valid, focal_px
