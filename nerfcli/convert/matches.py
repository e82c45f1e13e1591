"""Places that two photos both show, found without knowing anything of the cameras."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError

# The longer side of the photos in which features are sought: more would find them better, and take longer.
LONGER_SIDE_PX = 1000
MOST_FEATURES = 3000
MOST_PAIRS = 24

# A match is kept if the second-best feature is this much farther away. Source: Lowe 2004, section 7.1.
_RATIO = 0.75
# Fewer matches than these agree on a common epipolar geometry by chance.
_LEAST_MATCHES = 20
_EPIPOLAR_PX = 2.0


@dataclass(frozen=True)
class Photo:
    """A photo as its file stores it or as it is shown, whichever shape the frame's camera has.

    Args:
        camera: the frame's, for the photo's size.
        pixels: (N, 2) positions of features in the photo, pixel centres at 0.5.
        descriptors: (N, 128).
    """

    camera: Camera
    pixels: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True)
class PairMatches:
    """Places that the photos of two frames both show.

    Args:
        first, second: indices of the frames.
        first_pixels, second_pixels: (M, 2), pixel centres at 0.5.
    """

    first: int
    second: int
    first_pixels: np.ndarray
    second_pixels: np.ndarray


def match_neighbours(
    frames: tuple[Frame, ...], *, progress: Callable[[float, str], None]
) -> tuple[list[PairMatches], dict[int, Camera]]:
    """Matches between photos that follow each other in the order of their names, and the cameras for the photos' sizes.

    The matches of a pair agree on some epipolar geometry, whichever it is: no pose and no focal length was used. Pairs
    with few such matches are left out, as are frames whose photo is not on disk.

    Raises:
        UserError: a photo cannot be read or has another shape than its camera.
    """
    present = [i for i, frame in enumerate(frames) if frame.image is not None and frame.image.is_file()]
    present.sort(key=lambda index: frames[index].name)
    steps = [(place, place + 1 + place % 2) for place in range(len(present) - 1)]  # next, next but one, in turn
    steps = [(present[a], present[b]) for a, b in steps if b < len(present)]
    chosen = (
        [steps[k] for k in np.unique(np.linspace(0, len(steps) - 1, MOST_PAIRS).round().astype(int))] if steps else []
    )
    photos: dict[int, Photo] = {}
    pairs = []
    for done, (first, second) in enumerate(chosen):
        progress(done / len(chosen), f"photo {done} of {len(chosen)}")
        for index in (first, second):
            if index not in photos:
                photos[index] = _photo(frames[index])
        matched = _matched(photos[first], photos[second])
        if matched is not None:
            pairs.append(PairMatches(first, second, *matched))
    return pairs, {index: photo.camera for index, photo in photos.items()}


def _photo(frame: Frame) -> Photo:
    assert frame.image is not None
    grey, camera = _stored_or_shown(frame.camera, frame.image)
    height, width = grey.shape
    scale = min(1.0, LONGER_SIDE_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale < 1 else grey
    # Without the precise upscaling, OpenCV's keypoints lie a quarter of a pixel off.
    sift = cv2.SIFT.create(nfeatures=MOST_FEATURES, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(small, None)
    if descriptors is None:
        return Photo(camera, np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32))
    found = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
    # OpenCV's positions have pixel centres at whole numbers.
    return Photo(camera, (found + 0.5) * (width / size[0], height / size[1]), descriptors)


def _stored_or_shown(camera: Camera, path: Path) -> tuple[np.ndarray, Camera]:
    """The grey photo, as stored or turned upright by its EXIF orientation, and the camera for its size."""
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    error = UserError(f"{path} cannot be read as a picture", "replace it, or remove it from the folder")
    for flag in (cv2.IMREAD_IGNORE_ORIENTATION, 0):
        grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | flag) if len(data) else None
        if grey is None:
            continue
        try:
            return grey, camera.resized(grey.shape[1], grey.shape[0])
        except UserError as mismatch:
            error = UserError(f"{path}: {mismatch.message}", mismatch.hint)
    raise error


def _matched(first: Photo, second: Photo) -> tuple[np.ndarray, np.ndarray] | None:
    """Positions (M, 2) of matches in both photos, or None where too few agree with each other."""
    if min(len(first.descriptors), len(second.descriptors)) < _LEAST_MATCHES:
        return None
    there, back = _nearest(first, second), _nearest(second, first)
    mutual = [(a, b) for a, b in there.items() if back.get(b) == a]
    if len(mutual) < _LEAST_MATCHES:
        return None
    a, b = np.array(mutual).T
    pixels = first.pixels[a], second.pixels[b]
    if first.camera.is_spherical or "FISHEYE" in first.camera.model:  # no fundamental matrix is common to all of them
        return pixels
    # In units of the size in which features were sought, so that the threshold means the same for every photo.
    scales = [LONGER_SIDE_PX / max(photo.camera.width, photo.camera.height) for photo in (first, second)]
    scaled = [position * min(1.0, scale) for position, scale in zip(pixels, scales, strict=True)]
    try:
        _, agree = cv2.findFundamentalMat(scaled[0], scaled[1], cv2.USAC_MAGSAC, _EPIPOLAR_PX, 0.999, 5000)
    except cv2.error:  # OpenCV's USAC asserts (!model.empty()) on some matches that all lie on a plane
        _, agree = cv2.findFundamentalMat(scaled[0], scaled[1], cv2.FM_RANSAC, _EPIPOLAR_PX, 0.999, 5000)
    if agree is None or agree.sum() < _LEAST_MATCHES:
        return None
    kept = agree.ravel().astype(bool)
    return pixels[0][kept], pixels[1][kept]


def _nearest(first: Photo, second: Photo) -> dict[int, int]:
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, k=2)
    return {best.queryIdx: best.trainIdx for best, other in pairs if best.distance < _RATIO * other.distance}
