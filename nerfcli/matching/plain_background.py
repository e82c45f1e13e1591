"""Photos of an object before a plain background: black cloth, a light box, white paper, or rendered pictures.

Such a background has no features, so nothing tells how far away it is. A field that extends to infinity explains it by
fog in front of the cameras, and the object hides in that fog.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.photos.loading import LoadedPhoto

# Levels within which a pixel has the colour of the background, and the width over which noise is averaged.
MOST_DIFFERENCE, BORDER_PX = 16.0, 5
# Part of the border that has this colour, in all photos together and in each of them: the object may reach the border.
# On captures with a plain background it was 0.88 to 1, and 0.72 in one photo of them; on 13 others at most 0.67.
LEAST_OF_ALL, LEAST_OF_ONE = 0.8, 0.6
# Smallest part of the pixels, so that a frame around the photos is no background. It was 0.56 to 0.68.
LEAST_PART = 0.1


@dataclass(frozen=True)
class PlainBackground:
    """A background of one colour.

    Args:
        colour: (3,) levels.
        masks: for each photo (H, W), what has this colour and is connected to the photo's border: no parts of the
            object in this colour, nor gaps through which the background is seen.
    """

    colour: np.ndarray
    masks: list[np.ndarray]

    @property
    def is_black(self) -> bool:
        """Whether the colour differs from black as little as its pixels may differ from it."""
        return bool(self.colour.max() <= MOST_DIFFERENCE)


def plain_background(photos: Sequence[LoadedPhoto]) -> PlainBackground | None:
    """Return the background that all photos have; None without one, for panoramas, and if there is alpha or a mask."""
    if any(
        photo.pixels.shape[-1] == 4 or photo.used is not None or photo.frame.camera.is_spherical for photo in photos
    ):
        return None
    borders = [_border(photo.pixels) for photo in photos]
    colour = np.median(np.concatenate(borders, axis=1), axis=(0, 1))
    alike = [_difference(border, colour).mean(0) <= MOST_DIFFERENCE for border in borders]
    if np.concatenate(alike).mean() < LEAST_OF_ALL or min(part.mean() for part in alike) < LEAST_OF_ONE:
        return None
    masks = [_connected(photo.pixels, colour) for photo in photos]
    is_large = sum(int(mask.sum()) for mask in masks) >= LEAST_PART * sum(mask.size for mask in masks)
    return PlainBackground(colour, masks) if is_large else None


def _border(pixels: np.ndarray) -> np.ndarray:
    """Return the colours (BORDER_PX, n, 3) along the four sides of a photo."""
    rows = pixels[:BORDER_PX], pixels[-BORDER_PX:]
    columns = pixels[:, :BORDER_PX].swapaxes(0, 1), pixels[:, -BORDER_PX:].swapaxes(0, 1)
    return np.concatenate([*rows, *columns], axis=1)


def _difference(pixels: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return the largest difference (...) of the three levels of pixels (..., 3) from a colour."""
    return np.abs(pixels.astype(np.float32) - colour.astype(np.float32)).max(-1)


def _connected(pixels: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return the mask (H, W) of what has the colour and is connected to the border."""
    alike = cv2.blur(_difference(pixels, colour), (BORDER_PX, BORDER_PX)) <= MOST_DIFFERENCE
    _, labels = cv2.connectedComponents(np.pad(alike, 1, constant_values=True).astype(np.uint8), connectivity=4)
    return (labels[1:-1, 1:-1] == labels[0, 0]) & alike
