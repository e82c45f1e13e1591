"""kapture's folders, format 1.0 and 1.1, read only: sensors/ with sensors.txt, records_camera.txt and trajectories.txt.

A line of records_camera.txt is "timestamp, sensor, path in records_data/"; of trajectories.txt, "timestamp, device, qw,
qx, qy, qz, tx, ty, tz" with the transform device_from_world, where a device is a sensor or a rig; of rigs.txt, "rig,
device, ..." with device_from_rig. Parts of a transform that are not known are empty. Quaternions have any length. A
camera in sensors.txt is "sensor, name, camera, MODEL, width, height, ..." with COLMAP's models and parameters.
reconstruction/points3d.txt: x, y, z, and red, green, blue.
Source: naver/kapture kapture_format.adoc; kapture/core/Trajectories.py and PoseTransform.py.
"""

from pathlib import Path

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import Row, malformed, name_of, numbers, read_rows, shown, size_of
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.limits import NotFiniteError, checked_camera, left_out, without
from nerfcli.captures.formats.photo_names import GIVE_CAMERA, with_photos
from nerfcli.errors import UserError, several

SENSORS = "sensors"
_FILES = ("sensors.txt", "records_camera.txt", "trajectories.txt")
_EXPECTED = "expected a file of kapture"
_UNKNOWN = "UNKNOWN_CAMERA"
# Rigs in rigs; more is a circle.
_MOST_LEVELS = 8


def parse_kapture(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the photos that have a pose, of all cameras; the user gives that of sensors whose model is not known."""
    home = folder / SENSORS
    cameras = {row.cells[0]: row for row in _rows(home / "sensors.txt", least=3) if row.cells[2] == "camera"}
    if given.camera is not None and not any(map(_is_unknown, cameras.values())):
        hint = f"remove --intrinsics, which is for those of the model {_UNKNOWN}"
        raise UserError(f"{home / 'sensors.txt'}: its cameras are all calibrated", hint, exit_code=2)
    poses = {(row.cells[0], row.cells[1]): row for row in _rows(home / "trajectories.txt", least=9)}
    rigs: dict[str, list[Row]] = {}
    for row in _rows(home / "rigs.txt", least=9) if (home / "rigs.txt").is_file() else []:
        rigs.setdefault(row.cells[1], []).append(row)
    known: dict[str, Camera] = {}
    frames, unposed, lost = [], [], list[tuple[str, UserError]]()
    for row in _rows(home / "records_camera.txt", least=3):
        time, sensor = row.cells[:2]
        name = name_of(row.cells[2], row.where)
        try:
            device_from_world = _pose_at(time, sensor, poses, rigs)
        except NotFiniteError as error:
            lost.append((name, error))
            continue
        if device_from_world is None:
            unposed.append(name)
            continue
        if sensor not in cameras:
            raise malformed(row.where, f"its sensor is {shown(sensor)}", "expected a camera of sensors.txt")
        if sensor not in known:
            known[sensor] = _camera(cameras[sensor], given.camera)
        frames.append(Frame(name, known[sensor], rigid.inverse(device_from_world)))
    points, colours = _points(folder / "reconstruction/points3d.txt")
    notes = (*left_out(lost, len(frames) + len(lost)), *without(unposed, "a pose"))
    capture = Capture(tuple(frames), points, kind="kapture", colours=colours, notes=notes)
    return with_photos(capture, home, given=given.images, folders=("records_data",))


def _rows(path: Path, *, least: int) -> list[Row]:
    """Return the lines of a table as cells without the spaces around them."""
    rows = read_rows(path, _EXPECTED, separator=",")
    for row in rows:
        if len(row.cells) < least:
            found = several(len(row.cells), "value")
            raise malformed(row.where, f"has {found}", f"expected {least} or more, with commas")
    return rows


def _pose_at(
    time: str, device: str, poses: dict[tuple[str, str], Row], rigs: dict[str, list[Row]], level: int = 0
) -> np.ndarray | None:
    """Return device_from_world at a time: the device's own pose, or that of a rig that it is in; None without one."""
    row = poses.get((time, device))
    if (own := _transform(row) if row else None) is not None:
        return own
    for rig in rigs.get(device, []) if level < _MOST_LEVELS else []:
        device_from_rig, rig_from_world = _transform(rig), _pose_at(time, rig.cells[0], poses, rigs, level + 1)
        if device_from_rig is not None and rig_from_world is not None:
            return device_from_rig @ rig_from_world
    return None


def _transform(row: Row) -> np.ndarray | None:
    """Return the transform (4, 4) of a row's last seven cells; None if a part of it is not known."""
    cells = [*row.cells[2:9], *filter(None, row.cells[9:])]  # a comma may end the line
    if not all(cells[:7]):
        return None
    values = np.array(numbers(cells, 7, row.where))
    if not values[:4].any():
        raise NotFiniteError(f"{row.where}: its quaternion has length 0", "expected qw, qx, qy, qz")
    return rigid.from_parts(rigid.rotation_from_quaternion(values[:4]), values[4:])


def _is_unknown(row: Row) -> bool:
    return _UNKNOWN in map(str.upper, row.cells[3:4])


def _camera(row: Row, given: Camera | None) -> Camera:
    if len(row.cells) < 6:
        raise malformed(row.where, "has no camera model with width and height", "expected MODEL, width, height, ...")
    model, *words = row.cells[3:]
    width, height, *params = numbers(words, len(words), row.where)
    size = size_of(width, height, row.where)
    if not _is_unknown(row):
        return checked_camera(model.upper(), *size, tuple(params), where=row.where)
    if given is None:
        raise UserError(f"{row.where}: the camera is not calibrated ({_UNKNOWN})", GIVE_CAMERA)
    return given.resized(*size)


def _points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the positions (N, 3) and colours (N, 3) of the points; none if there is no such file."""
    rows = _rows(path, least=3) if path.is_file() else []
    if not rows:
        return np.zeros((0, 3)), None
    table = np.array([numbers(row.cells[:6], len(rows[0].cells[:6]), row.where) for row in rows])
    if table.shape[1] < 6:
        return table[:, :3], None
    return table[:, :3], np.clip(table[:, 3:6], 0, 255).astype(np.uint8)


def find_kapture(path: Path) -> Path | None:
    """Find the folder that holds sensors/ of kapture, given it, sensors/ itself or a file in it."""
    folder = path.parent if path.is_file() and path.name in _FILES else path
    folder = folder.parent if folder.name == SENSORS and (folder / _FILES[0]).is_file() else folder
    return folder if all((folder / SENSORS / name).is_file() for name in _FILES) else None


FORMAT = Format("kapture", "kapture", find_kapture, parse_kapture, takes_camera=True)
