"""Masks of an object that turns in front of a static background, from photos of a camera on a tripod.

The photos may be displaced by a similarity each, as from a camera that was turned to keep the object in view.
The most frequent colour of a pixel is the background, wherever the object leaves it visible in some photos: an object
that turns shows other colours each time. Where no colour recurs as precisely as at the background's features, the
object always covers the pixel. The object in a photo is these pixels and those that differ from the background, with
holes filled: an object of one colour is taken for the background where it covers a pixel in all photos, but there it is
surrounded by pixels that differ.

All steps use small pictures; the masks are enlarged and slightly wider than the object, since a mask that cuts the
object costs more than one that leaves a rim of the background.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import binary_fill_holes

# Levels of a photo where it shows nothing, times its rank: they differ by more than those of any picture.
_OUTSIDE = 1000.0
# A tolerance that no difference exceeds.
_UNKNOWN = 1e6
# The longer side of the pictures that are compared.
SIDE_PX = 480
# Fewer photos than this are too few to find the background.
LEAST_PHOTOS = 6
# The background is the colour that a pixel has most consistently in this fraction of the photos.
_FRACTION = 0.3
# Tolerance of a pixel: levels of 255, plus a multiple of its noise, plus the effect of edges displaced by this much.
_LEVELS = 9.0
_NOISES = 3.0
_DISPLACED_PX = 0.5
# No background is visible where colours vary more than at the background's features, by this factor.
_LESS_PRECISE = 2.0
# Parts smaller than these fractions of the largest part, or of the picture, are not objects.
_LEAST_OF_LARGEST = 0.02
_LEAST_OF_PICTURE = 0.0005
# Gaps of this many pixels are closed, and the mask is dilated by half as many.
_CLOSED_PX = 4


@dataclass(frozen=True)
class Background:
    """Static background, which may be larger than a photo.

    colours: (h, w, 3) float32. tolerance: (h, w) float32, of each pixel; beyond any difference where too few photos
    show it. covered: (h, w) bool, where the object always covers it. origin: x and y of its first pixel in the frame of
    reference.
    """

    colours: np.ndarray
    tolerance: np.ndarray
    covered: np.ndarray
    origin: tuple[int, int]

    def seen_with(self, placed: np.ndarray, size: tuple[int, int]) -> "Background":
        """Return the background in the frame of a picture of (width, height), from its similarity, see `background`."""
        moved = cv2.invertAffineTransform(placed)
        moved[:, 2] -= self.origin
        return Background(
            _warped(self.colours, moved, size, outside=0.0),
            _warped(self.tolerance, moved, size, outside=_UNKNOWN),
            _warped(self.covered.astype(np.float32), moved, size, outside=0.0) > 0.5,
            origin=(0, 0),
        )


def background(pictures: Sequence[np.ndarray], placed: Sequence[np.ndarray], places: np.ndarray) -> Background:
    """Estimate the static background of `LEAST_PHOTOS` or more equally large pictures (h, w, 3), reduced to `SIDE_PX`.

    Args:
        placed: the similarity (2, 3) of each, from pixels of the frame of reference to its own.
        places: (N, 2) positions of static features in the frame of reference, as fractions of width and height, 0...1.
    """
    chosen = np.unique(np.linspace(0, len(pictures) - 1, min(len(pictures), 40)).astype(int))
    height, width = pictures[0].shape[:2]
    corners = np.array([(0, 0, 1), (width, 0, 1), (0, height, 1), (width, height, 1)], dtype=float)
    spans = np.concatenate([corners @ cv2.invertAffineTransform(placed[index]).T for index in chosen])
    (left, top), (right, bottom) = np.floor(spans.min(axis=0)).astype(int), np.ceil(spans.max(axis=0)).astype(int)
    origin, size = (int(left), int(top)), (int(right - left), int(bottom - top))
    stack = np.stack(
        [
            _warped(pictures[index].astype(np.float32), _from(origin, placed[index]), size, outside=-_OUTSIDE * rank)
            for rank, index in enumerate(chosen, start=1)
        ]
    )  # (n, h, w, 3)
    window = max(3, round(_FRACTION * len(stack)))
    light = stack.mean(axis=3)
    order = np.argsort(light, axis=0)
    ranked = np.take_along_axis(light, order, axis=0)
    spread = ranked[window - 1 :] - ranked[: len(ranked) - window + 1]
    first = spread.argmin(axis=0)  # (h, w)
    members = np.take_along_axis(order, first[None] + np.arange(window)[:, None, None], axis=0)
    values = np.take_along_axis(stack, members[..., None], axis=0)  # (window, h, w, 3)
    unknown = spread.min(axis=0) > 255
    colours = np.where(unknown[..., None], 0, np.median(values, axis=0)).astype(np.float32)
    deviation = np.where(unknown, 0, np.median(np.abs(values - colours), axis=0).max(axis=2))
    noise = cv2.GaussianBlur(deviation, (0, 0), 2)
    columns, rows = (places * (width, height) - origin).astype(int).clip(0, (size[0] - 1, size[1] - 1)).T
    usual = float(np.quantile(noise[rows, columns], 0.9))  # but for the worst
    most = _LESS_PRECISE * (usual + 1)
    grey = colours.mean(axis=2)
    across, down = cv2.Sobel(grey, cv2.CV_32F, 1, 0) / 8, cv2.Sobel(grey, cv2.CV_32F, 0, 1) / 8
    edges = cv2.dilate(np.hypot(across, down), np.ones((3, 3), np.uint8))
    tolerance = _LEVELS + _NOISES * np.minimum(noise, most) + _DISPLACED_PX * edges
    tolerance[unknown] = _UNKNOWN
    return Background(colours, tolerance.astype(np.float32), noise > most, origin)


def differs(picture: np.ndarray, behind: Background) -> np.ndarray:
    """Return where a picture (h, w, 3) differs from the background, (h, w) bool: the object, slightly dilated."""
    levels = picture.astype(np.float32)
    tolerances = np.abs(levels * _gain(levels, behind) - behind.colours).max(axis=2) / behind.tolerance
    raw = ((cv2.medianBlur(tolerances, 5) > 1) | behind.covered).astype(np.uint8)
    raw = cv2.morphologyEx(raw, cv2.MORPH_OPEN, _disc(1))
    closed = cv2.morphologyEx(np.pad(raw, _CLOSED_PX), cv2.MORPH_CLOSE, _disc(_CLOSED_PX))
    closed = closed[_CLOSED_PX:-_CLOSED_PX, _CLOSED_PX:-_CLOSED_PX]
    whole = np.asarray(binary_fill_holes(closed), dtype=np.uint8)
    count, labels, facts, _ = cv2.connectedComponentsWithStats(whole)
    areas = facts[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    least = max(_LEAST_OF_LARGEST * areas.max(), _LEAST_OF_PICTURE * whole.size)
    kept = np.isin(labels, [label for label in range(1, count) if areas[label] >= least])
    return cv2.dilate(kept.astype(np.uint8), _disc(_CLOSED_PX // 2)) > 0


def enlarged(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Enlarge a mask to the size (width, height) of its photo, with smooth edges."""
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5


def _from(origin: tuple[int, int], placed: np.ndarray) -> np.ndarray:
    """Return a similarity (2, 3) of pixels that are counted from an origin."""
    return np.column_stack([placed[:, :2], placed @ np.array([*origin, 1.0])])


def _warped(values: np.ndarray, similarity: np.ndarray, size: tuple[int, int], *, outside: float) -> np.ndarray:
    """Return values (h, w) or (h, w, 3) in another frame of (width, height); a similarity (2, 3) leads from there."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(values, similarity, size, flags=flags, borderValue=(outside,) * 3)


def _gain(picture: np.ndarray, behind: Background) -> np.ndarray:
    """Return the factor for each of the picture's channels that makes most of it as bright as the background."""
    bright = (behind.colours > 16) & (behind.colours < 240) & (picture > 8) & (picture < 245)
    gains = []
    for channel in range(3):
        usable = bright[..., channel]
        if usable.sum() < 0.05 * usable.size:
            gains.append(1.0)
            continue
        ratios = np.log(behind.colours[..., channel][usable] / picture[..., channel][usable])
        # The mode of the ratios, not their median: the object may take more than half of the picture.
        heights, edges = np.histogram(ratios, bins=np.arange(-1.0, 1.02, 0.02))
        peak = int(np.convolve(heights, np.ones(3), mode="same").argmax())
        near = np.abs(ratios - (edges[peak] + 0.01)) < 0.03
        gains.append(float(np.exp(np.median(ratios[near]))) if near.any() else 1.0)
    return np.array(gains, dtype=np.float32)


def _disc(radius_px: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1))
