"""Cameras of photos that carry an EXIF orientation, and of photos that were resized.

COLMAP and the programs built on it read pixels as they are stored and ignore the EXIF orientation (so does pycolmap
4.2.1); nerfcli shows photos upright. So a camera that refers to the stored pixels is turned together with its picture,
about its optical axis.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Size
from nerfcli.errors import UserError

# Returns an image file's width and height, EXIF orientation applied, and that orientation (1 if none).
Measure = Callable[[Path], tuple[int, int, int]]

# Rotations upright_from_stored of the picture, in (x right, y down): EXIF 3 is half a turn, 6 a quarter clockwise,
# 8 a quarter counter-clockwise. Source: Exif 2.32, tag 0x0112.
_TURNS = {
    1: np.array([[1.0, 0.0], [0.0, 1.0]]),
    3: np.array([[-1.0, 0.0], [0.0, -1.0]]),
    6: np.array([[0.0, -1.0], [1.0, 0.0]]),
    8: np.array([[0.0, 1.0], [-1.0, 0.0]]),
}

# Pairs of parameters that are the x and y parts of a vector in the picture and turn with it: the principal point is
# handled apart, tangential distortion is p2 in x and p1 in y (OpenCV's order), thin prisms are one vector per power.
_VECTORS = {
    "OPENCV": (("p2", "p1"),),
    "FULL_OPENCV": (("p2", "p1"),),
    "THIN_PRISM_FISHEYE": (("p2", "p1"), ("sx1", "sy1")),
    "RAD_TAN_THIN_PRISM_FISHEYE": (("p0", "p1"), ("s0", "s2"), ("s1", "s3")),
}


def stored_size(path: Path, measure: Measure) -> tuple[int, int]:
    """Return the width and height of an image file before its EXIF orientation is applied."""
    width, height, orientation = measure(path)
    return (height, width) if orientation >= 5 else (width, height)


def fit_to_picture(
    camera: Camera, world_from_cam: np.ndarray, *, path: Path, measure: Measure
) -> tuple[Camera, np.ndarray]:
    """Return the camera and pose for the upright picture on disk.

    The calibration is taken to be for the stored pixels, or for the upright ones if its aspect ratio fits those better,
    and may be for another size of the same picture.

    Raises:
        UserError: neither aspect ratio fits (both sizes are named), or the EXIF orientation mirrors the picture.
    """
    orientation, size = turn_to_upright(camera, path=path, measure=measure)
    try:
        resized = camera.resized(*size)
    except UserError as error:
        raise UserError(f"{path}: {error.message}", error.hint) from error
    return turned(resized, world_from_cam, orientation=orientation)


def turn_to_upright(camera: Camera, *, path: Path, measure: Measure) -> tuple[int, tuple[int, int]]:
    """Return the EXIF orientation that turns a camera's picture upright, and the size of the picture on disk.

    The orientation is 1 if the camera is for the upright picture already. The size is of the picture as the camera
    sees it, before turning, and may differ from the camera's size if the picture was resized.

    Raises:
        UserError: the EXIF orientation mirrors the picture.
    """
    width, height, orientation = measure(path)
    if orientation not in _TURNS:
        raise UserError(
            f"{path}: EXIF orientation {orientation} mirrors the photo, which is not supported",
            "save the photo upright without the tag and estimate the poses again",
        )
    stored = (height, width) if orientation >= 5 else (width, height)
    if stored != (width, height) and _shape_error(camera, stored) > _shape_error(camera, (width, height)):
        return 1, (width, height)
    return orientation, stored


def turned(camera: Camera, world_from_cam: np.ndarray, *, orientation: int) -> tuple[Camera, np.ndarray]:
    """Return the camera and pose of the upright picture, given those of the stored one.

    Args:
        orientation: EXIF: 1, 3, 6 or 8.

    Raises:
        UserError: a spherical picture, which cannot be turned.
    """
    if orientation == 1:
        return camera, world_from_cam
    if camera.is_spherical:
        raise UserError(
            f"a spherical picture with EXIF orientation {orientation}",
            "save the panorama upright without the tag",
        )
    turn = _TURNS[orientation]
    values, middle = camera.values, np.array(camera.size) / 2
    width, height = camera.size[::-1] if orientation in (6, 8) else camera.size
    values["cx"], values["cy"] = (
        turn @ (np.array([values["cx"], values["cy"]]) - middle) + np.array([width, height]) / 2
    )
    if "fx" in values and orientation in (6, 8):
        values["fx"], values["fy"] = values["fy"], values["fx"]
    for x_name, y_name in _VECTORS.get(camera.model, ()):
        values[x_name], values[y_name] = turn @ (values[x_name], values[y_name])
    upright = Camera(camera.model, width, height, tuple(float(value) for value in values.values()))
    stored_from_upright = np.eye(4)
    stored_from_upright[:2, :2] = turn.T
    return upright, world_from_cam @ stored_from_upright


def turned_pixels(pixels: np.ndarray, sizes: np.ndarray, *, orientation: int) -> np.ndarray:
    """Turn positions (N, 2) in stored pictures of `sizes` (N, 2), width and height, into those in upright pictures."""
    middles = sizes / 2
    return (pixels - middles) @ _TURNS[orientation].T + (middles[:, ::-1] if orientation in (6, 8) else middles)


def turn_back(orientation: int) -> int:
    """Return the EXIF orientation that undoes another one."""
    return {6: 8, 8: 6}.get(orientation, orientation)


def rescaling(calibrated: Camera, fitted: Camera) -> tuple[Size, Size] | None:
    """Return the sizes of a calibration and of the picture it was fitted to, both upright; None if they are equal."""
    size, other = fitted.size, calibrated.size
    if size in (other, other[::-1]):
        return None
    lying = (other[0] < other[1]) != (size[0] < size[1])
    return ((other[1], other[0]) if lying else other), size


def counted(sizes: Iterable[tuple[Size, Size] | None]) -> dict[tuple[Size, Size], int]:
    """Count the pairs of sizes that `rescaling` returned."""
    return dict(Counter(pair for pair in sizes if pair is not None))


def describe_rescaling(rescaled: Mapping[tuple[Size, Size], int]) -> list[str]:
    """Describe `Capture.rescaled`, one sentence per pair of sizes."""
    return [
        f"{count} photo{'s are' if count > 1 else ' is'} {width}x{height}, but the intrinsics are for {of_width}x"
        f"{of_height}: rescaled"
        for ((of_width, of_height), (width, height)), count in rescaled.items()
    ]


def _shape_error(camera: Camera, size: tuple[int, int]) -> float:
    """Return by how many pixels a size's height is off the camera's aspect ratio."""
    return abs(camera.height * size[0] / camera.width - size[1])
