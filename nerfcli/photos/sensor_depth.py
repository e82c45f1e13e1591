"""Depth maps of sensors that were taken with photos, as programs and apps write them.

    .png, .tif, .pgm   integer levels, mostly of 16 bits and 1 mm, or float pixels
    .npy               an array (height, width)
    .exr               the first channel, or Z
    .depth, .conf      float32 and bytes compressed with LZFSE, as in a .r3d file of Record3D, shaped like the photo

0, numbers that are not finite, and the highest level of 16 bits mean that nothing was measured. A map is for the photo
as it is stored, or upright: then it has the shape of the upright photo.
"""

import importlib
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from numpy.lib import format as npy_format

from nerfcli.cameras.frame import SensorDepth
from nerfcli.errors import UserError, reason_of
from nerfcli.photos.exif import read_exif
from nerfcli.photos.images import upright

# Neighbours whose depths differ by more than this factor are the two sides of an edge, where sensors mix both: surfaces
# at 75 degrees from the line of sight stay below at 256 pixels for 60 degrees.
EDGE_RATIO = 1.06
# Aspect ratios of a map and its photo agree within this fraction.
SAME_SHAPE = 0.03

_HINT = "restore the file, or train with --no-sensor-depth"
_UNKNOWN_LEVEL = 65535


@dataclass(frozen=True)
class DepthReadings:
    """What a sensor measured.

    Args:
        z: (H, W) float32 along the optical axis, scene units of the capture; NaN where nothing was measured.
        confidence: (H, W) float32 in [0, 1], 1 if the sensor states none.
    """

    z: np.ndarray
    confidence: np.ndarray


def read_sensor_depth(depth: SensorDepth, photo: Path) -> DepthReadings:
    """Read a depth map and its confidence, turned like the upright photo; pixels at edges of depth are left out.

    Raises:
        UserError: a file is missing or damaged, or has another shape than the photo.
    """
    exif = read_exif(photo)
    stored = (exif.height, exif.width) if exif.orientation >= 5 else (exif.width, exif.height)
    z = _numbers(depth.path, stored[0] / stored[1])
    if z.dtype.newbyteorder("=") == np.uint16:
        z = np.where(z == _UNKNOWN_LEVEL, 0, z)
    z = z.astype(np.float32) * np.float32(depth.unit)
    z[~((z > 0) & np.isfinite(z))] = np.nan
    confidence = np.ones_like(z) if depth.confidence is None else _confidence(depth.confidence, z.shape)
    z = np.where(confidence > 0, _without_edges(z), np.nan)
    if exif.orientation >= 5 and _is_shaped(z, stored) and not _is_shaped(z, stored[::-1]):
        z, confidence = upright(z, exif.orientation), upright(confidence, exif.orientation)
    if not _is_shaped(z, (exif.width, exif.height)):
        shape = f"{z.shape[1]}x{z.shape[0]}, which is not the shape of its {exif.width}x{exif.height} photo"
        raise UserError(f"{depth.path} is {shape}", _HINT)
    return DepthReadings(z, confidence)


def _is_shaped(z: np.ndarray, size: tuple[int, int]) -> bool:
    return abs(math.log(z.shape[1] * size[1] / (z.shape[0] * size[0]))) < SAME_SHAPE


def _numbers(path: Path, aspect: float) -> np.ndarray:
    """Return the numbers of a file as it has them, (height, width); `aspect` is that of the stored photo."""
    if not path.is_file():
        raise UserError(f"{path} does not exist", _HINT)
    try:
        match path.suffix.lower():
            case ".npy":
                with path.open("rb") as file:
                    found = npy_format.read_array(file, allow_pickle=False)
            case ".exr":
                channels = OpenEXR.File(str(path), separate_channels=True).channels()
                found = np.asarray(channels.get("Z", next(iter(channels.values()))).pixels)
            case ".depth" | ".conf":
                found = _unpacked(path, np.float32 if path.suffix.lower() == ".depth" else np.uint8, aspect)
            case _:  # with OpenCV: Pillow widens levels of a PGM to 16 bits, and garbles 32 bits of big-endian TIFF
                found = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
                if found is None:
                    raise ValueError("damaged, or no picture")
    except (OSError, ValueError, RuntimeError, TypeError, EOFError, StopIteration, cv2.error) as error:
        raise UserError(f"{path} is not a depth map: {reason_of(error)}", _HINT) from error
    found = found.squeeze()
    if found.ndim != 2 or not found.size or found.dtype.kind not in "uif":
        raise UserError(f"{path} is not a depth map: numbers of type {found.dtype} in shape {found.shape}", _HINT)
    return found


def _unpacked(path: Path, dtype: type, aspect: float) -> np.ndarray:
    """Return the numbers of a file compressed with LZFSE, which have the aspect ratio of the photo."""
    try:
        liblzfse = importlib.import_module("liblzfse")
    except ImportError as error:
        hint = "install it with: pip install 'nerfcli[record3d]'; or export as \"EXR + RGB\" from Record3D"
        raise UserError(f"{path} is compressed with LZFSE, which needs pyliblzfse", hint) from error
    try:
        values = np.frombuffer(liblzfse.decompress(path.read_bytes()), dtype)
    except liblzfse.error as error:  # derived from Exception alone
        raise ValueError(f"damaged LZFSE data: {error}") from error
    return values.reshape(round(math.sqrt(len(values) / aspect)), -1)


def _confidence(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Return a confidence in [0, 1]; the highest level is 2 in ARKit's maps, 255 in pictures."""
    levels = _numbers(path, shape[1] / shape[0]).astype(np.float32)
    if levels.shape != shape:
        raise UserError(f"{path} has shape {levels.shape}, its depth map {shape}", _HINT)
    return levels / (2.0 if levels.max(initial=0.0) <= 2.0 else 255.0)


def _without_edges(z: np.ndarray) -> np.ndarray:
    """Return a depth map with NaN where the depth of neighbours differs by more than `EDGE_RATIO`."""
    around = np.ones((3, 3), np.uint8)
    known = np.isfinite(z)
    farthest = cv2.dilate(np.where(known, z, 0.0), around)
    nearest = cv2.erode(np.where(known, z, np.inf), around)
    return np.where(known & (farthest / EDGE_RATIO <= nearest), z, np.nan)
