"""LLFF captures: poses_bounds.npy beside images/ or images_4/, images_8/.

Each row of the array holds a 3x5 matrix, row by row (the pose with axes down, right, backward; the centre; height,
width, focal length of the full-size photo), and the depths of the nearest and farthest point. Rows are in the order of
the sorted file names. Source: Fyusion/LLFF README, "Using your own poses without running COLMAP";
llff/poses/pose_utils.py, save_poses.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.axes import opencv_pose, pose_in_axes
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import DAMAGED, array_of_npy
from nerfcli.captures.formats.format import Format, UserInputs, folder_with
from nerfcli.captures.formats.limits import FramePoses, checked_camera, plausible
from nerfcli.captures.formats.unsupported import lost_of_cameras, lost_parts, lost_to_pinhole, refuse_spherical
from nerfcli.errors import UserError, several
from nerfcli.photos.images import list_images

FILE = "poses_bounds.npy"
# Folders of photos, in the order of preference; the numbers are factors of reduction.
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8")

# Percentiles of the depths of a view's points that give its depth bounds. Source: pose_utils.py, save_poses.
_NEAR_PERCENT, _FAR_PERCENT = 0.1, 99.9


def parse_llff(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read poses_bounds.npy; cameras are for the full-size photos.

    The file does not name the photos. They are those of `images`, or of the first image folder that holds one per row.
    If there is no image folder at all, frames are named image000, image001, ... and have no image.
    """
    path = folder / FILE
    rows = _read_rows(path)
    places = [place for place in (folder / name for name in IMAGE_FOLDERS) if place.is_dir()]
    places = places if given.images is None else [given.images]
    photos = _photos_of_rows(path, len(rows), places) if places else [None] * len(rows)
    names = [
        f"image{index:03d}" if image is None else f"{image.parent.name}/{image.name}"
        for index, image in enumerate(photos)
    ]
    matrices, poses = rows[:, :15].reshape(-1, 3, 5), FramePoses()
    views = [
        poses.read(name, f"{path}: row {index}", partial(np.array, matrix[:, :4]))
        for index, (name, matrix) in enumerate(zip(names, matrices, strict=True))
    ]
    notes = poses.notes()
    kept = [index for index, pose in enumerate(views) if pose is not None]
    cameras = _cameras(path, rows, kept)
    frames = [
        Frame(names[index], camera, opencv_pose(pose, "llff"), image=photos[index])
        for index, camera in zip(kept, cameras, strict=True)
        if (pose := views[index]) is not None
    ]
    return Capture(tuple(frames), depth_bounds=rows[kept, 15:].copy(), kind="llff", notes=notes)


def losses_llff(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that poses_bounds.npy cannot hold.

    Photos are identified by the order of their file names, so names are lost only if that order is ambiguous: if the
    photos are in more than one folder.
    """
    folders = {Path(frame.name).parent for frame in capture.frames}
    names = [f"the photos' {len(folders)} folders"] if len(folders) > 1 else []
    parts = lost_parts(capture, holds=("depth bounds",))
    return (*lost_of_cameras(capture, lost_to_pinhole), *names, *parts)


def write_llff(capture: Capture, folder: Path) -> None:
    """Write a capture as poses_bounds.npy into a folder, atomically; rows are in the order of the photos' names.

    Depth bounds are the capture's own. Where it has none, they are the 0.1th and 99.9th percentile of the depths of the
    points that a view observes, or if there are no observations, of those that lie within its picture. A view without
    two such depths gets the widest bounds of the other views. The horizontal focal length is written.
    """
    refuse_spherical(capture, "focal length")
    bounds = _percentile_bounds(capture) if capture.depth_bounds is None else capture.depth_bounds
    poses = pose_in_axes(np.array([frame.world_from_cam for frame in capture.frames]), "llff")
    sizes = [(frame.camera.height, frame.camera.width, frame.camera.focal_lengths[0]) for frame in capture.frames]
    matrices = np.concatenate([poses[:, :3], np.array(sizes, dtype=np.float64)[:, :, None]], axis=2)  # (F, 3, 5)
    rows = np.concatenate([matrices.reshape(-1, 15), bounds], axis=1)
    order = sorted(range(len(rows)), key=lambda index: Path(capture.frames[index].name).name)
    with atomic_path(folder / FILE) as partial:
        np.save(partial, rows[order], allow_pickle=False)


def _read_rows(path: Path) -> np.ndarray:
    try:
        rows = array_of_npy(path.read_bytes())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is not a readable NumPy array ({str(error)[:200]})", DAMAGED) from error
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0 or rows.dtype.kind not in "fiu":
        hint = "expected (images, 17): 3x5 pose and intrinsics, near and far depth"
        raise UserError(f"{path}: array of shape {rows.shape}", hint)
    return rows.astype(np.float64)


def _cameras(path: Path, rows: np.ndarray, kept: Sequence[int]) -> list[Camera]:
    """Return the cameras of some rows; those of equal intrinsics share one."""
    bad = [i for i in kept if not (0 < rows[i, 15] < rows[i, 16] and plausible(rows[i, 15:]))]
    if bad:
        near, far = rows[bad[0], 15:]
        hint = "expected 0 < near < far in the last two columns"
        raise UserError(f"{path}: row {bad[0]}: depth bounds {near:g} and {far:g}", hint)
    numbers = {index: tuple(rows[index, 4:15:5].tolist()) for index in kept}
    cameras = {row: _camera(row, f"{path}: row {index}") for index, row in reversed(numbers.items())}
    return [cameras[row] for row in numbers.values()]


def _photos_of_rows(path: Path, count: int, folders: Sequence[Path]) -> Sequence[Path]:
    found = []
    for folder in folders:
        photos = list_images(folder)
        if len(photos) == count:
            return photos
        found.append(f"{folder.name}/ has {several(len(photos), 'photo')}")
    hint = "there must be exactly one photo per row, sorted by name"
    raise UserError(f"{path} has {count} rows, but {', '.join(found)}", hint)


def _camera(size_and_focal: Iterable[float], where: str) -> Camera:
    height, width, focal = size_and_focal
    if not min(height, width) >= 1 or not focal > 0 or not max(height, width, focal) < np.inf:  # True at NaN
        hint = "expected three positive numbers in the fifth column of the pose"
        raise UserError(f"{where}: invalid height, width or focal length: {height:g}, {width:g}, {focal:g}", hint)
    params = (focal, focal, round(width) / 2, round(height) / 2)
    return checked_camera("PINHOLE", round(width), round(height), params, where=where)


def _percentile_bounds(capture: Capture) -> np.ndarray:
    """Return the nearest and farthest depth of each view, (frames, 2), from the points."""
    bounds = np.full((len(capture.frames), 2), np.nan)
    seen = _points_seen(capture)
    for index, frame in enumerate(capture.frames):
        depths = frame.in_camera(capture.points[seen[index]])[:, 2]
        depths = depths[depths > 0]
        if len(depths):
            bounds[index] = np.percentile(depths, [_NEAR_PERCENT, _FAR_PERCENT])
    valid = bounds[:, 0] < bounds[:, 1]  # False at NaN
    if not valid.any():
        raise UserError(
            f"poses_bounds.npy needs depth bounds, but none of the {len(capture.frames)} views sees two of the "
            f"{len(capture.points)} points",
            "convert from a format with points or depth bounds, such as a COLMAP model",
        )
    bounds[~valid] = bounds[valid, 0].min(), bounds[valid, 1].max()
    return bounds


def _points_seen(capture: Capture) -> list[np.ndarray]:
    """Return the indices of the points that each view sees: those it observes, or else those within its picture."""
    seen = capture.observations
    if seen is not None and (seen.point_index >= 0).any():
        with_point = seen.point_index >= 0
        frame_index, point_index = seen.frame_index[with_point], seen.point_index[with_point]
        order = np.argsort(frame_index, kind="stable")
        starts = np.searchsorted(frame_index[order], np.arange(1, len(capture.frames)))
        return np.split(point_index[order], starts)
    return [np.flatnonzero(frame.camera.shows(frame.in_camera(capture.points))) for frame in capture.frames]


FORMAT = Format(
    "llff",
    "poses_bounds.npy",
    folder_with(FILE),
    parse_llff,
    axes="llff",
    open_axes=True,
    files=("poses_bounds.npy",),
    lacks=("points",),
    listed_by=lambda frame: Path(frame.name).name,
    write=write_llff,
    losses=losses_llff,
)
