"""Verification of a conversion: a written file and its source capture must project points to the same pixels.

The capture projects its points with nerfcli's cameras; the file is read back (`readback`) and projects the same points
with OpenCV's. The two sides share no code that depends on a convention. All other
contents are compared as they are.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import PurePosixPath

import numpy as np

from nerfcli.cameras.frame import Capture
from nerfcli.convert.axes import poses_of
from nerfcli.convert.probes import Probes, probes_of, rows_of_each
from nerfcli.convert.readback import FileLens, ReadBack, UnreadableError, project

TOLERANCE_PX = 1e-6

# Coordinates are rounded to 2^-53 of their size, several times, on both sides.
_ROUNDINGS = 16 * 2.0**-53
# About the most observations compared, of whole views: pycolmap returns them one by one, 2 microseconds each.
_MOST_OBSERVATIONS = 300_000


@dataclass(frozen=True)
class Verification:
    """Differences between a written file and its source.

    Args:
        max_px: the largest distance between the two projections of a point.
        max_deg: the largest angle between the two rotations of a view.
        max_centre_shift: the largest distance between the two centres of a view, over the size of the scene.
        max_point_shift: the largest distance between the two positions of a point, over the size of the scene.
        worst: the name of the view with max_px; "" if there is none.
        num_views, num_points, num_projections: numbers of views, points and projections compared. Poses are compared
            for all views, including those without a point.
        tolerance_px: the largest max_px that passes.
        tolerance_rad: the same as an angle at the longest focal length: the limit for differences of rotations, and of
            positions over the size of the scene.
        fault: a fault other than numerical differences, such as a missing view; "" if there is none.
        parts: other contents that were compared and agree, such as "colours of 40 points".
    """

    max_px: float
    max_deg: float
    max_centre_shift: float
    max_point_shift: float
    worst: str
    num_views: int
    num_points: int
    num_projections: int
    tolerance_px: float
    tolerance_rad: float
    fault: str = ""
    parts: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """True if the file agrees with the capture."""
        moved = max(np.radians(self.max_deg), self.max_centre_shift, self.max_point_shift)
        return not self.fault and self.max_px <= self.tolerance_px and moved <= self.tolerance_rad


def verify(capture: Capture, back: ReadBack, *, listed: np.ndarray, tolerance_px: float = TOLERANCE_PX) -> Verification:
    """Compare a capture with the content read back from the file that it was written to.

    Both project every 3D point that a view sees, or a random subset if there are too many pairs of views and points,
    and also synthetic points. If coordinates are so large that rounding alone moves projections by more than the
    tolerance (a scene of metres in global coordinates), the tolerance is raised to that movement.

    Args:
        capture: the expected content, without accepted losses.
        listed: (frames,) the indices of the capture's frames in the order in which the format lists them.
    """
    probes = probes_of(capture)
    tolerance_px = max(tolerance_px, _rounding_px(capture, probes))
    empty = replace(
        unreadable(capture, "", tolerance_px=tolerance_px),
        num_views=len(np.unique(probes.frame_index)),
        num_points=len(np.unique(probes.point_index[probes.point_index >= 0])),
        num_projections=len(probes.points),
    )
    points = capture.points
    try:
        order = _order(capture, back, listed)
        if back.points is not None and back.points.shape != points.shape:
            raise UnreadableError(f"it contains {len(back.points)} points instead of {len(points)}")
    except UnreadableError as error:
        return replace(empty, fault=str(error))
    fault, parts = compared_parts(capture, back, order, tolerance_px=tolerance_px)
    residual = np.linalg.norm(_projected(capture, probes, back, order) - probes.pixels, axis=1)
    residual = np.where(np.isfinite(residual), residual, np.inf)
    worst = int(residual.argmax()) if len(residual) else -1
    poses, size = poses_of(capture), _size(capture)
    cam_from_world = np.swapaxes(poses[:, :3, :3], 1, 2)
    chord = np.linalg.norm(back.cam_from_world[order] - cam_from_world, axis=(1, 2)) / np.sqrt(8)  # sin(angle / 2)
    shifts = np.linalg.norm(back.centres[order] - poses[:, :3, 3], axis=1)
    point_shifts = np.linalg.norm(back.points - points, axis=1) if back.points is not None else np.zeros(0)
    return replace(
        empty,
        max_px=float(residual.max(initial=0.0)),
        max_deg=float(np.degrees(2 * np.arcsin(np.minimum(chord, 1.0)).max())),
        max_centre_shift=float(shifts.max() / size),
        max_point_shift=float(point_shifts.max(initial=0.0) / size),
        worst=capture.frames[probes.frame_index[worst]].name if worst >= 0 else "",
        fault=fault,
        parts=parts,
    )


def unreadable(capture: Capture, fault: str, *, tolerance_px: float = TOLERANCE_PX) -> Verification:
    """Return the verification of a file that could not be compared."""
    tolerance_rad = tolerance_px / max(frame.camera.focal_px for frame in capture.frames)
    return Verification(np.inf, np.inf, np.inf, np.inf, "", 0, 0, 0, tolerance_px, tolerance_rad, fault)


def verify_points(
    capture: Capture, points: np.ndarray, colours: np.ndarray | None, *, tolerance_px: float = TOLERANCE_PX
) -> Verification:
    """Compare points and colours alone, for a format that holds nothing else: they must be the same to the last bit."""
    same = points.shape == capture.points.shape
    shift = float(np.abs(points - capture.points).max(initial=0.0) / _size(capture)) if same else np.inf
    fault = "" if shift == 0 else f"its points are off by {shift:.3g} of the scene"
    if not fault and capture.colours is not None:
        fault = "" if colours is not None and np.array_equal(capture.colours, colours) else "its colours differ"
    failure = unreadable(capture, fault, tolerance_px=tolerance_px)
    return replace(
        failure, max_px=0.0, max_deg=0.0, max_centre_shift=0.0, max_point_shift=shift, num_points=len(capture.points)
    )


def listed_order(capture: Capture, format_name: str) -> np.ndarray:
    """Return the indices of the frames in the order in which a file of the format lists them, if not by name."""
    places = range(len(capture.frames))
    if format_name == "llff":
        return np.array(sorted(places, key=lambda index: PurePosixPath(capture.frames[index].name).name))
    if format_name == "blender":
        splits = ("train", "val", "test")
        return np.array(sorted(places, key=lambda index: splits.index(capture.frames[index].split or "train")))
    return np.array(places)


def _order(capture: Capture, back: ReadBack, listed: np.ndarray) -> np.ndarray:
    """Return the index of the read-back view of each frame of the capture, (frames,)."""
    if len(back.centres) != len(capture.frames):
        raise UnreadableError(f"it contains {len(back.centres)} views instead of {len(capture.frames)}")
    names = [frame.name for frame in capture.frames]
    places = {label: index for index, label in enumerate(back.labels or ())}
    if len(places) == len(names) and set(places) == set(names):
        return np.array([places[name] for name in names])
    if back.labels is not None:  # paths relative to the file, or without a suffix
        for frame_index, label in zip(listed, back.labels, strict=True):
            name = PurePosixPath(names[frame_index])
            if PurePosixPath(label).name not in (name.name, name.stem):
                raise UnreadableError(f"it lists {label} instead of {name}")
    return np.argsort(listed)


def _projected(capture: Capture, probes: Probes, back: ReadBack, order: np.ndarray) -> np.ndarray:
    """Return the pixels (M, 2) of the points in the read-back views, with the capture's lenses if the file has none."""
    points = probes.points
    if back.points is not None and len(back.points):
        listed = probes.point_index >= 0
        points = points.copy()
        points[listed] = back.points[probes.point_index[listed]]
    view = order[probes.frame_index]
    in_camera = np.einsum("mij,mj->mi", back.cam_from_world[view], points - back.centres[view])
    if back.lenses is None:
        own = [frame.camera for frame in capture.frames]
        per_frame = [FileLens(camera.model, camera.width, camera.height, camera.params) for camera in own]
    else:
        per_frame = [back.lenses[index] for index in order]
    pixels = np.zeros((len(points), 2))
    for lens, rows in rows_of_each(per_frame, probes.frame_index):
        pixels[rows] = project(lens, in_camera[rows])
        if lens.model == "EQUIRECTANGULAR":  # the left edge and the right edge coincide
            turns = np.round((pixels[rows, 0] - probes.pixels[rows, 0]) / lens.width)
            pixels[rows, 0] -= turns * lens.width
    return pixels


def _size(capture: Capture) -> float:
    """Return the extent of cameras and points, in scene units."""
    places = np.concatenate([poses_of(capture)[:, :3, 3], capture.points])
    return float(np.linalg.norm(np.ptp(places, axis=0))) or 1.0


def _rounding_px(capture: Capture, probes: Probes) -> float:
    """Return the largest distance, in pixels, by which rounding of coordinates alone may move a projection."""
    if not len(probes.points):
        return 0.0
    focal_px = np.array([frame.camera.focal_px for frame in capture.frames])[probes.frame_index]
    centres = poses_of(capture)[:, :3, 3]
    largest = np.maximum(np.abs(probes.points).max(axis=1), np.abs(centres).max(axis=1)[probes.frame_index])
    return float(_ROUNDINGS * np.max(focal_px * largest / probes.distances))


def compared_parts(
    capture: Capture, back: ReadBack, order: np.ndarray, *, tolerance_px: float
) -> tuple[str, tuple[str, ...]]:
    """Compare all contents of a capture besides cameras, poses and points with those read back.

    Args:
        order: (frames,) index of the read-back view of each frame of the capture.

    Returns:
        The first difference as a clause, "" if there is none; and the parts compared, such as "157412 observations".
    """
    found = (
        _colours(capture, back),
        _observations(capture, back, order, tolerance_px=tolerance_px),
        _paths(capture, back, order),
        _masks(capture, back, order),
        _splits(capture, back, order),
        _depth_bounds(capture, back, order),
        _unit(capture, back),
    )
    fault = next((fault for fault, _ in found if fault), "")
    return fault, () if fault else tuple(what for _, what in found if what)


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
    images = back.images
    if images is None or not any(frame.image for frame in capture.frames):
        return "", ""
    same = _same_file()
    for frame, view in zip(capture.frames, order, strict=True):
        if frame.image is not None and not same(str(frame.image), images[view]):
            return f"the photo of {frame.name} would be {images[view]}", ""
    return "", "the photo paths"


def _masks(capture: Capture, back: ReadBack, order: np.ndarray) -> tuple[str, str]:
    masks, count = back.masks, sum(frame.mask is not None for frame in capture.frames)
    if masks is None:
        return ("it has no masks" if count else ""), ""
    same = _same_file()
    for frame, view in zip(capture.frames, order, strict=True):
        if (frame.mask is not None) != bool(masks[view]):
            return f"{frame.name} has a mask in only one of the two", ""
        if frame.mask is not None and not same(str(frame.mask), masks[view]):
            return f"the mask of {frame.name} would be {masks[view]}", ""
    return "", f"{count} masks" if count else ""


def _splits(capture: Capture, back: ReadBack, order: np.ndarray) -> tuple[str, str]:
    splits = back.splits
    if splits is None:
        return ("it has no split" if any(frame.split for frame in capture.frames) else ""), ""
    for frame, view in zip(capture.frames, order, strict=True):
        if (frame.split or "") != splits[view]:
            return f"the split of {frame.name} changed from {frame.split or 'none'} to {splits[view] or 'none'}", ""
    return "", "the split" if any(splits) else ""


def _depth_bounds(capture: Capture, back: ReadBack, order: np.ndarray) -> tuple[str, str]:
    if capture.depth_bounds is None:
        return "", ""
    bounds = back.depth_bounds
    same = bounds is not None and np.array_equal(bounds[order], capture.depth_bounds)
    return ("" if same else "its depth bounds differ"), "depth bounds"


def _unit(capture: Capture, back: ReadBack) -> tuple[str, str]:
    unit = back.unit
    if unit is None:
        return ("" if capture.unit == "arbitrary" else "it has no unit of length"), ""
    return ("" if unit == capture.unit else f"its unit is {unit}, not {capture.unit}"), f"the unit ({unit})"


def _same_file() -> Callable[[str, str], bool]:
    """Return a test of whether two paths lead to the same file, with links in folders resolved, each folder once."""
    resolved = cache(os.path.realpath)

    def place(path: str) -> str:
        folder, name = os.path.split(path)
        return os.path.join(resolved(folder), name)

    return lambda a, b: a == b or place(a) == place(b)
