"""Captures of the app Record3D, unpacked or exported as "EXR + RGB": metadata.json beside rgb/0.jpg, rgb/1.jpg, ...

poses: a list of qx, qy, qz, qw, x, y, z for each frame: world_from_cam with OpenGL axes, in metres, the world's y axis
up. perFrameIntrinsicCoeffs: fx, fy, cx, cy of each frame; K, column by column, is that of all frames where they are
absent. w and h: the size of the pictures that these numbers are for. depth/0.exr, or 0.depth and 0.conf beside 0.jpg,
are the LiDAR's depth in metres and how sure it is. Read only.
Source: nerfstudio process_data/record3d_utils.py; record3d.app, "Format of .r3d files".
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame, SensorDepth
from nerfcli.captures.axes import opencv_pose
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import malformed, number, read_json_object, shown, size_of, vector
from nerfcli.captures.formats.format import Format, UserInputs, has_keys, named
from nerfcli.captures.formats.limits import FramePoses, checked_camera
from nerfcli.captures.formats.photo_names import find_photos

FILES = ("metadata.json", "metadata")
IMAGE_FOLDERS = ("rgb", "rgbd", "images")

_POSES, _INTRINSICS = "poses", "perFrameIntrinsicCoeffs"


def parse_record3d(path: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the frames of a capture; the unit is the metre, by LiDAR or ARKit."""
    content = read_json_object(path)
    where = str(path)
    size = size_of(number(content, "w", where), number(content, "h", where), where)
    poses = content.get(_POSES)
    if not isinstance(poses, list) or not poses:
        raise malformed(where, f"{_POSES} is {shown(poses)}", "expected a list of poses")
    stems, sizes = [str(index) for index in range(len(poses))], [size] * len(poses)
    photos = find_photos(stems, (path.parent,), given=given.images, folders=IMAGE_FOLDERS, sizes=sizes)
    photos = photos.required(path)
    usable, frames = FramePoses(), []
    intrinsics = _intrinsics(content, len(poses), where).tolist()
    for index, (pose, image) in enumerate(zip(poses, photos.paths, strict=True)):
        place = f"{where}: {_POSES}[{index}]"
        world_from_cam = usable.read_quaternion(str(index), place, partial(vector, {"pose": pose}, "pose", 7, place))
        if image is not None and world_from_cam is not None:
            camera = checked_camera("PINHOLE", *size, tuple(intrinsics[index]), where=where)
            pose = opencv_pose(world_from_cam, "opengl")
            maps = (path.parent / "depth" / f"{index}.exr", image.with_suffix(".exr"), image.with_suffix(".depth"))
            depth = SensorDepth.found(*maps, confidence=image.with_suffix(".conf"))
            frames.append(Frame(image.name, camera, pose, image=image, depth=depth))
    notes, source = (*photos.notes, *usable.notes()), "ARKit (Record3D)"
    return Capture(
        tuple(frames), missing=photos.missing, kind="record3d", unit="metre", unit_source=source, notes=notes
    )


def _intrinsics(content: dict[str, Any], count: int, where: str) -> np.ndarray:
    """Return fx, fy, cx, cy of each frame, (count, 4)."""
    rows = content.get(_INTRINSICS)
    if not rows:
        return np.tile(vector(content, "K", 9, where)[[0, 4, 6, 7]], (count, 1))
    if not isinstance(rows, list) or len(rows) != count:
        raise malformed(where, f"{_INTRINSICS} is {shown(rows)}", f"expected a list of {count}, one for each pose")
    return np.array([vector({"row": row}, "row", 4, f"{where}: {_INTRINSICS}[{i}]") for i, row in enumerate(rows)])


def find_record3d(path: Path) -> Path | None:
    """Find the file metadata.json, or metadata, of a capture by Record3D."""
    found = path if path.is_file() and path.name in FILES else named(*FILES)(path)
    return found if found and has_keys(found, _POSES, "K", "w", "h") else None


FORMAT = Format("record3d", "Record3D", find_record3d, parse_record3d, axes="opengl")
