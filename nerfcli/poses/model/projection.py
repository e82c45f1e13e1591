"""Where points appear in photos: of perspective and fisheye cameras, and of panorama cameras, which see all around."""

import numpy as np
import pycolmap
from numpy.typing import NDArray

from nerfcli.media.panoramas import PANORAMA

Array = NDArray[np.float64]


def panorama_camera(size: tuple[int, int]) -> pycolmap.Camera:
    """Return the camera of a panorama of (width, height) pixels."""
    return pycolmap.Camera.create_from_model_name(1, PANORAMA, 1.0, *size)


def projected(camera: pycolmap.Camera, local: Array) -> Array:
    """Return the pixels (n, 2) of points (n, 3) in the camera's axes; NaN for those that it cannot see."""
    return np.asarray(camera.img_from_cam(local), dtype=np.float64).reshape(-1, 2)


def is_ahead(camera: pycolmap.Camera, local: Array) -> NDArray[np.bool_]:
    """Return which points (n, 3) in the camera's axes lie before it; before a panorama camera lies everything."""
    return np.full(len(local), True) if camera.is_spherical() else local[:, 2] > 0


def offsets_px(camera: pycolmap.Camera, local: Array, pixels: Array) -> Array:
    """Return how far points (n, 3) in the camera's axes appear from observations (n, 2), in pixels, (n, 2).

    The left and the right edge of a panorama are the same place.
    """
    offsets = projected(camera, local) - pixels
    if camera.is_spherical():
        offsets[:, 0] -= camera.width * np.round(offsets[:, 0] / camera.width)
    return offsets


def px_per_radian(camera: pycolmap.Camera) -> float:
    """Return the pixels per radian in the middle of a picture: its focal length, if it is no panorama."""
    return camera.width / (2 * np.pi) if camera.is_spherical() else camera.mean_focal_length()
