"""AliceVision's and Meshroom's .sfm (cameras.sfm, sfm.json), read only. All numbers in the file are texts.

A view has a path, and the ids of a pose and of intrinsics. A pose is the rotation world_from_cam, row by row, and the
centre, with OpenCV axes. Focal lengths in pixels are
    fx = focalLength width / sensorWidth,  fy = fx pixelRatio    from version 1.2.5 on
    fx = focalLength width / sensorWidth,  fy = fx / pixelRatio  from 1.2.2 on
    pxFocalLength                                                before, one number or, from 1.2.0 on, two
and the principal point is relative to the middle of the picture from 1.2.1 on, to its top-left corner before.
Source: alicevision/AliceVision src/aliceVision: sfmDataIO/jsonIO.cpp, camera/cameraCommon.hpp, DistortionBrown.cpp.
"""

import posixpath
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import lenses
from nerfcli.captures.formats.fields import (
    malformed,
    name_of,
    number,
    read_json_object,
    record_of,
    shown,
    size_of,
    vector,
)
from nerfcli.captures.formats.format import Format, UserInputs, by_suffix, has_keys
from nerfcli.captures.formats.limits import FramePoses, without
from nerfcli.captures.formats.photo_names import find_photos

FILES = ("cameras.sfm", "sfm.sfm", "sfm.json")

_EXPECTED = "expected the .sfm or .json file of AliceVision's StructureFromMotion or ConvertSfMFormat"
_LISTS = ("version", "views", "intrinsics", "poses")
# Number of distortion terms by the names of lenses; later versions name distortion apart, with the type pinhole.
_RADIAL = {"pinhole": 0, "none": 0, "radial1": 1, "radialk1": 1, "radial3": 3, "radialk3": 3, "brown": 5}
_FISHEYE = ("fisheye4", "fisheye")


def parse_alicevision(path: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the views that have a pose, and the points if the file has them.

    Photos are where the file says, or, as it usually comes from another machine, in the given folder or beside it.
    """
    content = read_json_object(path)
    if not all(isinstance(content.get(key), list) for key in _LISTS):
        raise malformed(path, "has no version, views, intrinsics or poses", _EXPECTED)
    version = tuple(vector(content, "version", 3, str(path)).astype(int).tolist())
    cameras = {
        key: _camera(record, place, version)
        for key, record, place in _identified(content["intrinsics"], "intrinsicId", f"{path}: intrinsics")
    }
    usable = FramePoses()
    poses = {
        key: usable.read(key, place, partial(_matrix, record, place))
        for key, record, place in _identified(content["poses"], "poseId", f"{path}: poses")
    }
    views = [(record_of(view, f"{path}: views[{i}]"), f"{path}: views[{i}]") for i, view in enumerate(content["views"])]
    paths = [name_of(view.get("path"), where) for view, where in views]
    folder = _common_folder(paths)
    frames, unposed = [], []
    for (view, where), place in zip(views, paths, strict=True):
        if "rigId" in view:
            raise malformed(where, "belongs to a camera rig", "rigs are not supported; convert to COLMAP in Meshroom")
        pose, camera = str(view.get("poseId")), view.get("intrinsicId")
        world_from_cam = poses.get(pose)
        if world_from_cam is None:
            unposed += [] if pose in poses else [place.removeprefix(folder)]
            continue
        if not isinstance(camera, str) or camera not in cameras:
            raise malformed(where, f"intrinsicId is {shown(camera)}", "expected the id of one of the intrinsics")
        frames.append(Frame(place, cameras[camera], world_from_cam))
    sizes = [frame.camera.size for frame in frames]
    found = find_photos([frame.name for frame in frames], (path.parent,), given=given.images, sizes=sizes)
    for index, (frame, image) in enumerate(zip(frames, found.paths, strict=True)):
        name = frame.name.removeprefix(folder)
        frames[index] = replace(frame, name=name, image=image or (given.images or path.parent) / name)
    points, colours = _points(content.get("structure", []), f"{path}: structure")
    notes = (*found.notes, *usable.notes(), *without(unposed, "a pose"))
    return Capture(tuple(frames), points, (), None, "alicevision", colours=colours, notes=notes)


def _identified(records: list[Any], key: str, where: str) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield the id under `key`, the record and its place in the file for each record of a list."""
    for index, value in enumerate(records):
        place = f"{where}[{index}]"
        record = record_of(value, place)
        if not isinstance(record.get(key), str):
            raise malformed(place, f"{key} is {shown(record.get(key))}", "expected an id, as text")
        yield record[key], record, place


def _common_folder(paths: list[str]) -> str:
    """Return the folder, with a slash at its end, that all paths are in; empty if there is none."""
    try:
        folder = posixpath.commonpath([posixpath.dirname(path) for path in paths])
    except ValueError:  # no paths, or absolute and relative ones
        return ""
    return f"{folder}/" if folder else ""


def _matrix(record: dict[str, Any], where: str) -> np.ndarray:
    """Return the first three rows of world_from_cam, (3, 4)."""
    transform = record_of(record_of(record.get("pose"), f"{where}: pose").get("transform"), f"{where}: transform")
    rotation = vector(transform, "rotation", 9, where).reshape(3, 3)
    return np.column_stack([rotation, vector(transform, "center", 3, where)])


def _camera(record: dict[str, Any], where: str, version: tuple[int, ...]) -> Camera:
    size = size_of(number(record, "width", where), number(record, "height", where), where)
    focal = _focal_lengths(record, size[0], version, where)
    x, y = vector(record, "principalPoint", 2, where).tolist()
    centre = (x, y) if version < (1, 2, 1) else (size[0] / 2 + x, size[1] / 2 + y)
    kind = str(record.get("type", "")).lower()
    if kind == "pinhole":
        kind = str(record.get("distortionType", kind)).lower()
    terms = record.get("distortionParams") or []  # an empty list is written as an empty text
    count = len(terms) if isinstance(terms, list) else 1
    values = [*vector({"distortionParams": terms}, "distortionParams", count, where).tolist(), *(0.0,) * 5]
    if kind in _FISHEYE:
        return lenses.fisheye_camera(size, focal, centre, radial=values[:4], where=where)
    if kind not in _RADIAL:
        supported = ", ".join((*_RADIAL, *_FISHEYE))
        raise malformed(where, f"a lens of type {shown(kind)} is not supported", f"expected one of {supported}")
    k1, k2, k3, p1, p2 = (value if index < _RADIAL[kind] else 0.0 for index, value in enumerate(values[:5]))
    return lenses.brown_camera(size, focal, centre, radial=(k1, k2, k3), tangential=(p1, p2), where=where)


def _focal_lengths(record: dict[str, Any], width: int, version: tuple[int, ...], where: str) -> tuple[float, float]:
    """Return fx and fy in pixels."""
    if version < (1, 2, 0):
        focal = number(record, "pxFocalLength", where)
        return focal, focal
    if version < (1, 2, 2):
        fx, fy = vector(record, "pxFocalLength", 2, where).tolist()
        return fx, fy
    sensor, ratio = number(record, "sensorWidth", where), number(record, "pixelRatio", where, default=1.0)
    if sensor <= 0 or ratio <= 0:
        raise malformed(where, f"sensorWidth is {sensor:g} and pixelRatio {ratio:g}", "expected numbers above 0")
    fx = number(record, "focalLength", where) * width / sensor
    return fx, fx * ratio if version >= (1, 2, 5) else fx / ratio


def _points(value: Any, where: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Return points (N, 3) and their colours (N, 3) uint8; the colours are None if there are no points."""
    if not isinstance(value, list):
        raise malformed(where, f"is {shown(value)}", "expected a list of points")
    if not value:
        return np.zeros((0, 3)), None
    records = [record_of(item, f"{where}[{index}]") for index, item in enumerate(value)]
    points, colours = (
        [vector(record, key, 3, f"{where}[{index}]") for index, record in enumerate(records)] for key in ("X", "color")
    )
    return np.array(points), np.clip(np.rint(colours), 0, 255).astype(np.uint8)


def find_alicevision(path: Path) -> Path | None:
    """Find a file .sfm, or a .json that is a reconstruction of AliceVision."""
    found = by_suffix(".sfm", *FILES)(path)
    if found is None and path.is_file() and path.suffix.lower() == ".json":
        return path if has_keys(path, "featuresFolders", *_LISTS) else None
    return found


FORMAT = Format("alicevision", "AliceVision, Meshroom", find_alicevision, parse_alicevision)
