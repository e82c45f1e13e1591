"""Load photos for training: read them, turn them upright, downscale them and apply their masks."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

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


def load_photos(frames: Sequence[Frame], *, factor: float, threads: int, masks: str = "ignore") -> list[LoadedPhoto]:
    """Read, orient and downscale the photos of `frames`, in parallel, in order.

    Args:
        frames: with their images and masks.
        masks: meaning of black in masks: "ignore" (not used), or "empty" (transparent).

    Raises:
        UserError: a photo cannot be read, or has another size than its camera.
    """
    with ThreadPoolExecutor(max(1, threads)) as pool:
        return list(pool.map(lambda frame: load_photo(frame, factor, masks), frames))


def load_photo(frame: Frame, factor: float, masks: str) -> LoadedPhoto:
    """Read one photo, with arguments as for `load_photos`."""
    if frame.image is None:
        raise UserError(
            f"{frame.name} has no photo", "this view can be rendered, but not used for training or evaluation"
        )
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
