"""Captures of Nerfies, HyperNeRF and DyCheck, read only: camera/NAME.json, rgb/1x/NAME.png, dataset.json, scene.json.

A camera has the rotation `orientation`, cam_from_world with OpenCV axes, and the camera's centre `position`, for the
pictures in rgb/1x; the other folders rgb/2x, ... hold them reduced. The lens is OpenCV's with fx = focal_length and
fy = focal_length pixel_aspect_ratio; the centre of the first pixel is (0.5, 0.5). dataset.json: ids, and of them
train_ids and val_ids. scene.json: near and far, in units of 1 / scale. points.npy: points of the background.
Cameras that move and scenes that change are read as photos of one moment: metadata.json is not used.
depth/1x/NAME.npy in DyCheck: z in units of 1 / scale, zero where it is not known.
Source: google/nerfies nerfies/camera.py, nerfies/datasets/nerfies.py; KAIR-BAIR/dycheck docs/DATASETS.md.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import lenses
from nerfcli.captures.formats.fields import (
    DAMAGED,
    array_of_npy,
    check_unique_names,
    malformed,
    matrix,
    number,
    read_json_object,
    shown,
    size_of,
    vector,
)
from nerfcli.captures.formats.format import Format, UserInputs, has_keys
from nerfcli.captures.formats.limits import FramePoses, plausible, without
from nerfcli.captures.formats.photo_names import find_photos

CAMERAS, DATASET = "camera", "dataset.json"

_IMAGE_FOLDERS = tuple(f"rgb/{factor}x" for factor in (1, 2, 4, 8, 16))


def parse_nerfies(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the frames in dataset.json, or all cameras without one; the unit is arbitrary."""
    path = folder / DATASET
    content = read_json_object(path) if path.is_file() else {}
    train, held_out = (_names(content, key, path) for key in ("train_ids", "val_ids"))
    names = _names(content, "ids", path) or [*train, *held_out]
    names = names or sorted(file.stem for file in (folder / CAMERAS).glob("*.json"))
    check_unique_names(names, path)
    files = {name: folder / CAMERAS / f"{name}.json" for name in names}
    unposed = [name for name, file in files.items() if not file.is_file()]
    names = [name for name, file in files.items() if file.is_file()]
    records = [read_json_object(files[name]) for name in names]
    cameras = [_camera(record, str(files[name])) for name, record in zip(names, records, strict=True)]
    there = [name for name in _IMAGE_FOLDERS if (folder / name).is_dir()]
    homes = [folder / there[0]] if there else [folder]
    found = find_photos(names, homes, given=given.images, sizes=[camera.size for camera in cameras])
    splits = {**dict.fromkeys(train, "train"), **dict.fromkeys(held_out, "val")} if held_out else {}
    poses, frames = FramePoses(), []
    for name, camera, record, place in zip(names, cameras, records, found.places, strict=True):
        where = str(files[name])
        pose = poses.read(name, f"{where}: orientation", partial(_pose, record, where))
        if pose is not None:
            place = place or homes[0] / name
            frames.append(Frame(place.name, camera, pose, image=place, split=splits.get(name)))
    if not frames:
        raise malformed(folder, f"has no file in {CAMERAS}/ of the photos in {DATASET}", "copy the whole capture")
    notes = (*found.notes, *poses.notes(), *without(unposed, "a camera"))
    bounds = _depth_bounds(folder / "scene.json", len(frames))
    return Capture(tuple(frames), _points(folder / "points.npy"), depth_bounds=bounds, kind="nerfies", notes=notes)


def _names(content: dict[str, Any], key: str, path: Path) -> list[str]:
    names = content.get(key, [])
    if not isinstance(names, list) or not all(isinstance(name, str | int) and "/" not in str(name) for name in names):
        raise malformed(path, f"{key} is {shown(names)}", "expected a list of names")
    return [str(name) for name in names]


def _camera(record: dict[str, Any], where: str) -> Camera:
    width, height = vector(record, "image_size", 2, where).tolist()
    size = size_of(width, height, where)
    focal, skew = number(record, "focal_length", where), number(record, "skew", where, default=0.0)
    aspect = number(record, "pixel_aspect_ratio", where, default=1.0)
    if abs(skew) > 1e-6 * abs(focal):
        raise malformed(where, f"skew is {skew:g}", "skew is not supported: no camera model here has it")
    x, y = vector(record, "principal_point", 2, where).tolist()
    radial = _terms(record, ("radial_distortion",), 3, where)
    tangential = _terms(record, ("tangential", "tangential_distortion"), 2, where)
    lens = (focal, focal * aspect), (x, y)
    return lenses.brown_camera(size, *lens, radial=radial, tangential=tangential, where=where)


def _terms(record: dict[str, Any], keys: tuple[str, ...], count: int, where: str) -> list[float]:
    """Return the terms under the first of these keys, zeros without one: old files have other keys, or none."""
    key = next((key for key in keys if record.get(key) is not None), None)
    return [0.0] * count if key is None else vector(record, key, count, where).tolist()


def _pose(record: dict[str, Any], where: str) -> np.ndarray:
    rotation = matrix(record, "orientation", (3,), 3, where)
    position = vector(record, "position", 3, where)
    return np.column_stack([rotation.T, position])


def _depth_bounds(path: Path, count: int) -> np.ndarray | None:
    """Return near and far of each frame, (count, 2), in units of the cameras; None where they are not given."""
    content = read_json_object(path) if path.is_file() else {}
    if not {"scale", "near", "far"} <= set(content):
        return None
    scale, near, far = (number(content, key, str(path)) for key in ("scale", "near", "far"))
    if not (scale > 0 and 0 < near < far):
        return None
    return np.tile([near / scale, far / scale], (count, 1))


def _points(path: Path) -> np.ndarray:
    if not path.is_file():
        return np.zeros((0, 3))
    try:
        points = array_of_npy(path.read_bytes())
    except ValueError as error:
        raise malformed(path, str(error), DAMAGED) from error
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind != "f" or not plausible(points).all():
        raise malformed(path, f"has {points.shape} values of type {points.dtype}", "expected points (N, 3)")
    return points.astype(np.float64)


def find_nerfies(path: Path) -> Path | None:
    """Find the folder that holds camera/ and rgb/ or dataset.json, given it or a file in it."""
    folder = path.parent.parent if path.parent.name == CAMERAS else path
    folder = path.parent if path.is_file() and path.name == DATASET else folder
    first = next((folder / CAMERAS).glob("*.json"), None)
    return folder if first and has_keys(first, "orientation", "position") else None


FORMAT = Format("nerfies", "Nerfies, HyperNeRF, DyCheck", find_nerfies, parse_nerfies)
