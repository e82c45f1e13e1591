"""Captures of the app Stray Scanner: odometry.csv, camera_matrix.csv, and a video rgb.mp4, whose frames are the photos.

A row of odometry.csv is the pose of the video's frame with that number, from 0: world_from_cam with OpenCV axes (the
app turns ARKit's cameras), in metres, the world's y axis up. camera_matrix.csv is the matrix of intrinsics for the size
of the video, at its end; some recorders give fx, fy, cx and cy in each row. Photos are the frames as `nerfcli convert`
and `nerfcli poses` take them from the video, frame_000123.jpg, or 000123.jpg. Read only.
depth/000123.png (16 bits, millimetres, 0 is unknown) and confidence/000123.png (0, 1, 2) are of the same view, 256x192.
Source: StrayRobots/scanner docs/format.md, StrayScanner/Helpers/OdometryEncoder.swift and DatasetEncoder.swift.
"""

from functools import partial
from pathlib import Path

import numpy as np

from nerfcli.cameras.frame import MILLIMETRE, Frame, SensorDepth
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import malformed, numbers, read_rows
from nerfcli.captures.formats.format import Format, UserInputs, folder_with
from nerfcli.captures.formats.lenses import Fits
from nerfcli.captures.formats.limits import FramePoses
from nerfcli.captures.formats.photo_names import GIVE_PHOTOS, FoundPhotos, find_photos
from nerfcli.captures.orientation import stored_size
from nerfcli.errors import several
from nerfcli.photos.video import open_video

ODOMETRY, MATRIX = "odometry.csv", "camera_matrix.csv"

_FOLDERS = ("rgb", "images", "frames")
_VIDEOS = tuple(f"rgb.{suffix}" for suffix in ("mp4", "mov", "mkv", "m4v"))
_POSE = ("qx", "qy", "qz", "qw", "x", "y", "z")
_LENS = ("fx", "fy", "cx", "cy")
_EXPECTED = "expected the table of Stray Scanner: timestamp, frame, x, y, z, qx, qy, qz, qw"


def parse_stray_scanner(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the frames whose photo is on disk, or all frames if none is; the unit is the metre, by ARKit."""
    rows = _rows(folder / ODOMETRY)
    found = _photos(list(rows), folder, given.images)
    there = [image for image in found.paths if image is not None]
    if there:
        size = stored_size(there[0])
    elif (path_of_video := video_of(folder)) is not None:
        video = open_video(path_of_video)
        size = video.width, video.height
    else:
        hint = f"copy the whole capture; {GIVE_PHOTOS}"
        raise malformed(folder, f"has neither photos nor the video {_VIDEOS[0]}", hint)
    has_lenses = all(key in row for row, _ in rows.values() for key in _LENS)
    matrix = np.eye(3) if has_lenses else _matrix(folder / MATRIX)
    fits, poses, frames = Fits(), FramePoses(), []
    for (index, (row, where)), name, image in zip(rows.items(), found.names, found.paths, strict=True):
        if image is None and there:
            continue
        if has_lenses:
            fx, fy, cx, cy = numbers([row[key] for key in _LENS], 4, where)
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        pose = poses.read_quaternion(name, where, partial(numbers, [row[key] for key in _POSE], len(_POSE), where))
        if pose is None:
            continue
        camera = fits.matrix(matrix, size, where if has_lenses else str(folder / MATRIX))
        maps, number = folder / "depth", f"{index:06d}.png"
        depth = SensorDepth.found(maps / number, unit=MILLIMETRE, confidence=folder / "confidence" / number)
        frames.append(Frame(name if image is None else image.name, camera, pose, image=image, depth=depth))
    notes = (*found.notes, *poses.notes(), *fits.notes())
    if there and len(there) < len(rows):
        notes += (f"{len(there)} of the {len(rows)} frames with a pose have a photo",)
    source = "ARKit (Stray Scanner)"
    return Capture(tuple(frames), kind="stray-scanner", unit="metre", unit_source=source, notes=notes)


def _matrix(path: Path) -> np.ndarray:
    rows = read_rows(path, "expected 3 lines of 3 numbers", separator=",")
    if len(rows) != 3:
        raise malformed(path, f"has {several(len(rows), 'line')}", "expected a matrix: 3 lines of 3 numbers")
    return np.array([numbers(cells, 3, where) for cells, where in rows])


def _rows(path: Path) -> dict[int, tuple[dict[str, str], str]]:
    """Return the cells of each row by the names of their columns, and its place, by the number of the frame."""
    lines = read_rows(path, _EXPECTED, separator=",")
    header = [word.lower() for word in lines[0].cells] if lines else []
    if missing := [key for key in ("frame", *_POSE) if key not in header]:
        raise malformed(path, f"has no column {missing[0]}", _EXPECTED)
    rows = {}
    for cells, where in lines[1:]:
        if len(cells) != len(header):
            raise malformed(where, f"has {len(cells)} cells", f"expected {len(header)}, as in the first line")
        row = dict(zip(header, cells, strict=True))
        rows[int(numbers([row["frame"]], 1, where)[0])] = row, where
    return rows


def _photos(numbers: list[int], folder: Path, images: Path | None) -> FoundPhotos:
    """Return the photos of frames by their numbers, under the names that have photos."""
    tried = [
        find_photos([f"{prefix}{index:06d}" for index in numbers], [folder], given=images, folders=_FOLDERS)
        for prefix in ("frame_", "")
    ]
    return next((found for found in tried if any(found.paths)), tried[0])


def video_of(folder: Path) -> Path | None:
    """Return the video whose frames are the photos of a capture; None if it is not there."""
    return next((folder / name for name in _VIDEOS if (folder / name).is_file()), None)


FORMAT = Format("stray-scanner", "Stray Scanner", folder_with(ODOMETRY, MATRIX), parse_stray_scanner, video=video_of)
