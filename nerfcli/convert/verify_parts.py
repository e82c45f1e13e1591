"""Verify content besides cameras and poses: colours, observations, photos, masks, the split."""

import os
from collections.abc import Callable

import numpy as np

from nerfcli.cameras.frame import Capture
from nerfcli.convert.readback import ReadBack

# About the most observations compared, of whole views: pycolmap returns them one by one, 2 microseconds each.
_MOST_OBSERVATIONS = 300_000


def compared_parts(
    capture: Capture, back: ReadBack, order: np.ndarray, *, tolerance_px: float
) -> tuple[str, tuple[str, ...]]:
    """Compare all contents of a capture besides cameras, poses and points with those read back.

    Args:
        capture: the expected content.
        back: the content of the file.
        order: (frames,) index of the read-back view of each frame of the capture.
        tolerance_px: the largest difference of observations that passes.

    Returns:
        The first difference as a clause, "" if there is none; and the parts compared, such as "157412 observations".
    """
    checks: tuple[Callable[[], tuple[str, str]], ...] = (
        lambda: _colours(capture, back),
        lambda: _observations(capture, back, order, tolerance_px=tolerance_px),
        lambda: _paths(capture, back, order),
        lambda: _masks(capture, back, order),
        lambda: _splits(capture, back, order),
        lambda: _depth_bounds(capture, back, order),
        lambda: _unit(capture, back),
    )
    compared = []
    for check in checks:
        fault, what = check()
        if fault:
            return fault, ()
        compared += [what] if what else []
    return "", tuple(compared)


def _colours(capture: Capture, back: ReadBack) -> tuple[str, str]:
    if capture.colours is None:
        return "", ""
    if back.colours is None or back.colours.shape != capture.colours.shape:
        return "it has no point colours, or colours of other points", ""
    wrong = int((back.colours != capture.colours).any(axis=1).sum())
    return (f"{wrong} points have another colour" if wrong else ""), f"colours of {len(capture.colours)} points"


def _observations(capture: Capture, back: ReadBack, order: np.ndarray, *, tolerance_px: float) -> tuple[str, str]:
    seen = capture.observations
    if seen is None:
        return "", ""
    if back.features is None:
        return "it has no observations", ""
    rows = np.argsort(seen.frame_index, kind="stable")
    rows_of_frames = np.split(rows, np.searchsorted(seen.frame_index[rows], np.arange(1, len(capture.frames))))
    step = max(1, -(-len(rows) // _MOST_OBSERVATIONS))
    count = 0
    for index in range(0, len(capture.frames), step):
        pixels, points = back.features(int(order[index]))
        expected = rows_of_frames[index]
        same = pixels.shape == (len(expected), 2) and np.array_equal(points, seen.point_index[expected])
        if not same or not (np.abs(pixels - seen.pixels[expected]) <= tolerance_px).all():
            return f"the observations of {capture.frames[index].name} differ", ""
        count += len(expected)
    return "", f"{count} observations"


def _paths(capture: Capture, back: ReadBack, order: np.ndarray) -> tuple[str, str]:
    images = back.beside.images
    if images is None or not any(frame.image for frame in capture.frames):
        return "", ""
    same = _Same()
    for frame, view in zip(capture.frames, order, strict=True):
        if frame.image is not None and not same(str(frame.image), images[view]):
            return f"the photo of {frame.name} would be {images[view]}", ""
    return "", "the photo paths"


def _masks(capture: Capture, back: ReadBack, order: np.ndarray) -> tuple[str, str]:
    masks, count = back.beside.masks, sum(frame.mask is not None for frame in capture.frames)
    if masks is None:
        return ("it has no masks" if count else ""), ""
    same = _Same()
    for frame, view in zip(capture.frames, order, strict=True):
        if (frame.mask is not None) != bool(masks[view]):
            return f"{frame.name} has a mask in only one of the two", ""
        if frame.mask is not None and not same(str(frame.mask), masks[view]):
            return f"the mask of {frame.name} would be {masks[view]}", ""
    return "", f"{count} masks" if count else ""


def _splits(capture: Capture, back: ReadBack, order: np.ndarray) -> tuple[str, str]:
    splits = back.beside.splits
    if splits is None:
        return ("it has no split" if any(frame.split for frame in capture.frames) else ""), ""
    for frame, view in zip(capture.frames, order, strict=True):
        if (frame.split or "") != splits[view]:
            return f"the split of {frame.name} changed from {frame.split or 'none'} to {splits[view] or 'none'}", ""
    return "", "the split" if any(splits) else ""


def _depth_bounds(capture: Capture, back: ReadBack, order: np.ndarray) -> tuple[str, str]:
    if capture.depth_bounds is None:
        return "", ""
    bounds = back.beside.depth_bounds
    same = bounds is not None and np.array_equal(bounds[order], capture.depth_bounds)
    return ("" if same else "its depth bounds differ"), "depth bounds"


def _unit(capture: Capture, back: ReadBack) -> tuple[str, str]:
    unit = back.beside.unit
    if unit is None:
        return ("" if capture.unit == "arbitrary" else "it has no unit of length"), ""
    return ("" if unit == capture.unit else f"its unit is {unit}, not {capture.unit}"), f"the unit ({unit})"


class _Same:
    """Test of whether two paths lead to the same file, with links in folders resolved; each folder is resolved once."""

    def __init__(self) -> None:
        self._homes: dict[str, str] = {}

    def __call__(self, a: str, b: str) -> bool:
        return a == b or self._place(a) == self._place(b)

    def _place(self, path: str) -> str:
        folder, name = os.path.split(path)
        if folder not in self._homes:
            self._homes[folder] = os.path.realpath(folder)
        return os.path.join(self._homes[folder], name)
