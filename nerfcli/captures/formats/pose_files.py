"""Folders with a text file for each photo that holds its pose: ScanNet, 7-Scenes, NSVF, SRN and many others; read only.

    pose/0.txt                    color/0.jpg              intrinsic/intrinsic_color.txt    ScanNet
    frame-000000.pose.txt         frame-000000.color.png   none: give --intrinsics          7-Scenes
    pose/0_train_0000.txt         rgb/0_train_0000.png     intrinsics.txt                   NSVF: 0_, 1_, 2_ are splits

A pose is a 4x4 matrix, row by row, or its first three rows: world_from_cam with OpenCV axes. Intrinsics are a 3x3, 3x4
or 4x4 matrix for the size of the photos, or as SRN writes them: a line "f cx cy 0", more lines, and last "height width"
of the pictures that these numbers are for. depth/0.png or frame-000000.depth.png is what a sensor measured, in mm.
Source: ScanNet SensReader; Microsoft 7-Scenes readme.txt; facebookresearch/NSVF fairnr/data/data_utils.py
(load_intrinsics, load_matrix); vsitzmann/scene-representation-networks util.py (parse_intrinsics).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import MILLIMETRE, Frame, SensorDepth
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import content_lines, malformed, numbers, opened, read_text, size_of
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.lenses import Fits
from nerfcli.captures.formats.limits import FramePoses, checked_camera
from nerfcli.captures.formats.photo_names import GIVE_CAMERA, FoundPhotos, find_photos
from nerfcli.captures.orientation import stored_size
from nerfcli.errors import UserError

POSE_FOLDERS = ("pose", "poses")
IMAGE_FOLDERS = ("color", "rgb", "images", "image")

_INTRINSICS = (
    *("intrinsic/intrinsic_color.txt", "intrinsics/intrinsic_color.txt", "intrinsic_color.txt"),
    *("intrinsics.txt", "camera-intrinsics.txt", "camera_intrinsics.txt", "intrinsic.txt"),
)
_EXPECTED = "expected a 4x4 matrix, world from camera"
_LENGTHS = (12, 16)  # a pose has 3 or 4 rows
_SPLITS = {"0_": "train", "1_": "val", "2_": "test"}


def pose_files(folder: Path) -> list[Path]:
    """Return the files of a folder that may hold one pose each: those in pose/ or poses/, else *.pose.txt.

    They are sorted by the length of their names, then by name, so that 10.txt comes after 9.txt.
    """
    found = next(filter(None, (list((folder / name).glob("*.txt")) for name in POSE_FOLDERS)), None)
    return sorted(found or folder.glob("*.pose.txt"), key=lambda file: (len(file.name), file.name))


def parse_pose_files(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the poses in a folder, see `pose_files`, and the intrinsics beside them, unless the user gives a camera.

    A pose with numbers that are not finite is that of a photo that was not tracked, and gives no frame. Photos are
    found by the names of the pose files; those that are not on disk are `missing`.
    """
    files = pose_files(folder)
    stems = [file.name.removesuffix(".txt").removesuffix(".pose") for file in files]
    photos = _photos(stems, (folder, files[0].parent), given.images).required(folder)
    fits, poses, frames = Fits(), FramePoses(), []
    camera_of_size = _cameras(folder, given.camera, fits)
    names_give_splits = all(file.name[:2] in _SPLITS for file in files)
    for file, stem, image in zip(files, stems, photos.paths, strict=True):
        world_from_cam = poses.read(stem, str(file), partial(_matrix, file))
        if image is not None and world_from_cam is not None:
            own_camera = camera_of_size(stored_size(image))
            split = _SPLITS[stem[:2]] if names_give_splits else None
            maps = (folder / "depth" / f"{stem}.png", file.with_name(f"{stem}.depth.png"))
            depth = SensorDepth.found(*maps, unit=MILLIMETRE)
            frames.append(Frame(image.name, own_camera, world_from_cam, image=image, split=split, depth=depth))
    notes = (*photos.notes, *poses.notes(), *fits.notes())
    return Capture(tuple(frames), missing=photos.missing, kind="pose-files", notes=notes)


def _photos(stems: list[str], homes: tuple[Path, ...], images: Path | None) -> FoundPhotos:
    """Return the photos of these names; 7-Scenes adds .color to them."""
    found = find_photos(stems, homes, given=images, folders=IMAGE_FOLDERS)
    if any(found.paths):
        return found
    colour = find_photos([f"{stem}.color" for stem in stems], homes, given=images, folders=IMAGE_FOLDERS)
    return replace(colour, listed=tuple(stems))


def _matrix(file: Path) -> np.ndarray:
    """Return the matrix in a file, (3, 4) or (4, 4)."""
    fields = read_text(file, _EXPECTED).split()
    if len(fields) not in _LENGTHS:
        raise malformed(file, f"has {len(fields)} numbers", _EXPECTED)
    return np.array(numbers(fields, len(fields), str(file))).reshape(-1, 4)


def _cameras(folder: Path, camera: Camera | None, fits: Fits) -> Callable[[tuple[int, int]], Camera]:
    """Return the function that gives the camera of photos with a size."""
    if camera is not None:
        return lambda size: camera.resized(*size)
    path = next((folder / name for name in _INTRINSICS if (folder / name).is_file()), None)
    if path is None:
        raise UserError(f"{folder} has poses but no file of intrinsics, such as {_INTRINSICS[0]}", GIVE_CAMERA)
    rows = [line.split() for _, line in content_lines(read_text(path, "expected a matrix of intrinsics"))]
    lengths = [len(row) for row in rows]
    if lengths in ([3] * 3, [4] * 3, [4] * 4):
        matrix = np.array([numbers(row, len(row), str(path)) for row in rows])[:3, :3]
        return lambda size: fits.matrix(matrix, size, str(path))
    if len(rows) < 2 or lengths[0] != 4 or lengths[-1] != 2:
        raise malformed(
            path,
            f"has lines of {', '.join(map(str, lengths[:6]))} numbers" if lengths else "is empty",
            'expected a 3x3 or 4x4 matrix, or first a line "f cx cy 0" and last "height width"',
        )
    focal, x, y, _ = numbers(rows[0], 4, str(path))
    height, width = numbers(rows[-1], 2, str(path))
    size = size_of(width, height, str(path))
    calibrated = checked_camera("PINHOLE", *size, (focal, focal, x, y), where=str(path))
    return lambda size: calibrated.resized(*size)


def find_pose_files(path: Path) -> Path | None:
    """Find a folder with a text file for each pose, or the one that the folder of these files is in."""
    folder = path.parent if path.name in POSE_FOLDERS else path
    files = pose_files(folder) if folder.is_dir() else []
    if not files:
        return None
    with opened(files[0]) as stream:
        return folder if len(stream.read(10_000).split()) in _LENGTHS else None


FORMAT = Format(
    "pose-files",
    "a matrix per photo, as in ScanNet, 7-Scenes, NSVF",
    find_pose_files,
    parse_pose_files,
    takes_camera=True,
)
