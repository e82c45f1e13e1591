"""Feature matches between photos, found without any knowledge of the cameras."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.multiview.epipolar import fundamental_matrix
from nerfcli.multiview.features import Features, Matches, find_features, mutual_matches

# The longer side of the photos in which features are detected: a larger one finds better features, but takes longer.
LONGER_SIDE_PX = 1000
MOST_FEATURES = 3000
MOST_PAIRS = 24
# Fraction of the longer side by which matched features should move: less is explained by any poses.
LEAST_MOVE = 0.04

# Fewer matches than this may agree on a common epipolar geometry by chance.
_LEAST_MATCHES = 20
_EPIPOLAR_PX = 2.0


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
    present = [i for i, frame in enumerate(frames) if frame.image is not None and frame.image.is_file()]
    present.sort(key=lambda index: (len(frames[index].name), frames[index].name))  # 9.jpg before 10.jpg
    photos: dict[int, tuple[Camera, Features]] = {}

    def photo(place: int) -> tuple[Camera, Features]:
        if present[place] not in photos:
            photos[present[place]] = _photo(frames[present[place]])
        return photos[present[place]]

    starts = np.unique(np.linspace(0, len(present) - 2, MOST_PAIRS).round().astype(int)) if len(present) > 1 else ()
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
    return camera, find_features(grey, longer_side_px=LONGER_SIDE_PX, most=MOST_FEATURES)


def _stored_or_shown(camera: Camera, path: Path) -> tuple[np.ndarray, Camera]:
    """Return the grey photo, as stored or turned upright by its EXIF orientation, and the camera for its size."""
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    error = UserError(f"{path} is not a readable picture", "replace it, or remove it from the folder")
    for flag in (cv2.IMREAD_IGNORE_ORIENTATION, 0):
        grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | flag) if len(data) else None
        if grey is None:
            continue
        try:
            return grey, camera.resized(grey.shape[1], grey.shape[0])
        except UserError as mismatch:
            error = UserError(f"{path}: {mismatch.message}", mismatch.hint)
    raise error


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
