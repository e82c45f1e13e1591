"""Choose frames of a video: the sharpest one of each stretch of equal camera motion.

Equal stretches of time would waste frames on a camera that stands still. So time is weighted by the speed of the
picture, up to its usual speed: standing still does not count, and a fast turn, where frames are blurred, counts no
more than the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.photos.images import downscale

# Longer sides, in pixels, of the pictures for measuring sharpness (about the size for extracting features) and motion.
SHARPNESS_SIZE_PX = 960

# The picture has moved when half of its corners moved by this fraction of its longer side: about what is needed for
# parallax, and more than the shake of a hand that holds still.
MOVED_FRACTION = 0.01
# If a whole video has fewer such movements than this (a drone far away), smaller ones count, down to this fraction of
# them: a handful of frames would be too few for poses and training.
_FEW_STEPS, _LEAST_STEP = 24, 0.25
# Fewer corners than this do not measure motion; then pictures that differ by less than this, of 255, are the same.
_MIN_CORNERS = 12
_SAME_LEVELS = 3.0


@dataclass(frozen=True)
class FrameMeasure:
    """Sharpness of a frame (comparable within a video), and its motion since the anchor.

    The anchor is the last earlier frame that had moved by `MOVED_FRACTION`. moved is a fraction of the longer side,
    infinite if the two show different things.
    """

    sharpness: float
    moved: float


class FrameMeter:
    """Measures the frames of a video in their order; it keeps only the picture of the anchor."""

    def __init__(self) -> None:
        self._anchor: MotionPicture | None = None

    def measure(self, grey: np.ndarray) -> FrameMeasure:
        """Return the measures of the next frame, uint8 (height, width), at `SHARPNESS_SIZE_PX`."""
        picture = MotionPicture(grey)
        moved = self._anchor.moved_to(picture) if self._anchor else np.inf
        if moved >= MOVED_FRACTION:
            self._anchor = picture
        return FrameMeasure(sharpness(grey), moved)


class MotionPicture:
    """A reduced frame, with the corners that are tracked from it."""

    def __init__(self, picture: np.ndarray):
        """picture: uint8, grey or RGB."""
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        self._grey = downscale(grey, max(1.0, max(grey.shape) / (SHARPNESS_SIZE_PX / 3)))
        self._corners: np.ndarray | None = None

    def moved_to(self, other: "MotionPicture") -> float:
        """Return the median displacement of the corners to another frame, as a fraction of the longer side."""
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
        if found.mean() < 0.5:  # another part of the scene is in view
            return float("inf")
        lengths = np.linalg.norm((followed - self._corners)[found].reshape(-1, 2), axis=1)
        return float(np.median(lengths) / max(self._grey.shape))


def sharpness(grey: np.ndarray) -> float:
    """Compute the sharpness of a picture: the variance of its Laplacian, slightly smoothed against noise."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    return float(cv2.Laplacian(smooth, cv2.CV_32F).var())


def choose_frames(seconds: np.ndarray, measures: Sequence[FrameMeasure], *, count: int) -> list[int]:
    """Return the ascending numbers of `count` frames: the sharpest (the first of equals) of each of `count` stretches.

    `seconds` (frames,) increase; `count` is 1...frames.
    """
    if not 1 <= count <= len(measures):
        raise ValueError(f"count must be within 1...{len(measures)}, got {count}")
    path = _path(seconds, np.array([measure.moved for measure in measures]))
    # Stretch k begins with frame first[k]; each has at least one frame, even where the path leaves it none.
    first = np.searchsorted(path, path[-1] * np.arange(count) / count)
    first = np.maximum.accumulate(first - np.arange(count)) + np.arange(count)
    first = np.minimum(first, len(measures) - count + np.arange(count))
    sharp = np.array([measure.sharpness for measure in measures])
    stretches = zip(first, [*first[1:], len(measures)], strict=True)
    return [int(start + np.argmax(sharp[start:end])) for start, end in stretches]


def smallest_step(measures: Sequence[FrameMeasure]) -> float:
    """Return by how much a frame must have moved to differ from another, as a fraction of the longer side."""
    steps = sum(measure.moved >= MOVED_FRACTION for measure in measures)
    return MOVED_FRACTION * min(1.0, max(_LEAST_STEP, steps / _FEW_STEPS))


def _path(seconds: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the distance covered at each frame, (frames,), in seconds at the camera's usual speed; not decreasing.

    The speed is taken to be constant between successive anchors, and the usual speed is the median over these steps.
    """
    anchors = np.flatnonzero(moved >= MOVED_FRACTION)
    # Before the first step and after the last one, the picture moves by less than can be measured.
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
