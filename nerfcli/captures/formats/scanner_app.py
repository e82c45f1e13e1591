"""Captures of 3D Scanner App (share "All Data"), read only: frame_00012.json beside frame_00012.jpg.

cameraPoseARFrame is world_from_cam, 16 numbers row by row, with OpenGL axes as in ARKit, in metres, the world's y axis
up; intrinsics are the matrix, 9 numbers row by row, for the size of the photo. The app writes a pose for every frame,
but a photo for some of them only.
depth_00012.png (16 bits, millimetres, 256x192) and conf_00012.png (0, 1, 2: ARConfidenceLevel) are of the same view.
Source: pwais/psegs, "3DScannerApp Data Parsing"; laanlabs/ARBodyPoseRecorder, by the developer of the app.
"""

import re
from functools import partial
from pathlib import Path

from nerfcli.cameras.frame import MILLIMETRE, Frame, SensorDepth
from nerfcli.captures.axes import opencv_pose
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import matrix, read_json_object
from nerfcli.captures.formats.format import Format, UserInputs, has_keys
from nerfcli.captures.formats.lenses import Fits
from nerfcli.captures.formats.limits import FramePoses
from nerfcli.captures.formats.photo_names import find_photos
from nerfcli.captures.orientation import stored_size

_POSE = "cameraPoseARFrame"
_FRAME = re.compile(r"frame_\d+\.json", re.IGNORECASE | re.ASCII)


def frame_files(folder: Path) -> list[Path]:
    """Return the JSON files of frames in a folder, in their order."""
    files = (path for path in folder.iterdir() if _FRAME.fullmatch(path.name)) if folder.is_dir() else ()
    return sorted(files, key=lambda path: (len(path.name), path.name))


def parse_scanner_app(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the frames that have a photo; the unit is the metre, by ARKit."""
    files = frame_files(folder)
    found = find_photos([path.stem for path in files], [folder], given=given.images).required(folder)
    fits, poses, frames = Fits(), FramePoses(), []
    for path, image in zip(files, found.paths, strict=True):
        if image is None:
            continue
        where, record = str(path), read_json_object(path)
        intrinsics = matrix(record, "intrinsics", (3,), 3, where)
        camera = fits.matrix(intrinsics, stored_size(image), f"{where}: intrinsics")
        pose = poses.read(image.name, f"{where}: {_POSE}", partial(matrix, record, _POSE, (4,), 4, where))
        if pose is not None:
            depth, confidence = (folder / f"{path.stem.replace('frame', kind)}.png" for kind in ("depth", "conf"))
            found_depth = SensorDepth.found(depth, unit=MILLIMETRE, confidence=confidence)
            frames.append(Frame(image.name, camera, opencv_pose(pose, "opengl"), image=image, depth=found_depth))
    notes = (*found.notes, *poses.notes(), *fits.notes())
    if found.missing:
        notes += (f"{len(frames)} of the {len(files)} frames with a pose have a photo",)
    source = "ARKit (3D Scanner App)"
    return Capture(tuple(frames), kind="3d-scanner-app", unit="metre", unit_source=source, notes=notes)


def find_scanner_app(path: Path) -> Path | None:
    """Find the folder of a capture, given it or the file of a frame."""
    files = [path] if path.is_file() and _FRAME.fullmatch(path.name) else frame_files(path)
    return files[0].parent if files and has_keys(files[0], _POSE, "intrinsics") else None


FORMAT = Format("3d-scanner-app", "3D Scanner App", find_scanner_app, parse_scanner_app, axes="opengl")
