"""transforms.json: nerfstudio's, instant-ngp's and Blender's (NeRF) files of cameras, and writing one.

Poses in these files are world_from_cam with OpenGL axes. Their pixel positions are COLMAP's: no half pixel to move.
Sources: docs.nerf.studio "Data conventions"; instant-ngp docs/nerf_dataset_tips.md and scripts/colmap2nerf.py.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from nerfcli.atomic import write_json
from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera, parameter_names
from nerfcli.cameras.conventions import opencv_from_opengl_pose, opengl_from_opencv_pose
from nerfcli.cameras.frame import Capture, Frame
from nerfcli.cameras.orientation import Measure, fit_to_picture, stored_size
from nerfcli.errors import UserError

# Tried in this order where a file_path has no suffix, as in the Blender captures.
_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp", ".tif", ".tiff", ".bmp")

# How far a pose's rotation may be from orthonormal: files print 6 digits or more; beyond is a mistake, not rounding.
_MAX_BEND = 1e-2

_INTRINSICS = ("k1", "k2", "k3", "k4", "p1", "p2")

_PERSPECTIVE_MODELS = (None, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
_FISHEYE_MODELS = ("OPENCV_FISHEYE", "FISHEYE")


def read_transforms(path: Path, measure: Measure) -> Capture:
    """A capture that one transforms.json lists (nerfstudio, instant-ngp).

    Args:
        path: the JSON file; image paths in it are relative to its folder.
        measure: tells an image's upright size and EXIF orientation.

    Raises:
        UserError: the file is malformed (file and field are named), or none of its images is on disk.
    """
    content = read_json_object(path)
    frames, missing = _read_frames(path, content, measure)
    splits = _listed_splits(path, content)
    frames = [replace(frame, split=splits.get(frame.name)) for frame in frames]
    return _capture(path, frames, missing, kind="transforms")


def read_blender(folder: Path, measure: Measure) -> Capture:
    """A Blender (NeRF synthetic) capture: transforms_train.json and transforms_test.json; val frames are left out.

    Raises:
        UserError: a file is malformed or lists no image that is on disk.
    """
    frames: list[Frame] = []
    missing: list[str] = []
    for split in ("train", "test"):
        path = folder / f"transforms_{split}.json"
        if split == "test" and not path.exists():
            continue
        found, absent = _read_frames(path, read_json_object(path), measure)
        frames += [replace(frame, split=split) for frame in found]
        missing += absent
    return _capture(folder / "transforms_train.json", frames, missing, kind="blender")


def read_camera_path(path: Path) -> tuple[Frame, ...]:
    """The cameras of a transforms.json without its images, for rendering along them: `w` and `h` must be given.

    Raises:
        UserError: the file is malformed; file and field are named.
    """
    content = read_json_object(path)
    frames = []
    for index, record in enumerate(_records(path, content)):
        where = f"{path}: frames[{index}]"
        size = _given_size({**content, **record}, where)
        if size is None:
            raise _malformed(where, "w and h are missing", "a camera path gives the size of its pictures in pixels")
        camera = _intrinsics({**content, **record}, size, where)
        name = str(record.get("file_path", f"frame_{index:04d}"))
        frames.append(Frame(name, camera, _pose(record, where)))
    return tuple(frames)


def write_transforms(path: Path, frames: Sequence[Frame]) -> None:
    """Write cameras as a nerfstudio transforms.json (OpenGL axes), atomically; intrinsics stand once if all agree.

    Raises:
        UserError: a lens model that the format has no words for, or a place that cannot be written.
    """
    intrinsics = [_intrinsics_record(frame.camera) for frame in frames]
    shared = bool(frames) and all(record == intrinsics[0] for record in intrinsics)
    records = [
        {
            **({} if shared else record),
            "file_path": frame.name,
            "transform_matrix": opengl_from_opencv_pose(frame.world_from_cam).tolist(),
        }
        for frame, record in zip(frames, intrinsics, strict=True)
    ]
    write_json(path, {**(intrinsics[0] if shared else {}), "frames": records})


def read_json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        UserError: the file cannot be read, is no JSON, or holds something else than an object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise _malformed(str(path), error.strerror or str(error), "the file must be there and readable") from error
    except UnicodeDecodeError as error:
        raise _malformed(str(path), f"not UTF-8 text (byte {error.start})", "expected a JSON file") from error
    except json.JSONDecodeError as error:
        what = f"not valid JSON: {error.msg} in line {error.lineno}, column {error.colno}"
        raise _malformed(str(path), what, "the file is cut off or was edited by hand; write it again") from error
    if not isinstance(content, dict):
        raise _malformed(str(path), f"holds a {type(content).__name__}", "expected a JSON object {...}")
    return content


def _malformed(where: str, what: str, hint: str) -> UserError:
    return UserError(f"{where}: {what}", hint)


def _capture(path: Path, frames: list[Frame], missing: list[str], *, kind: str) -> Capture:
    if not frames:
        raise UserError(
            f"{path}: none of the {len(missing)} images that it lists is on disk, such as {missing[0]}",
            "put the images where file_path says, relative to this file",
        )
    names = [frame.name for frame in frames]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(f"{path}: image {twice} is listed twice", "remove one of its two entries in frames")
    return Capture(tuple(frames), np.zeros((0, 3)), tuple(missing), None, kind)


def _read_frames(path: Path, content: dict[str, Any], measure: Measure) -> tuple[list[Frame], list[str]]:
    """The frames whose image is on disk, and the names of the other ones."""
    frames, missing = [], []
    for index, record in enumerate(_records(path, content)):
        where = f"{path}: frames[{index}]"
        world_from_cam = _pose(record, where)
        listed = record.get("file_path")
        if not isinstance(listed, str) or not listed:
            raise _malformed(where, f"file_path is {listed!r}", "expected the image's path as text")
        image = _find_image(path.parent, listed)
        if image is None:
            missing.append(_name_of(listed))
            continue
        merged = {**content, **record}
        camera = _intrinsics(merged, _given_size(merged, where) or stored_size(image, measure), where)
        camera, world_from_cam = fit_to_picture(camera, world_from_cam, path=image, measure=measure)
        mask = _find_mask(path.parent, record.get("mask_path"), where)
        name = _name_of(listed, suffix=image.suffix)
        frames.append(Frame(name, camera, world_from_cam, image=image, mask=mask))
    return frames, missing


def _records(path: Path, content: dict[str, Any]) -> list[dict[str, Any]]:
    records = content.get("frames")
    if not isinstance(records, list) or not records or not all(isinstance(item, dict) for item in records):
        raise _malformed(
            str(path), "has no list of frames", 'expected "frames": [{"file_path", "transform_matrix"}, ...]'
        )
    return records


def _name_of(listed: str, *, suffix: str = "") -> str:
    """A name with forward slashes and without "./"; of an absolute path, which is one machine's, the file name."""
    pure = PurePosixPath(listed.replace("\\", "/"))
    if pure.is_absolute() or ":" in pure.parts[0]:
        pure = PurePosixPath(pure.name)
    name = str(pure)
    return name if name.endswith(suffix) else name + suffix


def _find_image(folder: Path, listed: str) -> Path | None:
    for text in dict.fromkeys((listed, listed.replace("\\", "/"))):
        exact = folder / text
        for candidate in (exact, *(exact.with_name(exact.name + suffix) for suffix in _SUFFIXES)):
            if candidate.is_file():
                return candidate
    return None


def _find_mask(folder: Path, listed: Any, where: str) -> Path | None:
    if listed is None:
        return None
    mask = _find_image(folder, str(listed))
    if mask is None:
        raise _malformed(
            where, f"mask {listed} is not on disk", "put the mask there, or remove mask_path from the entry"
        )
    return mask


def _pose(record: dict[str, Any], where: str) -> np.ndarray:
    """`world_from_cam` (4, 4), OpenCV axes, exactly rigid."""
    if "transform_matrix" not in record:
        raise _malformed(where, "transform_matrix is missing", "expected 4 rows of 4 numbers, world from camera")
    try:
        matrix = np.array(record["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise _malformed(where, "transform_matrix is no matrix", "expected 4 rows of 4 numbers") from error
    if matrix.shape not in ((4, 4), (3, 4)):
        raise _malformed(where, f"transform_matrix has shape {matrix.shape}", "expected 4 rows of 4 numbers")
    return opencv_from_opengl_pose(rigid_pose(matrix, f"{where}.transform_matrix"))


def rigid_pose(matrix: np.ndarray, where: str) -> np.ndarray:
    """A pose (4, 4) whose rotation is exactly orthonormal, from (3, 4) or (4, 4) as a file printed it.

    Raises:
        UserError: not finite, mirrored, or farther from a rotation than rounding explains.
    """
    if not np.isfinite(matrix).all():
        raise _malformed(where, "holds a number that is not finite", "the pose of this image is lost; remove its entry")
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _MAX_BEND:
        raise _malformed(where, "its upper left 3x3 is no rotation", "rows must be perpendicular and of length 1")
    if np.linalg.det(rotation) < 0:
        raise _malformed(where, "mirrors the scene (determinant -1)", "expected a right-handed camera frame")
    return rigid.from_parts(rigid.nearest_rotation(rotation), matrix[:3, 3])


def _number(record: dict[str, Any], key: str, where: str) -> float | None:
    value = record.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _malformed(where, f"{key} is {value!r}", "expected a finite number")
    return float(value)


def _given_size(record: dict[str, Any], where: str) -> tuple[int, int] | None:
    width, height = _number(record, "w", where), _number(record, "h", where)
    if width is None or height is None:
        return None
    if width < 1 or height < 1 or width != int(width) or height != int(height):
        raise _malformed(where, f"w and h are {width} and {height}", "expected the picture's size in whole pixels")
    return int(width), int(height)


def _intrinsics(record: dict[str, Any], size: tuple[int, int], where: str) -> Camera:
    """The camera of a frame; `record` is the frame's entry over the file's shared one."""
    width, height = size
    model = record.get("camera_model")
    if model == "EQUIRECTANGULAR":
        return Camera("EQUIRECTANGULAR", width, height, (width, height))
    fx = _focal(record, "x", width, where)
    fy = _focal(record, "y", height, where)
    if fx is None and fy is None:
        raise _malformed(
            where, "neither fl_x nor camera_angle_x is given", "expected the focal length or field of view"
        )
    fx = fx if fx is not None else fy
    # The files of Blender give the horizontal angle only: pixels are square.
    fy = fy if fy is not None else fx
    assert fx is not None
    assert fy is not None
    cx, cy = _number(record, "cx", where), _number(record, "cy", where)
    head = (fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    k1, k2, k3, k4, p1, p2 = (_number(record, key, where) or 0.0 for key in _INTRINSICS)
    if model in _FISHEYE_MODELS or record.get("is_fisheye") is True:
        if p1 or p2:
            raise _malformed(where, "a fisheye camera with p1 or p2", "expected k1 to k4 only (OpenCV's fisheye)")
        return Camera("OPENCV_FISHEYE", width, height, (*head, k1, k2, k3, k4))
    if model not in _PERSPECTIVE_MODELS:
        known = ", ".join(str(name) for name in (*_PERSPECTIVE_MODELS[1:], *_FISHEYE_MODELS, "EQUIRECTANGULAR"))
        raise _malformed(where, f"camera_model {model!r} is not supported", f"expected one of {known}")
    if k4:
        raise _malformed(where, f"k4 is {k4} without a fisheye camera", "k1, k2, k3, p1, p2 are the perspective terms")
    if k3:
        return Camera("FULL_OPENCV", width, height, (*head, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    if k1 or k2 or p1 or p2:
        return Camera("OPENCV", width, height, (*head, k1, k2, p1, p2))
    return Camera("PINHOLE", width, height, head)


def _focal(record: dict[str, Any], axis: str, size_px: int, where: str) -> float | None:
    focal = _number(record, f"fl_{axis}", where)
    if focal is not None:
        if focal <= 0:
            raise _malformed(where, f"fl_{axis} is {focal}", "expected a focal length in pixels above 0")
        return focal
    angle = _number(record, f"camera_angle_{axis}", where)
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise _malformed(where, f"camera_angle_{axis} is {angle}", "expected radians between 0 and pi")
    return size_px / 2 / math.tan(angle / 2)


def _intrinsics_record(camera: Camera) -> dict[str, Any]:
    """The keys that describe a camera; the inverse of `_intrinsics`."""
    size = {"w": camera.width, "h": camera.height}
    if camera.model == "EQUIRECTANGULAR":
        return {"camera_model": camera.model, **size}
    values = dict(zip(parameter_names(camera.model), camera.params, strict=True))
    fx, fy = values.pop("fx", values.get("f")), values.pop("fy", values.pop("f", None))
    cx, cy = values.pop("cx"), values.pop("cy")
    values = {"k1" if key == "k" else key: value for key, value in values.items() if value}
    fisheye = "FISHEYE" in camera.model
    expressible = {"k1", "k2", "k3", "k4"} if fisheye else {"k1", "k2", "k3", "p1", "p2"}
    if not set(values) <= expressible or camera.model in ("EUCM", "DIVISION", "SIMPLE_DIVISION", "FOV"):
        raise UserError(
            f"camera model {camera.model} cannot be written to transforms.json",
            "write undistorted cameras, or keep the COLMAP model",
        )
    model = "OPENCV_FISHEYE" if fisheye else "OPENCV" if values else "PINHOLE"
    return {"camera_model": model, **size, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, **values}


def _listed_splits(path: Path, content: dict[str, Any]) -> dict[str, str]:
    """nerfstudio's train_filenames, val_filenames and test_filenames: name to split."""
    splits = {}
    for split in ("train", "val", "test"):
        listed = content.get(f"{split}_filenames", [])
        if not isinstance(listed, list) or not all(isinstance(item, str) for item in listed):
            raise _malformed(str(path), f"{split}_filenames is no list of paths", "expected a list of file_path texts")
        splits.update({_name_of(item): split for item in listed})
    return splits
