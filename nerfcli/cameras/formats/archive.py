"""A capture as one plain .npz file: every number exactly, no pickle, readable with NumPy alone. Files are untrusted.

version                 1
kind, unit              text
unit_source             text, empty if the source of the scale is unknown; may be missing, like pixels
pixels                  text: "stored" or "upright", see `Capture`
names                   (F,) text
images, masks           (F,) text: paths relative to the file's folder; empty where a frame has none
splits                  (F,) text: "train", "val", "test" or empty
world_from_cam          (F, 4, 4) float64, OpenCV axes
camera_index            (F,) int64, into the next three
camera_models           (C,) text: COLMAP's names
camera_sizes            (C, 2) int64: width, height in pixels
camera_params           (C, P) float64 in COLMAP's order, NaN beyond a model's number of parameters
points                  (N, 3) float64
colours                 (N, 3) uint8                            these five only
depth_bounds            (F, 2) float64                          where the
observation_frames      (M,) int64                              capture has
observation_points      (M,) int64, -1: no point                them
observation_pixels      (M, 2) float64
missing                 (K,) text

"""

import io
import lzma
import math
import os
import struct
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.lib import format as npy_format

from nerfcli.atomic import atomic_path
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.limits import checked_camera, plausible, rigid_poses
from nerfcli.cameras.formats.photo_names import seen_from
from nerfcli.cameras.frame import Capture, Frame, Observations
from nerfcli.errors import UserError

ARCHIVE_VERSION = 1

_HINT = "the file is cut off or was changed; write it again with nerfcli"
_UNITS = ("arbitrary", "metre")
_SPLITS = ("", "train", "val", "test")
_HEADERS = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}


def losses_npz(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that the file cannot hold: nothing."""
    return ()


def write_npz(capture: Capture, path: Path) -> None:
    """Write a capture, atomically.

    Raises:
        UserError: the file cannot be written.
    """
    cameras: dict[Camera, int] = {}
    camera_index = [cameras.setdefault(frame.camera, len(cameras)) for frame in capture.frames]
    params = np.full((len(cameras), max((len(camera.params) for camera in cameras), default=0)), np.nan)
    for row, camera in zip(params, cameras, strict=True):
        row[: len(camera.params)] = camera.params
    arrays = {
        "version": np.array(ARCHIVE_VERSION),
        "kind": np.array(capture.kind),
        "unit": np.array(capture.unit),
        "unit_source": np.array(capture.unit_source or ""),
        "pixels": np.array(capture.pixels),
        "names": np.array([frame.name for frame in capture.frames], dtype=np.str_),
        "images": np.array([seen_from(path.parent, frame.image) for frame in capture.frames], dtype=np.str_),
        "masks": np.array([seen_from(path.parent, frame.mask) for frame in capture.frames], dtype=np.str_),
        "splits": np.array([frame.split or "" for frame in capture.frames], dtype=np.str_),
        "world_from_cam": np.array([frame.world_from_cam for frame in capture.frames]).reshape(-1, 4, 4),
        "camera_index": np.array(camera_index, dtype=np.int64),
        "camera_models": np.array([camera.model for camera in cameras], dtype=np.str_),
        "camera_sizes": np.array([camera.size for camera in cameras], dtype=np.int64).reshape(-1, 2),
        "camera_params": params,
        "points": np.asarray(capture.points, dtype=np.float64),
        "missing": np.array(capture.missing, dtype=np.str_),
    }
    if capture.colours is not None:
        arrays["colours"] = capture.colours
    if capture.depth_bounds is not None:
        arrays["depth_bounds"] = np.asarray(capture.depth_bounds, dtype=np.float64)
    if capture.observations is not None:
        arrays["observation_frames"] = capture.observations.frame_index
        arrays["observation_points"] = capture.observations.point_index
        arrays["observation_pixels"] = capture.observations.pixels
    with atomic_path(path) as partial, partial.open("wb") as stream:
        np.savez(stream, **arrays)


def parse_npz(path: Path) -> Capture:
    """Read the capture in a file that `write_npz` wrote, exactly; paths are joined to the file's folder.

    Raises:
        UserError: the file is missing, damaged or of another kind; the file and the array are named.
    """
    arrays = Arrays(path)
    version = arrays.numbers("version", (), integer=True)
    if int(version) != ARCHIVE_VERSION:
        raise UserError(f"{path}: unknown version {int(version)}, expected {ARCHIVE_VERSION}", "update nerfcli")
    names = arrays.texts("names")
    count = len(names)
    if not count or not all(names) or len(set(names)) < count:
        raise arrays.damaged("names", "no frames, a frame without a name, or two frames with the same name")
    cameras = _cameras(arrays)
    camera_index = arrays.numbers("camera_index", (count,), integer=True)
    if ((camera_index < 0) | (camera_index >= len(cameras))).any():
        raise arrays.damaged("camera_index", f"a camera index outside the list of {len(cameras)}")
    matrices = arrays.numbers("world_from_cam", (count, 4, 4))
    poses = rigid_poses(matrices, lambda index: f"{path}: world_from_cam[{index}]")
    splits, images, masks = (arrays.texts(name, count) for name in ("splits", "images", "masks"))
    if not set(splits) <= set(_SPLITS):
        raise arrays.damaged("splits", "a value other than train, val and test")
    frames = tuple(
        Frame(
            name,
            cameras[camera],
            pose,
            image=_joined(path.parent, image),
            mask=_joined(path.parent, mask),
            split=split or None,
        )
        for name, camera, pose, image, mask, split in zip(
            names, camera_index.tolist(), poses, images, masks, splits, strict=True
        )
    )
    points = arrays.numbers("points", (None, 3))
    unit = arrays.text("unit")
    if unit not in _UNITS:
        raise arrays.damaged("unit", f"{unit!r}, expected {' or '.join(_UNITS)}")
    if not plausible(points).all():
        raise arrays.damaged("points", "a position that is not finite or too large")
    return Capture(
        frames,
        points,
        tuple(arrays.texts("missing")),
        _depth_bounds(arrays, count),
        arrays.text("kind"),
        colours=_colours(arrays, len(points)),
        observations=_observations(arrays, count, num_points=len(points)),
        unit=unit,
        unit_source=(arrays.text("unit_source") or None) if "unit_source" in arrays else None,
        pixels=_pixels(arrays),
    )


class Arrays:
    """The arrays of an .npz file, checked for type and shape as they are taken out.

    Raises:
        UserError: the file, or an array that is taken out, is missing or damaged; it is named.
    """

    def __init__(self, path: Path):
        self.path = path
        try:
            with zipfile.ZipFile(path) as archive:
                self._bytes = {name.removesuffix(".npy"): archive.read(name) for name in archive.namelist()}
        except FileNotFoundError as error:
            raise UserError(f"{path}: {error.strerror}", "give the .npz file of a capture") from error
        except (
            *(OSError, EOFError, ValueError, KeyError, IndexError, OverflowError, NotImplementedError, RuntimeError),
            *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error),
        ) as error:
            raise UserError(f"{path} is not a readable .npz file ({type(error).__name__}: {error})", _HINT) from error

    def __contains__(self, name: str) -> bool:
        return name in self._bytes

    def damaged(self, name: str, what: str) -> UserError:
        """Return the error that says what is wrong with an array."""
        return UserError(f"{self.path}: {name}: {what}", _HINT)

    def numbers(self, name: str, shape: tuple[int | None, ...], *, integer: bool = False) -> np.ndarray:
        """Return the array of this name as float64 or int64; None in the shape stands for any length."""
        array = self._array(name)
        fits = array.ndim == len(shape) and all(
            want in (None, got) for want, got in zip(shape, array.shape, strict=True)
        )
        if not fits or array.dtype.kind not in ("iu" if integer else "iuf"):
            wanted = " x ".join("any" if length is None else str(length) for length in shape) or "one"
            raise self.damaged(name, f"{array.shape} values of type {array.dtype}, expected {wanted} numbers")
        return array.astype(np.int64 if integer else np.float64)

    def texts(self, name: str, count: int | None = None) -> list[str]:
        """Return the texts in the array of this name; there must be `count` of them if given."""
        array = self._array(name)
        if array.dtype.kind != "U" or array.ndim != 1 or (count is not None and len(array) != count):
            raise self.damaged(
                name, f"{array.shape} values of type {array.dtype}, expected {count or 'a row of'} texts"
            )
        try:
            texts = array.tolist()
            "".join(texts).encode("utf-8")
        except (ValueError, SystemError) as error:  # NumPy raises SystemError for a character beyond Unicode
            raise self.damaged(name, "invalid characters") from error
        return texts

    def text(self, name: str) -> str:
        """Return the single text in the array of this name."""
        array = self._array(name)
        if array.dtype.kind != "U" or array.shape != ():
            raise self.damaged(name, f"{array.shape} values of type {array.dtype}, expected one text")
        try:
            return str(array.item())
        except (ValueError, SystemError) as error:
            raise self.damaged(name, "invalid characters") from error

    def _array(self, name: str) -> np.ndarray:
        if name not in self._bytes:
            raise UserError(
                f"{self.path}: {name} is missing", "expected the .npz file of a capture, as written by nerfcli convert"
            )
        try:
            return array_from_npy(self._bytes[name])
        except ValueError as error:
            raise self.damaged(name, str(error)) from error


def _cameras(arrays: Arrays) -> list[Camera]:
    models = arrays.texts("camera_models")
    sizes = arrays.numbers("camera_sizes", (len(models), 2), integer=True).tolist()
    params = arrays.numbers("camera_params", (len(models), None))
    cameras = []
    for index, (model, (width, height), row) in enumerate(zip(models, sizes, params, strict=True)):
        where = f"{arrays.path}: camera {index}"
        length = int(np.argmax(np.isnan(row))) if np.isnan(row).any() else len(row)
        if not np.isnan(row[length:]).all():
            raise UserError(f"{where}: a parameter is NaN", _HINT)
        cameras.append(checked_camera(model, width, height, tuple(row[:length].tolist()), where=where))
    return cameras


def _pixels(arrays: Arrays) -> str:
    pixels = arrays.text("pixels") if "pixels" in arrays else "stored"
    if pixels not in ("stored", "upright"):
        raise arrays.damaged("pixels", f"{pixels!r}, expected stored or upright")
    return pixels


def _colours(arrays: Arrays, num_points: int) -> np.ndarray | None:
    if "colours" not in arrays:
        return None
    colours = arrays.numbers("colours", (num_points, 3), integer=True)
    if ((colours < 0) | (colours > 255)).any():
        raise arrays.damaged("colours", "a number that is not between 0 and 255")
    return colours.astype(np.uint8)


def _depth_bounds(arrays: Arrays, num_frames: int) -> np.ndarray | None:
    if "depth_bounds" not in arrays:
        return None
    bounds = arrays.numbers("depth_bounds", (num_frames, 2))
    if not (plausible(bounds) & (bounds[:, 0] > 0) & (bounds[:, 0] < bounds[:, 1])).all():
        raise arrays.damaged("depth_bounds", "expected 0 < near < far in every row")
    return bounds


def _observations(arrays: Arrays, num_frames: int, *, num_points: int) -> Observations | None:
    if "observation_pixels" not in arrays:
        return None
    pixels = arrays.numbers("observation_pixels", (None, 2))
    frame_index = arrays.numbers("observation_frames", (len(pixels),), integer=True)
    point_index = arrays.numbers("observation_points", (len(pixels),), integer=True)
    if not plausible(pixels).all():
        raise arrays.damaged("observation_pixels", "a position that is not finite or too large")
    if ((frame_index < 0) | (frame_index >= num_frames)).any():
        raise arrays.damaged("observation_frames", f"a frame index outside the list of {num_frames}")
    if ((point_index < -1) | (point_index >= num_points)).any():
        raise arrays.damaged("observation_points", f"a point index outside the list of {num_points}")
    return Observations(frame_index, point_index, pixels)


def _joined(folder: Path, text: str) -> Path | None:
    return Path(os.path.normpath(folder / text)) if text else None


def array_from_npy(data: bytes) -> np.ndarray:
    """Return the array that the bytes of an .npy file hold; it shares their memory and is read-only.

    Raises:
        ValueError: not an .npy file, an array of Python objects, or more or fewer bytes than the header's shape needs.
    """
    stream = io.BytesIO(data)
    try:
        version = npy_format.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"version {version} of the format")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about headers that Python 2 wrote
            shape, by_columns, dtype = _HEADERS[version](stream)
    except (TypeError, KeyError, SyntaxError, OverflowError, RecursionError, MemoryError, tokenize.TokenError) as error:
        raise ValueError(f"its header is invalid ({type(error).__name__})") from error
    start = stream.tell()
    if dtype.hasobject or dtype.itemsize == 0:
        raise ValueError(f"it contains values of type {dtype}")
    if any(length < 0 for length in shape) or math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ValueError(f"its header announces {shape} values of {dtype}, but {len(data) - start} bytes follow")
    if math.prod(shape) == 0:
        return np.zeros(shape, dtype)
    values = np.frombuffer(data, dtype=dtype, offset=start)
    return values.reshape(shape[::-1]).T if by_columns else values.reshape(shape)
