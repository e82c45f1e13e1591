"""OpenSfM's reconstruction.json, which OpenDroneMap and WebODM write too.

Lengths in the picture are divided by the larger of width and height, with the origin in the picture's middle:
normalised = (pixel + 1/2 - size/2) / max(size) with whole numbers at pixel centres, which is (p - size/2) / max(size)
for positions p with pixel centres at 1/2. Poses are cam_from_world as angle-axis and translation, in OpenCV axes.
Cameras refer to the stored pixels: OpenSfM ignores the EXIF orientation, and only records it with the shot.
Source: opensfm.org/docs/dataset.html and geometry.html; mapillary/OpenSfM opensfm/io.py, opensfm/features.py and
opensfm/src/geometry/camera_{projections,distortions}_functions.h.
"""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerfcli.atomic import atomic_path
from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import lenses
from nerfcli.captures.formats.fields import malformed, name_of, number, read_json, record_of, shown, size_of, vector
from nerfcli.captures.formats.format import Format, find_json
from nerfcli.captures.formats.limits import FramePoses, checked_camera, largest_of, plausible
from nerfcli.captures.formats.photo_names import with_photos
from nerfcli.captures.formats.unsupported import distortion, lost_of_cameras, lost_parts, projection
from nerfcli.errors import UserError

IMAGE_FOLDER = "images"

_EXPECTED = "expected the reconstruction.json of an OpenSfM dataset: a list of reconstructions"

# The types of lenses and their distortion terms. Files have all but the last four in every lens.
_BROWN = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "p1", "p2", "k3"),
}
_ALL_TERMS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s0", "s1", "s2", "s3")
_TERMS = {
    **_BROWN,
    "fisheye": ("k1", "k2"),
    "fisheye_opencv": ("k1", "k2", "k3", "k4"),
    "fisheye62": _ALL_TERMS[:8],
    "fisheye624": _ALL_TERMS,
}
_SPHERICAL = ("spherical", "equirectangular")

# Terms that OpenSfM lacks. The tangential and prism terms of RAD_TAN_THIN_PRISM_FISHEYE act on other coordinates.
_LOST_TERMS = {"FULL_OPENCV": ("k4", "k5", "k6"), "RAD_TAN_THIN_PRISM_FISHEYE": ("p0", "p1", "s0", "s1", "s2", "s3")}
# The types of the lenses of COLMAP's models that are not written as "brown" or "fisheye_opencv".
_TYPES = {
    "SIMPLE_RADIAL": "simple_radial",
    "RADIAL": "radial",
    "THIN_PRISM_FISHEYE": "fisheye624",
    "RAD_TAN_THIN_PRISM_FISHEYE": "fisheye62",
}
_NO_WORDS = ("FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM")


def parse_opensfm(path: Path) -> Capture:
    """Read the reconstruction with the most shots of a reconstruction.json; the others are not in the same world.

    The photos are where OpenSfM has them, in images/ beside the file. The unit of length is the metre where the file
    has a `reference_lla` other than latitude 0, longitude 0: OpenSfM then aligned the world to GPS positions, east,
    north, up from there. Without GPS it writes zeros, and the unit is arbitrary.
    """
    content, notes = _largest(path)
    camera_records = record_of(content.get("cameras"), f"{path}: cameras")
    cameras = {key: _camera(record, f"{path}: cameras.{shown(key)}") for key, record in camera_records.items()}
    frames, poses = [], FramePoses()
    for key, record in content["shots"].items():
        where = f"{path}: shots.{shown(key)}"
        name = name_of(key, where)
        camera = record.get("camera")
        if not isinstance(camera, str) or camera not in cameras:
            raise malformed(where, f"camera is {shown(camera)}", "expected a key of cameras")
        pose = poses.read_inverse(name, where, partial(_matrix, record, where))
        if pose is not None:
            frames.append(Frame(name, cameras[camera], pose, image=path.parent / IMAGE_FOLDER / name))
    notes += poses.notes()
    points, colours = _points(content, path)
    unit = "metre" if _is_on_earth(content, path) else "arbitrary"
    return Capture(tuple(frames), points, (), None, "opensfm", colours=colours, unit=unit, notes=notes)


def losses_opensfm(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that reconstruction.json cannot hold. Observations are in OpenSfM's tracks.csv."""
    return (*lost_of_cameras(capture, _lost_of), *lost_parts(capture, holds=("points", "colours")))


def write_opensfm(capture: Capture, path: Path) -> None:
    """Write a capture as reconstruction.json, with full precision."""
    keys: dict[Camera, str] = {}
    for frame in capture.frames:
        keys.setdefault(frame.camera, f"camera {len(keys)}")
    cam_from_world = rigid.inverse(np.stack([frame.world_from_cam for frame in capture.frames]))
    rotations = Rotation.from_matrix(cam_from_world[:, :3, :3]).as_rotvec().tolist()
    translations = cam_from_world[:, :3, 3].tolist()
    shots = {
        frame.name: {"rotation": rotation, "translation": translation, "camera": keys[frame.camera]}
        for frame, rotation, translation in zip(capture.frames, rotations, translations, strict=True)
    }
    colours = np.full((len(capture.points), 3), 255) if capture.colours is None else capture.colours
    pairs = zip(capture.points.tolist(), colours.astype(np.float64).tolist(), strict=True)
    points = {str(index): {"color": colour, "coordinates": point} for index, (point, colour) in enumerate(pairs)}
    cameras = {key: _camera_record(camera) for camera, key in keys.items()}
    content = [{"cameras": cameras, "shots": shots, "points": points}]
    with atomic_path(path) as partial:  # on one line: ten times quicker than indented, for millions of points
        partial.write_text(json.dumps(content, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def _lost_of(camera: Camera) -> list[str]:
    """Return the distortion terms of a camera that OpenSfM lacks, or the lens if it has no equivalent there."""
    if camera.model in _NO_WORDS:
        return [f"the {camera.model} lens"]
    return [name for name in distortion(camera) if name in _LOST_TERMS.get(camera.model, ())]


def _largest(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the reconstruction with most shots, and a note on the others."""
    content = read_json(path, _EXPECTED)
    if not isinstance(content, list) or not content:
        raise malformed(path, f"holds {shown(content)}", _EXPECTED)
    for index, item in enumerate(content):
        record_of(item, f"{path}: reconstruction {index}")
        shots = record_of(item.get("shots"), f"{path}: reconstruction {index}: shots")
        for key, shot in shots.items():
            record_of(shot, f"{path}: shots.{shown(key)}")
    counts = [len(item["shots"]) for item in content]
    best = counts.index(max(counts))
    named = {str(index): count for index, count in enumerate(counts)}
    return content[best], largest_of("reconstruction", named, str(best))


def _camera(value: Any, where: str) -> Camera:
    record = record_of(value, where)
    kind = record.get("projection_type", "perspective")
    kind = kind.lower() if isinstance(kind, str) else kind
    size = size_of(number(record, "width", where), number(record, "height", where), where)
    if kind in _SPHERICAL:
        return checked_camera("EQUIRECTANGULAR", *size, size, where=where)
    if kind not in tuple(_TERMS):
        supported = ", ".join((*_TERMS, *_SPHERICAL))
        raise malformed(where, f"projection_type {shown(kind)} is not supported", f"expected one of {supported}")
    listed = _ALL_TERMS if kind == "fisheye624" else _ALL_TERMS[:8]
    term = {key: number(record, key, where, default=0.0) for key in listed}
    k1, k2, k3, k4, k5, k6, p1, p2, s0, s1, s2, s3 = (term[key] if key in _TERMS[kind] else 0.0 for key in _ALL_TERMS)
    scale, middle = max(size), (size[0] / 2, size[1] / 2)
    if kind in ("perspective", "fisheye"):
        focal, centre = (scale * number(record, "focal", where),) * 2, middle
    else:
        focal = (scale * number(record, "focal_x", where), scale * number(record, "focal_y", where))
        x, y = (scale * number(record, key, where, default=0.0) for key in ("c_x", "c_y"))
        centre = (middle[0] + x, middle[1] + y)
    if kind in _BROWN:
        return lenses.brown_camera(size, focal, centre, radial=(k1, k2, k3), tangential=(p1, p2), where=where)
    radial, others = (k1, k2, k3, k4), (p1, p2, s0, s1, s2, s3)
    if kind in ("fisheye", "fisheye_opencv"):
        return lenses.fisheye_camera(size, focal, centre, radial=radial, where=where)
    if not any(others):
        params = (*focal, *centre, *radial, k5, k6, *others)
        return checked_camera("RAD_TAN_THIN_PRISM_FISHEYE", *size, params, where=where)
    if k5 or k6 or s1 or s3:
        hint = "no supported camera model has all of these terms"
        raise malformed(where, "k5, k6, s1 or s3 beside p1, p2, s0 or s2", hint)
    return lenses.fisheye_camera(size, focal, centre, radial=radial, tangential=(p1, p2), prism=(s0, s2), where=where)


def _camera_record(camera: Camera) -> dict[str, Any]:
    """Return the entry that describes a camera; the inverse of `_camera`."""
    size = {"width": camera.width, "height": camera.height}
    if camera.is_spherical:
        return {"projection_type": "spherical", **size}
    if camera.model in _NO_WORDS:
        hint = "write undistorted cameras, or keep the COLMAP model"
        raise UserError(f"camera model {camera.model} cannot be written to OpenSfM's reconstruction.json", hint)
    scale, value, (fx, fy), (cx, cy) = max(camera.size), camera.values, camera.focal_lengths, camera.principal_point
    intrinsics = {
        "focal_x": fx / scale,
        "focal_y": fy / scale,
        "c_x": (cx - camera.width / 2) / scale,
        "c_y": (cy - camera.height / 2) / scale,
    }
    kind = _TYPES.get(camera.model, "fisheye_opencv" if projection(camera) == "fisheye" else "brown")
    if kind == "fisheye62":
        value = {f"k{index + 1}": value[f"k{index}"] for index in range(6)}
    elif kind == "fisheye624":
        value |= {"s0": value["sx1"], "s2": value["sy1"]}
    elif "k" in value:
        value["k1"] = value["k"]
    terms = {key: value.get(key, 0.0) for key in _TERMS[kind]}
    return {"projection_type": kind, **size, **intrinsics, **terms}


def _matrix(shot: dict[str, Any], where: str) -> np.ndarray:
    """Return the first three rows of cam_from_world, (3, 4)."""
    rotation, translation = vector(shot, "rotation", 3, where), vector(shot, "translation", 3, where)
    return np.column_stack([Rotation.from_rotvec(rotation).as_matrix(), translation])


def _points(content: dict[str, Any], path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Return points (N, 3) and their colours (N, 3) uint8; the colours are None if there are no points."""
    records = record_of(content.get("points", {}), f"{path}: points")
    if not records:
        return np.zeros((0, 3)), None
    try:
        points = _rows([record["coordinates"] for record in records.values()])
        colours = _rows([record["color"] for record in records.values()])
    except (KeyError, TypeError, ValueError, OverflowError):
        for key, record in records.items():
            where = f"{path}: points.{shown(key)}"
            vector(record_of(record, where), "coordinates", 3, where)
            vector(record, "color", 3, where)
        raise
    return points, np.clip(np.rint(colours), 0, 255).astype(np.uint8)


def _rows(values: list[Any]) -> np.ndarray:
    """Convert lists of three numbers to one array, faster than `vector` on each; raise if a list is invalid."""
    rows = np.array(values, dtype=np.float64)
    if rows.shape != (len(values), 3) or not plausible(rows).all():
        raise ValueError("not three finite numbers each")
    return rows


def _is_on_earth(content: dict[str, Any], path: Path) -> bool:
    """Return whether the world was aligned to GPS positions."""
    where = f"{path}: reference_lla"
    reference = content.get("reference_lla")
    if reference is None:
        return False
    place = [number(record_of(reference, where), key, where) for key in ("latitude", "longitude")]
    return any(place)


FORMAT = Format(
    "opensfm",
    "OpenSfM, OpenDroneMap",
    lambda path: find_json(path, opening="[", name="reconstruction.json"),
    lambda path, given: with_photos(parse_opensfm(path), path.parent, given=given.images),
    default_name="reconstruction.json",
    files=("*.json",),
    write=write_opensfm,
    losses=losses_opensfm,
)
