"""The binary files of a COLMAP model: cameras.bin, images.bin and points3D.bin, little endian.

Lengths given in a file are checked against its size before anything of that length is allocated, and features and
points are read and written as whole arrays. Source: colmap.github.io/format.html; colmap
src/colmap/scene/reconstruction_io_binary.cc.
"""

import struct

import numpy as np
import pycolmap

from nerfcli.cameras.camera import Camera, parameter_names
from nerfcli.captures.formats.colmap_model import ColmapImage, ColmapModel, ImageRow, images_of_rows, pose_rows, tracks
from nerfcli.captures.formats.limits import checked_camera, plausible
from nerfcli.errors import UserError

_FEATURE = np.dtype([("pixel", "<f8", 2), ("point_id", "<i8")])
_POINT = np.dtype(
    [("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track_length", "<u8")]
)  # packed: 51 bytes
_TRACK_BYTES = 8  # image id and index of the feature

_MODELS = {value.value: name for name, value in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}

# COLMAP's value for the reprojection error of a point if it was not measured.
_NO_ERROR = -1.0


def cameras_from_bytes(data: bytes) -> dict[int, Camera]:
    """Return the cameras by id. Raises ValueError, struct.error or UserError where the bytes are damaged."""
    cameras, offset = {}, 8
    for _ in range(_count(data, 24)):
        camera_id, model_id, width, height = struct.unpack_from("<IiQQ", data, offset)
        if model_id not in _MODELS:
            raise UserError(
                f"camera {camera_id} has the camera model {model_id}, which COLMAP {pycolmap.__version__} lacks",
                f"a later or changed COLMAP wrote it; supported are {', '.join(sorted(_MODELS.values()))}: convert it "
                "there (colmap image_undistorter writes PINHOLE), or estimate the poses with nerfcli poses",
            )
        model = _MODELS[model_id]
        num_params = len(parameter_names(model))
        params = struct.unpack_from(f"<{num_params}d", data, offset + 24)
        if camera_id in cameras:
            raise ValueError(f"two cameras have the id {camera_id}")
        cameras[camera_id] = checked_camera(model, width, height, params, where=f"camera {camera_id}")
        offset += 24 + 8 * num_params
    _at_end(data, offset)
    return cameras


def images_from_bytes(data: bytes) -> tuple[list[ColmapImage], tuple[str, ...]]:
    """Return the images, in the file's order, and notes. Raises ValueError or struct.error where bytes are damaged."""
    rows, offset = list[ImageRow](), 8
    for _ in range(_count(data, 73)):
        image_id, *pose, camera_id = struct.unpack_from("<I7dI", data, offset)
        end = data.index(b"\0", offset + 64)
        name = data[offset + 64 : end].decode("utf-8")
        (num_features,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + _FEATURE.itemsize * num_features
        if offset > len(data):
            raise ValueError(f"it ends within image {name}")
        block = np.frombuffer(data, _FEATURE, count=num_features, offset=end + 9)
        rows.append((image_id, name, camera_id, pose, block["pixel"], block["point_id"]))
    _at_end(data, offset)
    return images_of_rows(rows)


def points_from_bytes(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ids (N,), positions (N, 3) and colours (N, 3). Raises ValueError or struct.error if bytes are damaged.

    The tracks are skipped, since the images list the same observations.
    """
    count, offset = _count(data, _POINT.itemsize), 8
    offsets = np.empty(count, dtype=np.int64)
    track_length = struct.Struct("<Q").unpack_from
    for index in range(count):
        offsets[index] = offset
        offset += _POINT.itemsize + _TRACK_BYTES * track_length(data, offset + 43)[0]
        if offset > len(data):
            raise ValueError(f"it ends within point {index} of {count}")
    _at_end(data, offset)
    points = _gathered(np.frombuffer(data, np.uint8), offsets).view(_POINT)[:, 0]
    if not plausible(points["xyz"]).all():
        index = int(np.argmin(plausible(points["xyz"])))
        raise ValueError(f"point {points['id'][index]} is at {points['xyz'][index]}")
    return points["id"].copy(), points["xyz"].copy(), points["rgb"].copy()


def cameras_to_bytes(model: ColmapModel) -> bytes:
    """Return the bytes of cameras.bin."""
    parts = [struct.pack("<Q", len(model.cameras))]
    for camera_id, camera in model.cameras.items():
        model_id = pycolmap.CameraModelId.__members__[camera.model].value
        parts.append(struct.pack("<IiQQ", camera_id, model_id, camera.width, camera.height))
        parts.append(struct.pack(f"<{len(camera.params)}d", *camera.params))
    return b"".join(parts)


def images_to_bytes(model: ColmapModel) -> bytes:
    """Return the bytes of images.bin."""
    parts = [struct.pack("<Q", len(model.images))]
    for image, pose in zip(model.images, pose_rows(model).tolist(), strict=True):
        features = np.empty(len(image.pixels), _FEATURE)
        features["pixel"], features["point_id"] = image.pixels, image.point_ids
        parts.append(struct.pack("<I7dI", image.image_id, *pose, image.camera_id))
        parts.append(image.name.encode("utf-8") + b"\0" + struct.pack("<Q", len(features)))
        parts.append(features.tobytes())
    return b"".join(parts)


def points_to_bytes(model: ColmapModel) -> bytes:
    """Return the bytes of points3D.bin; the tracks are those of the images' features."""
    elements, lengths = tracks(model)
    points = np.empty(len(model.points), _POINT)
    points["id"], points["xyz"], points["rgb"] = model.point_ids, model.points, model.colours
    points["error"], points["track_length"] = _NO_ERROR, lengths
    track_starts = np.cumsum(lengths) - lengths
    body = np.empty(points.nbytes + elements.nbytes, np.uint8)
    starts = _POINT.itemsize * np.arange(len(points)) + _TRACK_BYTES * track_starts
    _scatter(body, starts, points.view(np.uint8).reshape(len(points), _POINT.itemsize))
    point_of_element = np.repeat(np.arange(len(points)), lengths)
    starts = _POINT.itemsize * (point_of_element + 1) + _TRACK_BYTES * np.arange(len(elements))
    _scatter(body, starts, elements.astype("<u4").view(np.uint8))
    return struct.pack("<Q", len(points)) + body.tobytes()


def _gathered(data: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the records (N, bytes of a point) that begin at the offsets (N,)."""
    records = np.empty((len(offsets), _POINT.itemsize), np.uint8)
    for column in range(_POINT.itemsize):
        records[:, column] = data[offsets + column]
    return records


def _scatter(body: np.ndarray, offsets: np.ndarray, records: np.ndarray) -> None:
    """Write the records (N, bytes) into `body` at the offsets (N,)."""
    for column in range(records.shape[1]):
        body[offsets + column] = records[:, column]


def _count(data: bytes, least_bytes: int) -> int:
    """Return the number of records given in a file, if the file is long enough to hold them."""
    (count,) = struct.unpack_from("<Q", data, 0)
    if count * least_bytes > len(data) - 8:
        raise ValueError(f"it announces {count} records, but has {len(data)} bytes")
    return count


def _at_end(data: bytes, offset: int) -> None:
    """Raise if there are bytes after the last record, so that the count at the beginning must be wrong."""
    if offset != len(data):
        raise ValueError(f"its records end at byte {offset}, but it has {len(data)} bytes")
