"""Photos as an ideal camera at the same place would have taken them: straight lines stay straight."""

import math
from dataclasses import replace

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame

# Widest field of view: a plane cannot hold all that a fisheye or spherical camera sees, so only the middle is kept.
WIDEST_DEG = 100.0


def pinhole_of(camera: Camera) -> Camera:
    """Return the pinhole camera of the same size with about the same view; a PINHOLE camera is returned as it is.

    It keeps the camera's focal length and principal point. If the picture would be wider than `WIDEST_DEG`, the focal
    length is larger and the principal point is in the middle.
    """
    if camera.model == "PINHOLE":
        return camera
    half = max(camera.width, camera.height) / 2
    shortest = half / math.tan(math.radians(WIDEST_DEG / 2))
    if camera.is_spherical or camera.focal_px < shortest:
        return Camera.pinhole(camera.width, camera.height, shortest)
    return Camera("PINHOLE", camera.width, camera.height, (camera.focal_px, camera.focal_px, *camera.principal_point))


def pinhole_frame(frame: Frame) -> Frame:
    """Return the frame with `pinhole_of` its camera."""
    return replace(frame, camera=pinhole_of(frame.camera))


def undistorted(pixels: np.ndarray, camera: Camera, pinhole: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Resample a photo for a pinhole camera at the same place, linearly between pixel centres.

    Args:
        pixels: (H, W, C) uint8 of `camera`.
        camera: the camera that took the photo.
        pinhole: the camera to resample for, of any size.

    Returns:
        picture (height, width, C) uint8 of `pinhole`; mask (height, width) bool of the pixels that the photo covers.
        Other pixels are black.
    """
    if camera == pinhole:
        return pixels, np.ones(pixels.shape[:2], dtype=bool)
    directions, _ = pinhole.pixel_bearings()
    places, valid = camera.project(directions)
    shown = valid & ((places >= 0) & (places <= (camera.width, camera.height))).all(axis=1)
    shape = (pinhole.height, pinhole.width)
    # The centre of the first pixel is at 0.5 here and at 0 in OpenCV.
    x, y = (np.where(shown, places[:, axis] - 0.5, -1e6).astype(np.float32).reshape(shape) for axis in (0, 1))
    # Between the picture's edge and the first pixel centre, the colour of the border is repeated.
    picture = cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(*shape, -1)
    seen = shown.reshape(shape)
    return np.where(seen[..., None], picture, 0).astype(np.uint8), seen
