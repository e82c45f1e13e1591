"""The photos of ScanNet++, read only: dslr/nerfstudio/transforms.json with the photos in dslr/resized_images.

The file is a transforms.json whose held-out photos are in test_frames; file_path and mask_path are names in
dslr/resized_images and dslr/resized_anon_masks, or, of transforms_undistorted.json, in undistorted_images and
undistorted_anon_masks. The poses are aligned with a laser scan, in metres, the world's z axis up. Photos marked is_bad
are blurred or show a shadow of the photographer. dslr/colmap is a COLMAP model, which is read as such.
Source: scannetpp/scannetpp common/utils/nerfstudio.py, common/scene_release.py; nerfstudio scannetpp_dataparser.py.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.conventions import opencv_from_opengl_pose
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import check_unique_names, malformed, name_of, read_json_object, shown, vector
from nerfcli.captures.formats.format import Format, has_keys
from nerfcli.captures.formats.lens_fits import Fits
from nerfcli.captures.formats.limits import FramePoses
from nerfcli.captures.formats.photo_names import find_photos
from nerfcli.captures.formats.transforms_cameras import camera_of_record, given_size
from nerfcli.errors import several

FILES = ("transforms.json", "transforms_undistorted.json")
_PLACES = ("dslr/nerfstudio", "nerfstudio", ".")
_HELD_OUT = "test_frames"
_SPLITS = {"frames": "train", _HELD_OUT: "test"}


def parse_scannetpp(path: Path, *, images: Path | None = None) -> Capture:
    """Read the photos of both lists that are not marked as bad, with their masks where these are on disk.

    Args:
        images: the folder of the photos instead of the one that the file is for.

    Raises:
        UserError: the file is damaged; file and field are named.
    """
    content = read_json_object(path)
    kind = "undistorted" if "undistorted" in path.stem else "resized"
    home = path.parent.parent if path.parent.name == "nerfstudio" else path.parent
    records, bad = [], 0
    for key, split in _SPLITS.items():
        for record, where in _records(content, key, path):
            if record.get("is_bad") is True:
                bad += 1
            else:
                records.append(({**content, **record}, split, where))
    has_split = any(split == "test" for _, split, _ in records)
    names = [name_of(record.get("file_path"), where) for record, _, where in records]
    check_unique_names(names, path)
    sizes = [_size(record, where) for record, _, where in records]
    found = find_photos(names, [home], given=images, folders=(f"{kind}_images", "images"), sizes=sizes)
    fits, poses, frames = Fits(), FramePoses(), []
    for (record, split, where), size, name, image in zip(records, sizes, found.names, found.paths, strict=True):
        pose = poses.read(name, f"{where}: transform_matrix", partial(_matrix, record, where))
        if pose is None:
            continue
        mask = record.get("mask_path")
        mask = home / f"{kind}_anon_masks" / name_of(mask, f"{where}: mask_path") if mask else None
        frames.append(
            Frame(
                name,
                camera_of_record(record, size, where, fits),
                opencv_from_opengl_pose(pose),
                image=image or (images or home / f"{kind}_images") / name,
                mask=mask if mask is not None and mask.is_file() else None,
                split=split if has_split else None,
            )
        )
    notes = (*found.notes, *poses.notes(), *fits.notes())
    if bad:
        notes += (f"{several(bad, 'photo')} marked as bad left out",)
    points, source = np.zeros((0, 3)), "laser scan (ScanNet++)"
    return Capture(tuple(frames), points, kind="scannetpp", unit="metre", unit_source=source, notes=notes)


def _records(content: dict[str, Any], key: str, path: Path) -> list[tuple[dict[str, Any], str]]:
    records = content.get(key)
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise malformed(str(path), f"{key} is {shown(records)}", "expected a list of frames")
    return [(record, f"{path}: {key}[{index}]") for index, record in enumerate(records)]


def _size(record: dict[str, Any], where: str) -> tuple[int, int]:
    size = given_size(record, where)
    if size is None:
        raise malformed(where, "w and h are missing", "expected the size of the photos in pixels")
    return size


def _matrix(record: dict[str, Any], where: str) -> np.ndarray:
    rows = record.get("transform_matrix")
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise malformed(where, f"transform_matrix is {shown(rows)}", "expected 4 rows of 4 numbers")
    return np.stack([vector({"transform_matrix": row}, "transform_matrix", 4, where) for row in rows])


def find_scannetpp(path: Path) -> Path | None:
    """Find a transforms.json with test_frames, given the scene, its folder dslr, that of the file, or the file."""
    if path.is_file():
        is_json = path.suffix.lower() == ".json"
        has_lists = is_json and has_keys(path, f'"{_HELD_OUT}"'.encode(), lambda content: "frames" in content)
        return path if has_lists else None
    files = (path / place / name for place in _PLACES for name in FILES)
    return next((file for file in files if file.is_file() and find_scannetpp(file)), None)


FORMAT = Format(
    "scannetpp",
    "ScanNet++",
    "dslr/nerfstudio/transforms.json",
    find_scannetpp,
    lambda path, given: parse_scannetpp(path, images=given.images),
    axes="opengl",
)
