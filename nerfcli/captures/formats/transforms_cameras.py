"""The keys that describe a camera in a transforms.json: fl_x, cx, k1, camera_model, ..., from and to cameras.

Sources: docs.nerf.studio "Data conventions"; nerfstudio data/dataparsers/nerfstudio_dataparser.py; instant-ngp
docs/nerf_dataset_tips.md and src/nerf_loader.cu.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats import fields, lenses
from nerfcli.captures.formats.fields import malformed
from nerfcli.captures.formats.lenses import Fits, Pair, Terms
from nerfcli.captures.formats.limits import checked_camera
from nerfcli.captures.formats.unsupported import distortion, projection
from nerfcli.errors import several

_INTRINSICS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
# A list of terms that replaces those, and their order in it.
_LIST, _LISTED = "distortion_params", ("k1", "k2", "k3", "k4", "p1", "p2")
# Keys of a 3x3 matrix of intrinsics.
_MATRICES = ("K", "intrinsics", "intrinsic_matrix")
# Keys that give the same number; the first counts.
_SAME = (("fl_x", "camera_angle_x"), ("fl_y", "camera_angle_y"))
_FOCAL = {key for keys in _SAME for key in keys}
# A smaller focal length, as a fraction of the picture's side, is no length in pixels: the view would be 178 degrees.
_LEAST_FOCAL = 0.01
# Rounding, and resizing to whole pixels, explain that two keys give focal lengths which differ by this fraction.
_SAME_FOCAL = 0.01

_PERSPECTIVE_MODELS = (None, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
_FISHEYE_MODELS = ("OPENCV_FISHEYE", "FISHEYE")
# OpenCV's with a divisor of k4, k5 and k6, as in COLMAP; with other models k4 is the polynomial's term of r^8.
_RATIONAL = "FULL_OPENCV"

# Lens models of instant-ngp that COLMAP does not have.
_FOREIGN = ("ftheta_p0", "latlong")

# The format's keys for the distortion terms of COLMAP's models; other terms have no key.
_KEY_OF_TERM = {
    "SIMPLE_RADIAL": {"k": "k1"},
    "RADIAL": {"k1": "k1", "k2": "k2"},
    "OPENCV": {"k1": "k1", "k2": "k2", "p1": "p1", "p2": "p2"},
    "FULL_OPENCV": {"k1": "k1", "k2": "k2", "p1": "p1", "p2": "p2", "k3": "k3"},
    "SIMPLE_RADIAL_FISHEYE": {"k": "k1"},
    "RADIAL_FISHEYE": {"k1": "k1", "k2": "k2"},
    "OPENCV_FISHEYE": {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4"},
    "THIN_PRISM_FISHEYE": {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4"},
    "RAD_TAN_THIN_PRISM_FISHEYE": {"k0": "k1", "k1": "k2", "k2": "k3", "k3": "k4"},
}


def camera_of_record(record: dict[str, Any], size: tuple[int, int], where: str, fits: Fits) -> Camera:
    """Return the camera of a frame.

    Args:
        record: the frame's keys, merged over those of the whole file.
        size: of the picture that the numbers are for.
        fits: takes a note where the terms are fitted by others.
    """
    width, height = size
    model = record.get("camera_model")
    model = model.strip().upper() or None if isinstance(model, str) else model
    if model == "EQUIRECTANGULAR":
        return checked_camera(model, *size, size, where=where)
    foreign = next((key for key in _FOREIGN if record.get(key) not in (None, False)), None)
    if foreign is not None:
        raise malformed(where, f"the lens model of {foreign} is not supported", "undistort the pictures first")
    is_fisheye = model in _FISHEYE_MODELS or record.get("is_fisheye") is True
    if not is_fisheye and model not in _PERSPECTIVE_MODELS:
        supported = ", ".join(str(name) for name in (*_PERSPECTIVE_MODELS[1:], *_FISHEYE_MODELS, "EQUIRECTANGULAR"))
        raise malformed(where, f"camera_model {model!r:.80} is not supported", f"expected one of {supported}")
    if terms := record.get(_LIST):
        is_zero = isinstance(terms, list) and not any(terms)  # as many as other lens models have
        values = [0.0] * len(_LISTED) if is_zero else fields.vector(record, _LIST, len(_LISTED), where).tolist()
        record = record | dict(zip(_LISTED, values, strict=True))
    focal, centre, skew = _without_distortion(record, size, where)
    head = (*focal, *centre)
    k1, k2, k3, k4, k5, k6, p1, p2 = (number(record, key, where) or 0.0 for key in _INTRINSICS)
    if (k5 or k6) and model != _RATIONAL:
        raise malformed(where, f"k5 is {k5:g} and k6 is {k6:g}", f"only camera_model {_RATIONAL} has these terms")
    if is_fisheye:
        return fits.fisheye(size, focal, centre, terms=Terms((k1, k2, k3, k4), (p1, p2), skew=skew), where=where)
    if model == _RATIONAL and (k4 or k5 or k6):
        if skew:
            raise malformed(where, f"skew is {skew:g}, which no lens with k4, k5 and k6 has", "undistort the photos")
        return checked_camera(model, width, height, (*head, k1, k2, p1, p2, k3, k4, k5, k6), where=where)
    if k3 or k4 or skew:
        return fits.brown(size, focal, centre, terms=Terms((k1, k2, k3, k4), (p1, p2), skew=skew), where=where)
    if k1 or k2 or p1 or p2:
        return checked_camera("OPENCV", width, height, (*head, k1, k2, p1, p2), where=where)
    return checked_camera("PINHOLE", width, height, head, where=where)


def _without_distortion(record: dict[str, Any], size: tuple[int, int], where: str) -> tuple[Pair, Pair, float]:
    """Return the focal lengths and principal point of a frame, and the skew, which only a matrix of intrinsics has."""
    width, height = size
    matrix = None if any(record.get(key) not in (None, "") for key in _FOCAL) else _matrix_of(record)
    if matrix is not None:
        key, values = matrix
        place = f"{where}.{key}"
        focal, centre, skew = lenses.parts_of_matrix(values, size, place)
        for name, value, size_px in zip(("fx", "fy"), focal, size, strict=True):
            _check_focal(value, name, size_px, where=place)
        return focal, centre, skew
    found = [_focal(record, "x", width, where), _focal(record, "y", height, where)]
    known = [value for value in found if value is not None]
    if not known:
        raise malformed(where, "neither fl_x nor camera_angle_x is given", "expected the focal length or field of view")
    cx, cy = number(record, "cx", where), number(record, "cy", where)
    # Blender's files give only the horizontal angle, since pixels are square.
    return (known[0], known[-1]), (width / 2 if cx is None else cx, height / 2 if cy is None else cy), 0.0


def _matrix_of(record: dict[str, Any]) -> tuple[str, np.ndarray] | None:
    """Return the key and the numbers (3, 3) of the first matrix of intrinsics among a frame's keys, if any.

    The file has 3x3 numbers, or more rows and columns that do not matter, stored row by row or column by column.
    """
    for key in _MATRICES:
        try:
            values = np.array(record.get(key), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):  # the last one: an integer with hundreds of digits
            continue
        values = values.reshape(3, 3) if values.shape == (9,) else values
        if values.shape not in ((3, 3), (3, 4), (4, 4)):
            continue
        values = values[:3, :3]
        for stored in (values, values.T):
            if (stored[2] == (0.0, 0.0, 1.0)).all():
                return key, stored
    return None


def merged(content: dict[str, Any], record: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of a frame over those of the whole file, whose focal lengths count only where it has none.

    Null and empty texts of a frame leave the value of the file.
    """
    own = {key: value for key, value in record.items() if value not in (None, "")}
    has_own = bool(_FOCAL & own.keys()) or _matrix_of(own) is not None
    unused = _FOCAL | set(_MATRICES) if has_own else set[str]()
    return record | {key: value for key, value in content.items() if key not in unused} | own


def contradictions(listed: Sequence[tuple[dict[str, Any], Camera]]) -> tuple[str, ...]:
    """Return a line for each axis on which two keys give different focal lengths, for people."""
    notes = []
    for side, (key, other) in enumerate(_SAME):
        off = []
        for record, camera in listed:
            angle = record.get(other)  # not checked, as it is not used
            has_both = record.get(key) not in (None, "") and isinstance(angle, float) and 0 < angle < math.pi
            if has_both and projection(camera) == "perspective":
                by_angle, focal = camera.size[side] / 2 / math.tan(angle / 2), camera.focal_lengths[side]
                off += [(by_angle, focal)] if abs(by_angle - focal) > _SAME_FOCAL * focal else []
        if off:
            by_angle, focal = off[0]
            what = f"{other} of {several(len(off), 'frame')} is that of another focal length, {by_angle:.4g} pixels"
            notes.append(f"{what}, than {key}, {focal:.4g}: {key} is used")
    return tuple(notes)


def record_of_camera(camera: Camera) -> dict[str, Any]:
    """Return the keys that describe a camera, without the terms that the format cannot hold."""
    size = {"w": camera.width, "h": camera.height}
    if camera.is_spherical:
        return {"camera_model": "EQUIRECTANGULAR", **size}
    (fx, fy), (cx, cy) = camera.focal_lengths, camera.principal_point
    keys = _KEY_OF_TERM.get(camera.model, {})
    terms = {keys[name]: value for name, value in distortion(camera).items() if name in keys}
    model = "OPENCV_FISHEYE" if projection(camera) == "fisheye" else "OPENCV" if terms else "PINHOLE"
    return {"camera_model": model, **size, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, **terms}


def lost_to_transforms(camera: Camera) -> list[str]:
    """Return the distortion terms of a camera that the format has no key for."""
    keys = _KEY_OF_TERM.get(camera.model, {})
    return [name for name in distortion(camera) if name not in keys]


def given_size(record: dict[str, Any], where: str) -> tuple[int, int] | None:
    """Return the width and height under `w` and `h`, or None if one of them is missing."""
    width, height = number(record, "w", where), number(record, "h", where)
    if width is None or height is None:
        return None
    if width < 1 or height < 1 or width != int(width) or height != int(height):
        hint = "expected the picture's size in pixels, as integers"
        raise malformed(where, f"w and h are {width} and {height}", hint)
    return int(width), int(height)


def number(record: dict[str, Any], key: str, where: str) -> float | None:
    """Return the number under a key, or None if there is none: no key, null, or the empty text of a template."""
    return None if record.get(key) in (None, "") else fields.number(record, key, where)


def _focal(record: dict[str, Any], axis: str, size_px: int, where: str) -> float | None:
    focal = number(record, f"fl_{axis}", where)
    if focal is not None:
        _check_focal(focal, f"fl_{axis}", size_px, where=where)
        return focal
    angle = number(record, f"camera_angle_{axis}", where)
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise malformed(where, f"camera_angle_{axis} is {angle}", "expected radians between 0 and pi")
    return size_px / 2 / math.tan(angle / 2)


def _check_focal(focal: float, name: str, size_px: int, *, where: str) -> None:
    if focal < _LEAST_FOCAL * size_px:
        hint = f"expected a focal length in pixels, of pictures with {size_px} pixels there"
        raise malformed(where, f"{name} is {focal}", hint)
