"""Evidence for a convention: by how many pixels photos, their matches and cameras contradict each other.

Each kind of evidence computes one error for every item, from the poses and from the viewing directions of pixels, which
depend only on the intrinsics. An item behind a camera has an infinite error.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.axes import Convention, for_picture
from nerfcli.captures.capture import Capture
from nerfcli.captures.orientation import resized_for
from nerfcli.matching.agreement import agreement, fundamental_matrix, rays_of
from nerfcli.matching.features import Features, Matches, find_features, mutual_matches
from nerfcli.photos.images import read_image

# The longer side of the photos in which features are detected: a larger one finds better features, but takes longer.
LONGER_SIDE_PX = 1000
# Fraction of the longer side by which matched features should move: less is explained by any poses.
LEAST_MOVE = 0.04

# Fewer matches than this may agree on a common epipolar geometry by chance.
_LEAST_MATCHES = 20
_EPIPOLAR_PX = 2.0
# Most observations used: enough for a median, few enough to try hundreds of hypotheses.
_MOST_OBSERVATIONS = 20_000
# The rays of a match must be this far from parallel for their distances to the intersection to be meaningful.
_LEAST_PARALLAX_PX = 3.0


def match_neighbours(
    frames: tuple[Frame, ...], *, progress: Callable[[float, str], None]
) -> tuple[list[Matches], dict[int, Camera]]:
    """Match photos with later ones in the order of names; return matches and the cameras for the photos' sizes.

    A photo's partner is the next or next but one; or so much later that matched features move by `LEAST_MOVE`, as in a
    video, whose neighbours are too close together for poses to matter. The matches of a pair agree on a common epipolar
    geometry, estimated without poses or focal lengths. Pairs with few such matches are left out, as are frames whose
    photo is not on disk.

    Raises:
        UserError: a photo cannot be read or has another shape than its camera.
    """
    present = [i for i, frame in enumerate(frames) if frame.has_photo]
    present.sort(key=lambda index: (len(frames[index].name), frames[index].name))  # 9.jpg before 10.jpg
    photos: dict[int, tuple[Camera, Features]] = {}

    def photo(place: int) -> tuple[Camera, Features]:
        if present[place] not in photos:
            photos[present[place]] = _photo(frames[present[place]])
        return photos[present[place]]

    starts = np.unique(np.linspace(0, len(present) - 2, 24).round().astype(int)) if len(present) > 1 else ()
    pairs, stride = [], 1
    for done, start in enumerate(starts):
        progress(done / len(starts), f"photo {done} of {len(starts)}")
        found = None
        while True:
            partner = min(start + stride * (1 + start % 2), len(present) - 1)
            matched = _matched(photo(start), photo(partner))
            if matched is None and found is None and stride > 1:
                stride //= 2  # the camera has become faster
                continue
            if matched is None:
                break
            found = Matches((present[start], present[partner]), matched)
            if partner == len(present) - 1 or _move(matched, photo(start)[0]) >= LEAST_MOVE:
                break
            stride *= 2
        if found is not None:
            pairs.append(found)
    return pairs, {index: camera for index, (camera, _) in photos.items()}


def _move(matched: tuple[np.ndarray, np.ndarray], camera: Camera) -> float:
    """Return the median movement of matched features from photo to photo, as a fraction of the longer side."""
    moves = np.linalg.norm(matched[1] - matched[0], axis=1)
    return float(np.median(moves)) / max(camera.size)


def _photo(frame: Frame) -> tuple[Camera, Features]:
    assert frame.image is not None
    grey, camera = _stored_or_shown(frame.camera, frame.image)
    return camera, find_features(grey, longer_side_px=LONGER_SIDE_PX, most=3000)


def _stored_or_shown(camera: Camera, path: Path) -> tuple[np.ndarray, Camera]:
    """Return the grey photo, as stored or turned upright by its EXIF orientation, and the camera for its size."""
    data, grey = np.frombuffer(path.read_bytes(), dtype=np.uint8), None
    for flag in (cv2.IMREAD_IGNORE_ORIENTATION, 0) if len(data) else ():
        grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | flag)
        if grey is not None and camera.has_shape(*grey.shape[::-1]):
            break
    if grey is None:  # OpenCV reads neither HEIC nor TGA; of a damaged file, the error of `read_image` says more
        grey = cv2.cvtColor(np.ascontiguousarray(read_image(path)[..., :3]), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    return grey, resized_for(camera, (width, height), path)


def _matched(first: tuple[Camera, Features], second: tuple[Camera, Features]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the positions (M, 2) of matches in both photos, or None if too few agree with each other."""
    (camera, one), (other_camera, other) = first, second
    a, b = mutual_matches(one.descriptors, other.descriptors)
    if len(a) < _LEAST_MATCHES:
        return None
    pixels = one.pixels[a], other.pixels[b]
    if camera.is_spherical or "FISHEYE" in camera.model:  # their matches do not fit a fundamental matrix
        return pixels
    # In pixels of the size at which features were detected, so that the threshold means the same for every photo.
    scales = [min(1.0, LONGER_SIDE_PX / max(each.width, each.height)) for each in (camera, other_camera)]
    _, agree = fundamental_matrix(
        pixels[0] * scales[0], pixels[1] * scales[1], within_px=_EPIPOLAR_PX, trials=5000, least=_LEAST_MATCHES
    )
    return (pixels[0][agree], pixels[1][agree]) if agree.sum() >= _LEAST_MATCHES else None


class ObservationEvidence:
    """Observations of world points in photos.

    The error of an observation is the angle between the viewing direction of its pixel and the direction to its point,
    times the focal length.
    """

    threshold_px, shows_intrinsics = 4.0, True

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

    def directions(self, convention: Convention) -> tuple[np.ndarray, ...]:
        """Return the unit viewing directions of the pixels, (M, 3), and their pixels per radian."""
        return _directions(self._cameras, self.groups, self._pixels, convention)

    def errors_px(self, directions: tuple[np.ndarray, ...], world_from_cam: np.ndarray) -> np.ndarray:
        """Return the error of each observation, (M,)."""
        seen, focal_px = directions
        cam_from_world = rigid.inverse(world_from_cam)[self.groups]
        towards = np.einsum("mij,mj->mi", cam_from_world[:, :3, :3], self._points) + cam_from_world[:, :3, 3]
        angle = np.arctan2(np.linalg.norm(np.cross(seen, towards), axis=1), np.einsum("mi,mi->m", seen, towards))
        # A point 90 degrees or more off its pixel's direction counts as behind the camera, for wide cameras too.
        return np.where(angle < np.pi / 2, focal_px * angle, np.inf)


class MatchEvidence:
    """Matches, points that two photos both show.

    The error of a match is its Sampson distance to the epipolar geometry of the two poses, as an angle times the focal
    length.
    """

    threshold_px, shows_intrinsics = 4.0, True

    def __init__(self, pairs: Sequence[Matches], cameras: dict[int, Camera], num_frames: int):
        self.groups = np.repeat(np.arange(len(pairs)), [len(pair.pixels[0]) for pair in pairs])
        self._pairs = np.array([pair.photos for pair in pairs]).T
        self._first, self._second = self._pairs[:, self.groups]
        self._first_pixels = np.concatenate([pair.pixels[0] for pair in pairs])
        self._second_pixels = np.concatenate([pair.pixels[1] for pair in pairs])
        stand_in = next(iter(cameras.values()))
        self._cameras = [cameras.get(index, stand_in) for index in range(num_frames)]
        self.name = f"{len(self.groups)} SIFT matches in {len(pairs)} pairs of photos"

    def directions(self, convention: Convention) -> tuple[np.ndarray, ...]:
        """Return unit viewing directions of both pixels of each match, (M, 3) twice, and pixels per radian."""
        first, focal1 = _directions(self._cameras, self._first, self._first_pixels, convention)
        second, focal2 = _directions(self._cameras, self._second, self._second_pixels, convention)
        return first, second, (focal1 + focal2) / 2

    def errors_px(self, directions: tuple[np.ndarray, ...], world_from_cam: np.ndarray) -> np.ndarray:
        """Return the error of each match, (M,)."""
        first, second, focal_px = directions
        firsts, seconds = self._pairs
        second_from_first = (rigid.inverse(world_from_cam[seconds]) @ world_from_cam[firsts])[self.groups]
        found = agreement(first, second, second_from_first, focal_px=focal_px)
        behind = found.behind & (found.parallax_px > _LEAST_PARALLAX_PX)
        return np.where(behind | np.isnan(found.sampson_px), np.inf, np.abs(found.sampson_px))


class FrustumEvidence:
    """Visibility of scene points, of which each photo should show some: the error is 0 for a visible point.

    It determines axes and directions, but not intrinsics: the wider the pictures, the more points they show.
    """

    threshold_px, shows_intrinsics = 0.0, False

    def __init__(self, capture: Capture):
        rng = np.random.default_rng(0)
        frames = np.unique(np.linspace(0, len(capture.frames) - 1, 60).round().astype(int))
        chosen = rng.choice(len(capture.points), min(len(capture.points), 300), replace=False)
        self.groups = np.repeat(frames, len(chosen))
        self._points = np.tile(capture.points[chosen], (len(frames), 1))
        self._cameras = [frame.camera for frame in capture.frames]
        self.name = f"the visibility of {len(chosen)} points in {len(frames)} photos"

    def directions(self, convention: Convention) -> tuple[np.ndarray, ...]:
        """Return nothing: intrinsics are those of the capture."""
        return ()

    def errors_px(self, directions: tuple[np.ndarray, ...], world_from_cam: np.ndarray) -> np.ndarray:
        """Return 0 or infinity for each pair of a photo and a point, (M,)."""
        cam_from_world = rigid.inverse(world_from_cam)[self.groups]
        in_camera = np.einsum("mij,mj->mi", cam_from_world[:, :3, :3], self._points) + cam_from_world[:, :3, 3]
        shown = np.zeros(len(self.groups), dtype=bool)
        for index in np.unique(self.groups):
            rows = self.groups == index
            shown[rows] = self._cameras[index].shows(in_camera[rows])
        return np.where(shown, 0.0, np.inf)


def _directions(
    cameras: Sequence[Camera], frame_index: np.ndarray, pixels: np.ndarray, convention: Convention
) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit viewing directions (M, 3) of pixels of frames, NaN without one, and pixels per radian (M,)."""
    shift = 0.5 - convention.pixel_centre
    corrected = {
        camera: for_picture(camera.shifted(shift, shift), convention.intrinsics_scale) for camera in set(cameras)
    }
    focal_px = np.array([corrected[camera].focal_px for camera in cameras])
    return rays_of([corrected[camera] for camera in cameras], frame_index, pixels), focal_px[frame_index]
