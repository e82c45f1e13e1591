"""COLMAP models: cameras, images and points3D, as .bin or .txt.

Read here and not through pycolmap.Reconstruction: on a truncated points3D.bin or frames.bin pycolmap 4.2.1 does not
fail but loops for ever and fills the memory. The three files hold all that is needed; the rigs.bin and frames.bin of
newer models repeat it. Source: colmap.github.io/format.html; colmap src/colmap/scene/reconstruction_io_binary.cc.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import pycolmap

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera, parameter_names
from nerfcli.cameras.frame import Capture, Frame
from nerfcli.cameras.orientation import Measure, fit_to_picture
from nerfcli.errors import UserError

FILES = ("cameras", "images", "points3D")

T = TypeVar("T")

_POINT2D_BYTES = 24  # x, y as float64, and the id of its 3D point
_TRACK_ELEMENT_BYTES = 8  # image id and index of the 2D point


@dataclass(frozen=True)
class ColmapImage:
    """A registered image of a model: its name, the id of its camera, and `world_from_cam` (4, 4)."""

    name: str
    camera_id: int
    world_from_cam: np.ndarray


@dataclass(frozen=True)
class ColmapModel:
    """Cameras by id, images in the order of their names, and points (N, 3)."""

    cameras: dict[int, Camera]
    images: tuple[ColmapImage, ...]
    points: np.ndarray


def is_model(folder: Path) -> bool:
    """Whether a folder holds the three files of a COLMAP model, binary or text."""
    return any(all((folder / f"{name}{suffix}").is_file() for name in FILES) for suffix in (".bin", ".txt"))


def read_colmap(model_dir: Path, image_dir: Path, measure: Measure) -> Capture:
    """The registered images of a COLMAP model, with the pictures found under `image_dir`.

    Args:
        model_dir: holds cameras, images and points3D, as .bin (which wins) or .txt.
        image_dir: image names are relative to it; they may contain subfolders.
        measure: tells an image's upright size and EXIF orientation.

    Raises:
        UserError: a file of the model is missing or damaged, or no image is on disk.
    """
    model = read_model(model_dir)
    frames, missing = [], []
    for image in model.images:
        path = image_dir / image.name
        if not path.is_file():
            missing.append(image.name)
            continue
        camera, world_from_cam = fit_to_picture(
            model.cameras[image.camera_id], image.world_from_cam, path=path, measure=measure
        )
        frames.append(Frame(image.name, camera, world_from_cam, image=path))
    if not frames:
        raise UserError(
            f"none of the {len(missing)} images of the model {model_dir} is in {image_dir}"
            + (f", such as {missing[0]}" if missing else ""),
            "put the photos there, under the names that the model lists",
        )
    return Capture(tuple(frames), model.points, tuple(missing), None, "colmap")


def read_model(model_dir: Path) -> ColmapModel:
    """A COLMAP model as its files hold it, whatever pictures are on disk.

    Raises:
        UserError: a file is missing, truncated or inconsistent; the file is named.
    """
    if (model_dir / "cameras.bin").is_file():
        suffix = ".bin"
        cameras = _parse(model_dir / "cameras.bin", _read_cameras_binary)
        images = _parse(model_dir / "images.bin", _read_images_binary)
        points = _parse(model_dir / "points3D.bin", _read_points_binary)
    else:
        suffix = ".txt"
        cameras = _parse(model_dir / "cameras.txt", _read_cameras_text)
        images = _parse(model_dir / "images.txt", _read_images_text)
        points = _parse(model_dir / "points3D.txt", _read_points_text)
    if not images:
        raise UserError(f"{model_dir} has no registered image", "the reconstruction is empty; make it again")
    for image in images:
        if image.camera_id not in cameras:
            images_file = model_dir / f"images{suffix}"
            raise UserError(
                f"{images_file}: image {image.name} has camera {image.camera_id}, which is not there",
                "the files of the model are from different reconstructions; copy all of them again",
            )
    names = [image.name for image in images]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(
            f"{model_dir}: image {twice} is registered twice", "an image has one pose; make the model again"
        )
    return ColmapModel(cameras, tuple(sorted(images, key=lambda image: image.name)), points)


def _parse(path: Path, reader: Callable[[bytes], T]) -> T:
    """What `reader` makes of a file's bytes, with damage told as one error that names the file."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(
            f"{path}: {error.strerror or error}", "a COLMAP model needs cameras, images and points3D, as .bin or .txt"
        ) from error
    try:
        return reader(data)
    except (struct.error, ValueError, IndexError, KeyError) as error:
        raise UserError(
            f"{path} is damaged: {error}", "the file is cut off or was changed; copy or make the model again"
        ) from error
    except UserError as error:
        raise UserError(f"{path}: {error.message}", error.hint) from error


def _read_cameras_binary(data: bytes) -> dict[int, Camera]:
    cameras, offset = {}, 8
    for _ in range(_count(data, 24)):
        camera_id, model_id, width, height = struct.unpack_from("<IiQQ", data, offset)
        model = pycolmap.CameraModelId(model_id).name
        num_params = len(parameter_names(model))
        cameras[camera_id] = Camera(model, width, height, struct.unpack_from(f"<{num_params}d", data, offset + 24))
        offset += 24 + 8 * num_params
    return cameras


def _read_images_binary(data: bytes) -> list[ColmapImage]:
    images, offset = [], 8
    for _ in range(_count(data, 73)):
        _, *pose, camera_id = struct.unpack_from("<I7dI", data, offset)
        end = data.index(b"\0", offset + 64)
        images.append(_image(data[offset + 64 : end].decode("utf-8"), camera_id, pose))
        (num_points,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + _POINT2D_BYTES * num_points
        if offset > len(data):
            raise ValueError(f"it ends within image {images[-1].name}")
    return images


def _read_points_binary(data: bytes) -> np.ndarray:
    count, offset = _count(data, 51), 8
    points = np.empty((count, 3))
    for index in range(count):
        points[index] = struct.unpack_from("<3d", data, offset + 8)
        (track_length,) = struct.unpack_from("<Q", data, offset + 43)
        offset += 51 + _TRACK_ELEMENT_BYTES * track_length
        if offset > len(data):
            raise ValueError(f"it ends within point {index} of {count}")
    return _finite_points(points)


def _count(data: bytes, least_bytes: int) -> int:
    """The number of records that a file announces, if it is long enough to hold them."""
    (count,) = struct.unpack_from("<Q", data, 0)
    if count * least_bytes > len(data) - 8:
        raise ValueError(f"it announces {count} records, but has {len(data)} bytes")
    return count


def _read_cameras_text(data: bytes) -> dict[int, Camera]:
    cameras = {}
    for line in _lines(data):
        camera_id, model, width, height, *params = line.split()
        cameras[int(camera_id)] = Camera(model, int(width), int(height), tuple(float(value) for value in params))
    return cameras


def _read_images_text(data: bytes) -> list[ColmapImage]:
    # Every other line lists 2D points and may be empty, so empty lines count from the first image on.
    lines = data.decode("utf-8").splitlines()
    start = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
    images = []
    for line in lines[start::2]:
        if line.strip():
            _, *pose, camera_id, name = line.strip().split(maxsplit=9)
            images.append(_image(name, int(camera_id), [float(value) for value in pose]))
    return images


def _read_points_text(data: bytes) -> np.ndarray:
    points = [[float(value) for value in line.split(maxsplit=4)[1:4]] for line in _lines(data)]
    return _finite_points(np.array(points, dtype=np.float64).reshape(len(points), 3))


def _lines(data: bytes) -> list[str]:
    return [line for line in data.decode("utf-8").splitlines() if line.strip() and not line.startswith("#")]


def _image(name: str, camera_id: int, pose: list[float]) -> ColmapImage:
    """An image from its quaternion wxyz and translation of cam_from_world."""
    if len(pose) != 7 or not np.isfinite(pose).all():
        raise ValueError(f"the pose of image {name} is not 7 finite numbers")
    cam_from_world = rigid.from_parts(rigid.rotation_from_quaternion(np.array(pose[:4])), np.array(pose[4:]))
    return ColmapImage(name, camera_id, rigid.inverse(cam_from_world))


def _finite_points(points: np.ndarray) -> np.ndarray:
    if not np.isfinite(points).all():
        raise ValueError("a point's coordinates are not finite")
    return points
