"""Choose frames of a video: the sharpest one of each stretch of equal camera motion.

Equal stretches of time would spend frames on a camera that stands still. So time counts by how fast the picture moves,
up to its usual speed: standing still counts nothing, and a fast turn, where frames are blurred, no more than the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

# Longer sides, in pixels: what sharpness is judged at (about what features are sought in), and what motion is.
SHARPNESS_SIZE_PX = 960
_MOTION_SIZE_PX = 320

# The picture has moved when half of its corners moved by this share of its longer side: about what a depth of field's
# parallax needs, and more than a hand that holds still.
MOVED_SHARE = 0.01
# Fewer corners than this say nothing about motion; then pictures are the same that differ by less than this, of 255.
_MIN_CORNERS = 12
_SAME_LEVELS = 3.0
# Corners that are not found again, from this share on, mean that another part of the scene is in view.
_LOST_SHARE = 0.5


@dataclass(frozen=True)
class FrameMeasure:
    """Sharpness of a frame (comparable within a video), and its motion since the anchor.

    The anchor is the last frame before that had moved by `MOVED_SHARE`. moved is a share of the longer side, infinite
    where the two show different things.
    """

    sharpness: float
    moved: float


class FrameMeter:
    """Measures the frames of a video in their order; of the pictures it keeps no more than the anchor."""

    def __init__(self) -> None:
        self._anchor: MotionPicture | None = None

    def measure(self, grey: np.ndarray) -> FrameMeasure:
        """Return the measures of the next frame, uint8 (height, width), at `SHARPNESS_SIZE_PX`."""
        picture = MotionPicture(grey)
        moved = self._anchor.moved_to(picture) if self._anchor else np.inf
        if moved >= MOVED_SHARE:
            self._anchor = picture
        return FrameMeasure(sharpness(grey), moved)


class MotionPicture:
    """A frame, small, with the corners that are followed from it."""

    def __init__(self, picture: np.ndarray):
        """picture: uint8, grey or RGB."""
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        factor = max(1.0, max(grey.shape) / _MOTION_SIZE_PX)
        size = (max(1, round(grey.shape[1] / factor)), max(1, round(grey.shape[0] / factor)))
        self._grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        self._corners: np.ndarray | None = None

    def moved_to(self, other: "MotionPicture") -> float:
        """Return the displacement of at least half of the corners to another frame,
        as a fraction of the longer side.
        """
        if self._corners is None:
            found = cv2.goodFeaturesToTrack(self._grey, maxCorners=200, qualityLevel=0.01, minDistance=8)
            self._corners = np.zeros((0, 1, 2), np.float32) if found is None else found
        if len(self._corners) < _MIN_CORNERS:
            difference = np.abs(self._grey.astype(float) - other._grey).mean()
            return 0.0 if difference < _SAME_LEVELS else float("inf")
        room = np.empty_like(self._corners)
        followed, status, _ = cv2.calcOpticalFlowPyrLK(
            self._grey, other._grey, self._corners, room, winSize=(15, 15), maxLevel=4
        )
        found = status.ravel() == 1
        if found.mean() < _LOST_SHARE:
            return float("inf")
        lengths = np.linalg.norm((followed - self._corners)[found].reshape(-1, 2), axis=1)
        return float(np.median(lengths) / max(self._grey.shape))


def sharpness(grey: np.ndarray) -> float:
    """Compute the sharpness of a picture: the variance of its Laplacian, slightly smoothed against noise."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    return float(cv2.Laplacian(smooth, cv2.CV_32F).var())


def choose_frames(seconds: np.ndarray, measures: Sequence[FrameMeasure], *, count: int) -> list[int]:
    """Numbers of `count` frames, rising: the sharpest (of equals the first) of each of as many stretches.

    Args:
        seconds: (frames,) increasing.
        measures: of each frame.
        count: 1...frames.
    """
    if not 1 <= count <= len(measures):
        raise ValueError(f"count must be within 1...{len(measures)}, got {count}")
    path = _path(seconds, np.array([measure.moved for measure in measures]))
    # Stretch k begins with first[k]; each holds a frame at least, even where more are requested than there are.
    first = np.searchsorted(path, path[-1] * np.arange(count) / count)
    first = np.maximum.accumulate(first - np.arange(count)) + np.arange(count)
    first = np.minimum(first, len(measures) - count + np.arange(count))
    sharp = np.array([measure.sharpness for measure in measures])
    stretches = zip(first, [*first[1:], len(measures)], strict=True)
    return [int(start + np.argmax(sharp[start:end])) for start, end in stretches]


def _path(seconds: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """(frames,) how far the camera has come at each frame, in seconds at its usual speed; not decreasing.

    Between one anchor and the next the speed is constant, and the usual one is the median over these steps.
    """
    anchors = np.flatnonzero(moved >= MOVED_SHARE)
    # Before the first step and behind the last one the picture moves by less than can be measured.
    times = seconds[anchors]
    steps = np.diff(times)
    if len(steps) == 0:
        return seconds - seconds[0]
    speeds = moved[anchors[1:]] / steps
    finite = speeds[np.isfinite(speeds)]
    usual = np.median(finite) if len(finite) else 0.0
    gains = steps * np.minimum(1.0, speeds / usual) if usual > 0 else steps
    knots = np.concatenate([[0.0], np.cumsum(gains)])
    return np.interp(seconds, times, knots)
