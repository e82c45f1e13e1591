"""Projection of points into photos of perspective, fisheye and panorama cameras."""

import numpy as np
import pycolmap
from numpy.typing import NDArray

from nerfcli.photos.panoramas import PANORAMA

Array = NDArray[np.float64]


def panorama_camera(size: tuple[int, int]) -> pycolmap.Camera:
    """Return the camera of a panorama of (width, height) pixels."""
    return pycolmap.Camera.create_from_model_name(1, PANORAMA, 1.0, *size)


def projected(camera: pycolmap.Camera, local: Array) -> Array:
    """Return the pixels (n, 2) of points (n, 3) in the camera's axes; NaN where pycolmap cannot project them."""
    return np.asarray(camera.img_from_cam(local), dtype=np.float64).reshape(-1, 2)


def is_ahead(camera: pycolmap.Camera, local: Array) -> NDArray[np.bool_]:
    """Return which points (n, 3) in the camera's axes lie in front of it; all of them for panoramas."""
    return np.full(len(local), True) if camera.is_spherical() else local[:, 2] > 0


def offsets_px(camera: pycolmap.Camera, local: Array, pixels: Array) -> Array:
    """Return the projections of points (n, 3) in the camera's axes minus the observations (n, 2), in pixels."""
    return across_edge(camera, projected(camera, local) - pixels)


def across_edge(camera: pycolmap.Camera, offsets: Array) -> Array:
    """Return the shorter of two ways between pixels (n, 2): across the left and right edge of a panorama, or as it is.

    The offsets are changed.
    """
    if camera.is_spherical():
        offsets[:, 0] -= camera.width * np.round(offsets[:, 0] / camera.width)
    return offsets


def px_per_radian(camera: pycolmap.Camera) -> float:
    """Return the pixels per radian in the middle of a picture: the focal length, except for panoramas."""
    return camera.width / (2 * np.pi) if camera.is_spherical() else camera.mean_focal_length()
