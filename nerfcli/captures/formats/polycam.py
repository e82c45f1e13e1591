"""Raw data of Polycam's LiDAR captures (export "Raw data" in developer mode), read only.

keyframes/corrected_cameras/ID.json belongs to keyframes/corrected_images/ID.jpg: t_00 to t_23 are the first three rows
of world_from_cam with OpenGL axes, in metres, the world's y axis up; fx, fy, cx, cy are in pixels of a picture of width
and height, which newer versions write to cameras/ID.json only. Corrected photos are undistorted, and their poses are
those after loop closure; captures too large for that have cameras/ and images/ only. depth/ID.png is the LiDAR's depth
in millimetres, confidence/ID.png how sure it is.
Source: PolyCam/polyform README.md, "Polycam's data format", and polyform/convertors/instant_ngp.py.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.frame import MILLIMETRE, Frame, SensorDepth
from nerfcli.captures.axes import opencv_pose
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import number, read_json_object, size_of
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.limits import FramePoses, checked_camera
from nerfcli.captures.formats.photo_names import find_photos

FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
KEYFRAMES = "keyframes"

_POSE = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))


def polycam_folders(folder: Path) -> tuple[Path, Path] | None:
    """Return the folders of cameras and photos of a capture's folder; None if it is not one of Polycam's."""
    home = folder / KEYFRAMES
    pairs = [(home / cameras, home / images) for cameras, images in FOLDERS if any((home / cameras).glob("*.json"))]
    return next((pair for pair in pairs if pair[1].is_dir()), pairs[0] if pairs else None)


def parse_polycam(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the keyframes of a capture; the unit is the metre, by LiDAR. Photos are beside the cameras."""
    found = polycam_folders(folder)
    assert found is not None
    stems, views, poses = [], [], FramePoses()
    for file in sorted(found[0].glob("*.json"), key=lambda file: (len(file.stem), file.stem)):
        where, record = str(file), read_json_object(file)
        fx, fy, cx, cy = (number(record, key, where) for key in ("fx", "fy", "cx", "cy"))
        sides = record if "width" in record else _uncorrected(file)
        size = size_of(number(sides, "width", where), number(sides, "height", where), where)
        camera = checked_camera("PINHOLE", *size, (fx, fy, cx, cy), where=where)
        stems.append(file.stem)
        views.append((camera, poses.read(file.stem, where, partial(_matrix, record, where))))
    sizes = [camera.size for camera, _ in views]
    photos = find_photos(stems, (found[1],), given=given.images, sizes=sizes).required(folder)
    frames = []
    for stem, image, (camera, pose) in zip(stems, photos.paths, views, strict=True):
        if image is not None and pose is not None:
            depth, confidence = (found[0].parent / kind / f"{stem}.png" for kind in ("depth", "confidence"))
            measured = SensorDepth.found(depth, unit=MILLIMETRE, confidence=confidence)
            frames.append(Frame(image.name, camera, opencv_pose(pose, "opengl"), image=image, depth=measured))
    whole = len(list((folder / KEYFRAMES / "cameras").glob("*.json")))
    left = (f"{whole - len(stems)} of {whole} keyframes left out, whose poses Polycam has not corrected",)
    notes = (*photos.notes, *poses.notes(), *(left if whole > len(stems) else ()))
    source = "LiDAR (Polycam)"
    return Capture(tuple(frames), missing=photos.missing, kind="polycam", unit="metre", unit_source=source, notes=notes)


def _uncorrected(file: Path) -> dict[str, Any]:
    """Return the camera of a keyframe before its correction, which has the same size; empty if there is none."""
    path = file.parent.with_name("cameras") / file.name
    return read_json_object(path) if path.is_file() else {}


def _matrix(record: dict[str, Any], where: str) -> np.ndarray:
    """Return the first three rows of world_from_cam, (3, 4)."""
    return np.array([number(record, key, where) for key in _POSE]).reshape(3, 4)


def find_polycam(path: Path) -> Path | None:
    """Find the folder that holds the keyframes of Polycam, or the one that they are in."""
    folder = path.parent if path.name == KEYFRAMES else path
    return folder if polycam_folders(folder) is not None else None


FORMAT = Format("polycam", "raw data of Polycam", find_polycam, parse_polycam, axes="opengl")
