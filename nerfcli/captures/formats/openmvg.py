"""OpenMVG's sfm_data.json, read only; openMVG_main_ConvertSfM_DataFormat makes one of an sfm_data.bin.

A view names its picture, a pose and intrinsics by their keys. A pose is the rotation cam_from_world, row by row, and
the camera's centre, with OpenCV axes. Views and intrinsics are written by the library cereal: the record is in
value.ptr_wrapper.data, some versions put the parent's fields into value0 of it, and the name of a type is given where
it occurs first, by its number with the highest bit set, and later by the number.
    pinhole: focal_length, principal_point;  pinhole_radial_k1: disto_k1;  pinhole_radial_k3: disto_k3 (k1, k2, k3)
    pinhole_brown_t2: disto_t2 (k1, k2, k3, and OpenCV's p1, p2);  fisheye: fisheye (OpenCV's k1, ..., k4);  spherical
Pixel positions are kept as they are: OpenMVG's own features count them from the centre of the first pixel.
Source: openMVG/openMVG src/openMVG: sfm/sfm_data_io_cereal.cpp, sfm/sfm_view_io.hpp, geometry/pose3_io.hpp, cameras/.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.formats import lenses
from nerfcli.captures.formats.fields import (
    malformed,
    matrix,
    name_of,
    number,
    read_json_object,
    record_of,
    shown,
    size_of,
    vector,
)
from nerfcli.captures.formats.format import Format, UserInputs, has_keys, named
from nerfcli.captures.formats.limits import FramePoses, checked_camera, plausible, without
from nerfcli.captures.formats.photo_names import with_photos

FILES = ("sfm_data.json", *(f"reconstruction{name}/sfm_data.json" for name in ("", "_sequential", "_global")))

_EXPECTED = "expected the sfm_data.json of OpenMVG"
# Key and number of the distortion terms of each type of camera.
_TERMS = {
    "pinhole": ("", 0),
    "pinhole_radial_k1": ("disto_k1", 1),
    "pinhole_radial_k3": ("disto_k3", 3),
    "pinhole_brown_t2": ("disto_t2", 5),
    "fisheye": ("fisheye", 4),
}
_SPHERICAL = "spherical"
# In the number of a type: its name is beside it.
_FIRST = 1 << 31


def parse_openmvg(path: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the views that have a pose and intrinsics, and the points with their observations.

    Photos are in the file's root_path, or in images/ beside the file or above it.
    """
    content = read_json_object(path)
    cameras = _cameras(content, path)
    poses = {key: (value, where) for key, value, where in _entries(content, "extrinsics", path)}
    usable, frames, frame_of, unposed = FramePoses(), [], dict[int, int](), []
    for key, value, where in _entries(content, "views", path):
        view = _data(value, where)
        parts = (view.get("local_path") or "", view.get("filename"))
        name = "/".join(name_of(part, where).strip("/") for part in parts if part != "")
        ids = [value if isinstance(value := view.get(entry), int) else -1 for entry in ("id_pose", "id_intrinsic")]
        record, camera = poses.get(ids[0]), cameras.get(ids[1])
        if record is None or camera is None:
            unposed.append(name)
        elif (pose := usable.read(name, f"{record[1]}: rotation", partial(_matrix, *record))) is not None:
            frame_of[key] = len(frames)
            frames.append(Frame(name, camera, pose, image=path.parent / name))
    points, observations = _structure(content, frame_of, path)
    notes = (*usable.notes(), *without(unposed, "a pose"))
    capture = Capture(tuple(frames), points, kind="openmvg", observations=observations, notes=notes)
    home = path.parent / name_of(content.get("root_path") or ".", str(path))
    return with_photos(capture, home, path.parent, path.parent.parent, given=given.images)


def _entries(content: dict[str, Any], key: str, home: Path | str) -> Iterator[tuple[int, dict[str, Any], str]]:
    """Yield key, value and place in the file of the entries of a list; `home` is the place that the list is in."""
    entries = content.get(key, [])
    if not isinstance(entries, list):
        raise malformed(home, f"{key} is {shown(entries)}", "expected a list of keys and values")
    for index, entry in enumerate(entries):
        where = f"{home}: {key}[{index}]"
        record = record_of(entry, where)
        yield int(number(record, "key", where)), record_of(record.get("value"), where), where


def _data(value: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the record that cereal's pointer wraps, with the fields of its parents."""
    record = record_of(record_of(value.get("ptr_wrapper"), where).get("data"), where)
    while isinstance(record.get("value0"), dict):
        record = {**record.pop("value0"), **record}
    return record


def _cameras(content: dict[str, Any], path: Path) -> dict[int, Camera]:
    names: dict[int, Any] = {}
    cameras = {}
    for key, value, where in _entries(content, "intrinsics", path):
        kind = int(number(value, "polymorphic_id", where, default=_FIRST)) & ~_FIRST
        names[kind] = value.get("polymorphic_name", names.get(kind))
        cameras[key] = _camera(names[kind], _data(value, where), where)
    return cameras


def _camera(kind: Any, data: dict[str, Any], where: str) -> Camera:
    size = size_of(number(data, "width", where), number(data, "height", where), where)
    if kind == _SPHERICAL:
        return checked_camera("EQUIRECTANGULAR", *size, size, where=where)
    if kind not in _TERMS:
        supported = ", ".join((*_TERMS, _SPHERICAL))
        raise malformed(where, f"polymorphic_name is {shown(kind)}", f"expected one of {supported}")
    key, count = _TERMS[kind]
    terms = vector(data, key, count, where).tolist() if count else []
    focal = (number(data, "focal_length", where),) * 2
    x, y = vector(data, "principal_point", 2, where).tolist()
    if kind == "fisheye":
        return lenses.fisheye_camera(size, focal, (x, y), radial=terms, where=where)
    k1, k2, k3, p1, p2 = terms + [0.0] * (5 - count)
    return lenses.brown_camera(size, focal, (x, y), radial=(k1, k2, k3), tangential=(p1, p2), where=where)


def _matrix(value: dict[str, Any], where: str) -> np.ndarray:
    """Return the first three rows of world_from_cam, (3, 4)."""
    return np.column_stack([matrix(value, "rotation", (3,), 3, where).T, vector(value, "center", 3, where)])


def _structure(content: dict[str, Any], frame_of: dict[int, int], path: Path) -> tuple[np.ndarray, Observations | None]:
    """Return the points (N, 3), and where the frames see them; `frame_of` gives the frame's index by the view's key."""
    points, seen, pixels = [], [], []
    for index, (_, value, where) in enumerate(_entries(content, "structure", path)):
        points.append(vector(value, "X", 3, where))
        for view, observation, place in _entries(value, "observations", where):
            if view in frame_of:
                seen.append((frame_of[view], index))
                pixels.append(vector(observation, "x", 2, place))
    positions = np.array(points).reshape(-1, 3)
    if not plausible(positions).all():
        raise malformed(path, "a point of its structure is too far away", _EXPECTED)
    if not seen:
        return positions, None
    table = np.array(seen, dtype=np.int64)
    return positions, Observations(table[:, 0], table[:, 1], np.array(pixels))


def find_openmvg(path: Path) -> Path | None:
    """Find an sfm_data.json of OpenMVG, in a folder or in that of a reconstruction in it."""
    found = path if path.is_file() and path.suffix.lower() == ".json" else named(*FILES)(path)
    return found if found and has_keys(found, "sfm_data_version", "views", "intrinsics", "extrinsics") else None


FORMAT = Format("openmvg", "OpenMVG", find_openmvg, parse_openmvg, open_centre=True)
