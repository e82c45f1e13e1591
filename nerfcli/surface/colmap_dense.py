"""A workspace in the format of COLMAP's dense reconstruction: undistorted photos, cameras, depth and normal maps.

    images/, sparse/, stereo/depth_maps/NAME.geometric.bin, stereo/normal_maps/NAME.geometric.bin, stereo/fusion.cfg

Depth is along the optical axis, 0 where there is none; normals are in camera coordinates and face the camera. COLMAP's
fusion compares photos that share points, so the sparse model contains points of the field's surfaces with their tracks.

Source: COLMAP, mvs/workspace.cc and mvs/mat.h; the format of its documentation, "Output format".
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from nerfcli.cameras.formats.colmap import write_colmap_binary
from nerfcli.cameras.frame import Capture, Frame, Observations
from nerfcli.errors import UserError
from nerfcli.surface.points import Points
from nerfcli.surface.views import DepthView

_READABLE = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
_QUALITY = 95


def write_map(path: Path, values: np.ndarray) -> None:
    """Write a map (H, W) or (H, W, C) in COLMAP's format: sizes as text, then float32, channel by channel."""
    stacked = values[..., None] if values.ndim == 2 else values
    height, width, channels = stacked.shape
    path.parent.mkdir(parents=True, exist_ok=True)
    body = np.ascontiguousarray(np.nan_to_num(stacked).transpose(2, 0, 1), dtype="<f4").tobytes()
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + body)


def read_map(path: Path) -> np.ndarray:
    """Read what `write_map` wrote: (H, W, C) float32."""
    width, height, channels, body = path.read_bytes().split(b"&", 3)
    shape = (int(channels), int(height), int(width))
    return np.frombuffer(body, "<f4").reshape(shape).transpose(1, 2, 0)


def photo_name(name: str) -> str:
    """Return the name of a photo in the folder: unchanged if COLMAP reads its format, else with .png appended."""
    return name if Path(name).suffix.lower() in _READABLE else f"{name}.png"


def write_photo(path: Path, pixels: np.ndarray) -> None:
    """Write a photo (H, W, 3) uint8 sRGB in the format of its suffix.

    Raises:
        UserError: it cannot be encoded.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY] if path.suffix.lower() in (".jpg", ".jpeg") else []
    encoded, data = cv2.imencode(path.suffix, pixels[..., ::-1], quality)
    if not encoded:
        raise UserError(f"{path.name} cannot be written as {path.suffix}", "rename the photo to .jpg or .png")
    path.write_bytes(data.tobytes())


def write_stereo(folder: Path, views: Sequence[DepthView]) -> None:
    """Write the depth and normal maps of views, and the list of views that fusion reads."""
    for view in views:
        normals = view.normals
        defined = np.isfinite(view.depth) & np.isfinite(normals).all(-1)
        name = f"{view.frame.name}.geometric.bin"
        write_map(folder / "stereo" / "depth_maps" / name, np.where(defined, view.depth, 0.0))
        write_map(folder / "stereo" / "normal_maps" / name, np.where(defined[..., None], normals, 0.0))
    names = "".join(f"{view.frame.name}\n" for view in views)
    (folder / "stereo" / "fusion.cfg").write_text(names, encoding="utf-8")


def write_sparse(folder: Path, frames: Sequence[Frame], points: Points) -> None:
    """Write the pinhole cameras and the points with their tracks.

    Raises:
        UserError: a COLMAP model cannot hold a name.
    """
    frame_index, point_index, pixels = [], [], []
    for index, frame in enumerate(frames):
        rows = np.flatnonzero(points.seen[:, index])
        pose = frame.world_from_cam
        places, _ = frame.camera.project((points.places[rows] - pose[:3, 3]) @ pose[:3, :3])
        frame_index.append(np.full(len(rows), index))
        point_index.append(rows)
        pixels.append(places)
    observations = Observations(np.concatenate(frame_index), np.concatenate(point_index), np.concatenate(pixels))
    capture = Capture(
        tuple(frames), points.places, (), None, "colmap", colours=points.colours, observations=observations
    )
    write_colmap_binary(capture, folder / "sparse")
