"""MVSNet's cameras, cams/00000000_cam.txt for images/00000000.jpg, as BlendedMVS and many networks use them; read only.

    extrinsic
    (4x4 matrix, cam_from_world with OpenCV axes)

    intrinsic
    (3x3 matrix, for the size of the photos)

    DEPTH_MIN DEPTH_INTERVAL [DEPTH_NUM [DEPTH_MAX]]

Source: YoYo000/MVSNet README, "File Formats", and colmap2mvsnet.py (principal points as in COLMAP).
"""

from functools import partial
from pathlib import Path

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import malformed, matrix_of, numbers, read_text
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.lenses import Fits
from nerfcli.captures.formats.limits import FramePoses
from nerfcli.captures.formats.photo_names import find_photos
from nerfcli.captures.orientation import stored_size

CAMERA_FOLDER = "cams"
CAMERA_FILES = "*_cam.txt"
IMAGE_FOLDERS = ("images", "blended_images")

_EXPECTED = "expected the word extrinsic, 16 numbers, the word intrinsic, 9 numbers, and a line of 2 to 4 depths"


def parse_mvsnet(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the cameras in cams/, with their depth bounds where all files have them."""
    files = sorted((folder / CAMERA_FOLDER).glob(CAMERA_FILES))
    stems = [file.name.removesuffix(CAMERA_FILES[1:]) for file in files]
    photos = find_photos(stems, (folder,), given=given.images, folders=IMAGE_FOLDERS).required(folder)
    fits, poses, frames, bounds = Fits(), FramePoses(), [], []
    for file, stem, image in zip(files, stems, photos.paths, strict=True):
        fields = _fields(file)
        place = f"{file}: extrinsic"
        pose = poses.read_inverse(stem, place, partial(matrix_of, fields[1:17], 4, 4, place))
        matrix = matrix_of(fields[18:27], 3, 3, f"{file}: intrinsic")
        depths = numbers(fields[27:], len(fields) - 27, f"{file}: depths")
        if image is not None and pose is not None:
            camera = fits.matrix(matrix, stored_size(image), f"{file}: intrinsic")
            frames.append(Frame(image.name, camera, pose, image=image))
            bounds.append(_bounds(depths))
    notes = (*photos.notes, *poses.notes(), *fits.notes())
    known = np.array(bounds) if None not in bounds else None
    return Capture(tuple(frames), missing=photos.missing, depth_bounds=known, kind="mvsnet", notes=notes)


def _fields(file: Path) -> list[str]:
    """Return the words of a file: extrinsic, 16 numbers, intrinsic, 9 numbers, and up to 4 depths."""
    fields = read_text(file, _EXPECTED).split()
    if len(fields) < 27 or fields[0] != "extrinsic" or fields[17] != "intrinsic" or len(fields) > 31:
        raise malformed(file, "is not a camera of MVSNet", _EXPECTED)
    return fields


def _bounds(depths: list[float]) -> tuple[float, float] | None:
    """Return nearest and farthest z; None if the farthest is not stated, or they are not in order."""
    if len(depths) < 3:
        return None
    near, far = depths[0], depths[3] if len(depths) == 4 else depths[0] + depths[1] * depths[2]
    return (near, far) if 0 < near < far else None


def find_mvsnet(path: Path) -> Path | None:
    """Find the folder that holds cams/ of MVSNet."""
    return path if any((path / CAMERA_FOLDER).glob(CAMERA_FILES)) else None


FORMAT = Format("mvsnet", "cams/ of MVSNet, BlendedMVS", find_mvsnet, parse_mvsnet)
