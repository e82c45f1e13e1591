"""nerfstudio's camera-path JSON: the file that its viewer exports and that `ns-render camera-path` follows.

    {"camera_type": "perspective" | "fisheye" | "equirectangular", "render_width", "render_height", "fps", "seconds",
     "camera_path": [{"camera_to_world": 16 numbers row by row, "fov": degrees, "aspect"}, ...], "keyframes": [...]}

Poses are world_from_cam with OpenGL axes. Focal lengths are (render_height / 2) / tan(fov / 2) for perspective and
fisheye alike, with square pixels and the principal point in the middle; aspect is not used. nerfstudio's fisheye is the
equidistant one, radius = focal length * angle, so a fisheye's fov is not its field of view: with fov 90, a picture is
114.6 degrees high. Keyframes are the state of the viewer's editor; only camera_path is rendered.

A path drawn in nerfstudio's viewer is in its normalised world, not in that of the scene.

Sources: nerfstudio, cameras/camera_paths.py get_path_from_json; viewer/render_panel.py _write_json; cameras/cameras.py
for the fisheye.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.atomic import write_json
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame, Size
from nerfcli.captures.axes import opencv_pose, pose_in_axes
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import number, read_json_object, record_of, size_of, vector
from nerfcli.captures.formats.format import Format, find_json, has_keys
from nerfcli.captures.formats.limits import rigid_pose
from nerfcli.captures.formats.unsupported import distortion, projection
from nerfcli.errors import UserError

DEFAULT_FPS = 24.0

_MODELS = {"perspective": "PINHOLE", "fisheye": "OPENCV_FISHEYE", "equirectangular": "EQUIRECTANGULAR"}


@dataclass(frozen=True)
class CameraPath:
    """The views of a path, in order, and the number of frames per second."""

    frames: tuple[Frame, ...]
    fps: float


def read_path(path: Path) -> CameraPath:
    """Read the path in a nerfstudio camera-path JSON; without fps or seconds it has 24 frames per second."""
    content = read_json_object(path)
    kind = content.get("camera_type", "perspective")
    if not isinstance(kind, str) or kind.lower() not in _MODELS:
        raise UserError(f"{path}: camera_type is {kind!r}", f"expected {', '.join(_MODELS)}")
    width, height = (number(content, key, str(path)) for key in ("render_width", "render_height"))
    size = size_of(width, height, str(path))
    records = content.get("camera_path")
    if not isinstance(records, list) or not records:
        raise UserError(
            f"{path}: has no list camera_path",
            'expected "camera_path": [{"camera_to_world": 16 numbers, "fov": degrees}, ...]; keyframes are not enough',
        )
    frames = []
    for index, record in enumerate(records):
        where = f"{path}: camera_path[{index}]"
        view = record_of(record, where)
        frames.append(Frame(f"frame_{index:04d}", _camera(view, kind.lower(), size, where), _pose(view, where)))
    return CameraPath(tuple(frames), _fps(content, len(frames), path))


def losses_camera_path(capture: Capture) -> tuple[str, ...]:
    """List the properties of a capture's cameras that a camera path cannot hold, one clause each."""
    frames = capture.frames
    kept = _common_cameras(frames)
    counts = {
        "type of lens": sum(_kind(f.camera) != _kind(k) for f, k in zip(frames, kept, strict=True)),
        "lens distortion": sum(bool(distortion(f.camera)) for f in frames),
        "principal point": sum(f.camera != f.camera.centred() for f in frames),
        "focal lengths that differ in x and y": sum(len(set(f.camera.focal_lengths)) > 1 for f in frames),
        "picture size": sum(f.camera.size != k.size for f, k in zip(frames, kept, strict=True)),
    }
    return tuple(f"{name} of {count} of {len(frames)} views" for name, count in counts.items() if count)


def write_camera_path(capture: Capture, path: Path, *, fps: float = DEFAULT_FPS) -> None:
    """Write the capture's views as a camera path, atomically; each one is a keyframe too, so that the viewer shows it.

    The file has one type of lens and one picture size: those of most views. See `losses_camera_path`.
    """
    if not capture.frames:
        raise UserError(f"there are no views to write to {path}", "a camera path needs at least one view")
    cameras = _common_cameras(capture.frames)
    width, height = cameras[0].size
    records = []
    for frame, camera in zip(capture.frames, cameras, strict=True):
        pose = pose_in_axes(frame.world_from_cam, "opengl").ravel().tolist()
        fov = 90.0 if camera.is_spherical else math.degrees(2 * math.atan2(height / 2, camera.focal_px))
        records.append({"camera_to_world": pose, "fov": fov, "aspect": width / height})
    content = {
        "camera_type": _kind(cameras[0]),
        "render_height": height,
        "render_width": width,
        "fps": fps,
        "seconds": len(records) / fps,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "default_fov": records[0]["fov"],
        "keyframes": [{"matrix": r["camera_to_world"], "fov": r["fov"], "aspect": r["aspect"]} for r in records],
        "camera_path": records,
    }
    write_json(path, content)


def _camera(view: dict[str, Any], kind: str, size: Size, where: str) -> Camera:
    width, height = size
    if kind == "equirectangular":
        return Camera("EQUIRECTANGULAR", width, height, (width, height))
    fov = number(view, "fov", where)
    if not 0 < fov < 180:
        raise UserError(f"{where}: fov is {fov}", "expected the vertical field of view in degrees, between 0 and 180")
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    pinhole = Camera.pinhole(width, height, focal)
    return pinhole if kind == "perspective" else Camera("OPENCV_FISHEYE", width, height, (*pinhole.params, 0, 0, 0, 0))


def _pose(view: dict[str, Any], where: str) -> np.ndarray:
    """Return `world_from_cam` (4, 4), OpenCV axes, exactly rigid."""
    key = "camera_to_world"
    values = view.get(key)
    if isinstance(values, list) and all(isinstance(row, list) for row in values):
        values = [value for row in values for value in row]
    matrix = vector({key: values}, key, 16, where).reshape(4, 4)
    return opencv_pose(rigid_pose(matrix, f"{where}.{key}"), "opengl")


def _fps(content: dict[str, Any], count: int, path: Path) -> float:
    """Return the frames per second: fps if given, else from seconds, else 24."""
    for key in ("fps", "seconds"):
        if content.get(key) is None:
            continue
        value = number(content, key, str(path))
        if not value > 0:
            raise UserError(f"{path}: {key} is {value:g}", "expected a number above 0")
        return value if key == "fps" else count / value
    return DEFAULT_FPS


def _common_cameras(frames: Sequence[Frame]) -> tuple[Camera, ...]:
    """Return the frames' cameras as the format can hold them: one type, one size, square pixels, no distortion."""
    if not frames:
        return ()
    kind = Counter(_kind(frame.camera) for frame in frames).most_common(1)[0][0]
    width, height = Counter(frame.camera.size for frame in frames).most_common(1)[0][0]
    kept = []
    for camera in (frame.camera for frame in frames):
        # The format keeps the vertical field of view, whatever the picture's size.
        focal = camera.focal_px * height / camera.height
        params = (width, height) if kind == "equirectangular" else (focal, focal, width / 2, height / 2)
        kept.append(Camera(_MODELS[kind], width, height, params + (0.0,) * 4 * (kind == "fisheye")))
    return tuple(kept)


def _kind(camera: Camera) -> str:
    return "equirectangular" if camera.is_spherical else projection(camera)


def find_camera_path(path: Path) -> Path | None:
    """Find a JSON file that has the key camera_path and no frames, or the file camera_path.json of a folder."""
    found = find_json(path, opening="{", name="camera_path.json")
    if found is None or path.is_dir():
        return found
    return found if has_keys(found, "camera_path") and not has_keys(found, "frames") else None


FORMAT = Format(
    "camera-path",
    "a camera path of nerfstudio's viewer",
    find_camera_path,
    lambda path, given: Capture(read_path(path).frames, kind="camera-path"),
    axes="opengl",
    open_axes=True,
    lacks=("cameras", "points"),
)
