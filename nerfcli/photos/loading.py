"""Load photos for training: read, turn upright, downscale, apply masks; and the undistorted views of their cameras."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.photos.images import downscale, read_image
from nerfcli.photos.masks import read_mask


@dataclass(frozen=True)
class LoadedPhoto:
    """One photo as it is trained on.

    Args:
        frame: with the camera of the downscaled picture.
        pixels: (H, W, 3 or 4) uint8 sRGB, straight alpha.
        used: (H, W) bool, False where a mask says to ignore the pixel; None for all.
    """

    frame: Frame
    pixels: np.ndarray
    used: np.ndarray | None

    def without(self, mask: np.ndarray | None) -> "LoadedPhoto":
        """Return the photo with the pixels of a mask (H, W) not used either; None for none."""
        if mask is None:
            return self
        return replace(self, used=~mask if self.used is None else self.used & ~mask)


def load_photos(frames: Sequence[Frame], *, factor: float, threads: int, masks: str = "ignore") -> list[LoadedPhoto]:
    """Read, orient and downscale the photos of `frames`, in parallel, in order; alpha that is opaque in all is dropped.

    Args:
        frames: with their images and masks.
        masks: meaning of black in masks: "ignore" (not used), or "empty" (transparent).
    """
    with ThreadPoolExecutor(max(1, threads)) as pool:
        photos = list(pool.map(lambda frame: load_photo(frame, factor, masks), frames))
    if any(is_transparent(photo.pixels) for photo in photos):
        return photos
    return [replace(photo, pixels=photo.pixels[..., :3]) for photo in photos]


def is_transparent(pixels: np.ndarray) -> bool:
    """Return whether a picture (H, W, 3 or 4) is transparent anywhere; many programs write alpha that is opaque."""
    return pixels.shape[-1] == 4 and bool(pixels[..., 3].min() < 255)


def load_photo(frame: Frame, factor: float, masks: str) -> LoadedPhoto:
    """Read one photo, with arguments as for `load_photos`."""
    if frame.image is None:
        hint = "this view can be rendered, but not used for training or evaluation"
        raise UserError(f"{frame.name} has no photo", hint)
    if not frame.image.exists():
        raise UserError(
            f"photo not found: {frame.image.resolve()}",
            "put it back; if photos or run were moved, restore their relative location or put a link to the photo "
            "folder there",
        )
    pixels = read_image(frame.image)
    height, width = pixels.shape[:2]
    if (width, height) != (frame.camera.width, frame.camera.height):
        raise UserError(
            f"{frame.image} is {width}x{height} pixels, but its camera is for {frame.camera.width}x"
            f"{frame.camera.height}",
            "restore the photo that the poses were estimated from, or run nerfcli poses again",
        )
    used = None
    if frame.mask is not None and masks == "empty":
        pixels = _emptied(pixels, read_mask(frame.mask, frame.image))
    elif frame.mask is not None:
        # A pixel of the downscaled picture is used only if all pixels that it averages are.
        used = downscale(read_mask(frame.mask, frame.image), factor) == 255
    return LoadedPhoto(replace(frame, camera=downscaled_camera(frame.camera, factor)), downscale(pixels, factor), used)


def downscaled_camera(camera: Camera, factor: float) -> Camera:
    """Return the camera of a picture downscaled by `photos.images.downscale`."""
    return camera.resized(max(1, round(camera.width / factor)), max(1, round(camera.height / factor)))


def _emptied(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the pixels as RGBA, transparent where the mask is black or the photo itself is transparent."""
    alpha = mask if pixels.shape[-1] == 3 else np.minimum(mask, pixels[..., 3])
    return np.concatenate([pixels[..., :3], alpha[..., None]], axis=-1)


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
