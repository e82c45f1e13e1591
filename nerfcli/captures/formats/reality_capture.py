"""RealityCapture's and RealityScan's "Internal/External camera parameters" (.csv), read only.

RealityCapture calls the columns name, x, y, alt, heading, pitch, roll, f, px, py, k1, k2, k3, k4, t1, t2; RealityScan 2
calls some of them yaw, f_35mm, px_norm, py_norm. With s = max(width, height) of the photo in pixels:
    focal length = f/36 s,  principal point = (width/2 + px s, height/2 + py s)
since f is in millimetres on a frame 36 mm long, but px and py are fractions of that length. k1 to k3 are OpenCV's, t1
is OpenCV's p2 and t2 its p1. The camera's centre is (x, y, alt), and its rotation with OpenGL axes
    world_from_cam = Rz(-heading) Rx(pitch) Ry(roll)
in degrees: with zeros it looks straight down with north (+y) at the top of the picture, and roll turns about north.
Source: calibration.xml of RealityScan 2.2, the templates of its exports ("Internal/External camera parameters" with
$(f*36), $(px); "OpenCV-compliant ..." with $(px*scale+width*0.5) and the order k1, k2, t2, t1, k3);
nerfstudio process_data/realitycapture_utils.py for the rotation (it takes t1 for p1).
"""

import csv
from collections.abc import Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.axes import opencv_pose
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import malformed, matrix_of, name_of, numbers, read_text, read_xml, shown
from nerfcli.captures.formats.format import Format, UserInputs, by_suffix, only_file
from nerfcli.captures.formats.lenses import Fits, Terms
from nerfcli.captures.formats.limits import FramePoses, NotFiniteError, left_out
from nerfcli.captures.formats.photo_names import find_photos
from nerfcli.captures.orientation import stored_size
from nerfcli.errors import UserError, listed, several

_EXPECTED = 'expected a file of RealityScan\'s export "Internal/External camera parameters"'

_COLUMNS = {
    "heading": ("heading", "yaw"),
    "f": ("f", "f_35mm"),
    "px": ("px", "px_norm"),
    "py": ("py", "py_norm"),
    **{key: (key,) for key in ("name", "x", "y", "alt", "pitch", "roll", "k1", "k2", "k3", "k4", "t1", "t2")},
}
_TERMS = ("k1", "k2", "k3", "k4", "t1", "t2")
_NUMBERS = ("x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", *_TERMS)
# For the division model, the paper on RealityScan's camera geometry (M. Hornacek, 2026, equation 50) has
# distorted = undistorted/(1 + k1 r^2) with r of the undistorted point, so that a barrel has k1 > 0. But what it exports
# for fisheye lenses, and its table of sensors for a GoPro, have k1 < 0: as in undistorted = distorted/(1 + k1 r^2).
_BROWN3 = (
    "align with Brown3 (Alignment Settings > Advanced > Distortion model) and export again, or export as COLMAP with "
    "undistorted images"
)


def parse_reality_capture(path: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the cameras of the file, in the coordinates that it was exported in (z up); the unit stays arbitrary.

    The file does not give the size of the photos, so they are measured; those that are not on disk are `missing`.
    Distortion must be of one of the Brown models. The file does not say which model it is, but no other has k1 alone:
    RealityScan fits three radial terms or more of Brown's.
    """
    names, rows, places, lost = _table(path)
    found = find_photos(names, (path.parent,), given=given.images).required(path)
    value = {key: rows[:, index] for index, key in enumerate(_NUMBERS)}
    angles = np.stack([-value["heading"], value["pitch"], value["roll"]], axis=-1)
    rotations = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    poses = opencv_pose(rigid.from_parts(rotations, rows[:, :3]), "opengl")
    fits, frames = Fits(), []
    for index, (name, image) in enumerate(zip(found.names, found.paths, strict=True)):
        if image is not None:
            intrinsics: dict[str, float] = dict(zip(_NUMBERS[6:], rows[index, 6:].tolist(), strict=True))
            if intrinsics["k1"] and not any(intrinsics[key] for key in _TERMS[1:]):
                hint = f"if it is another model, export XMP sidecars, which name it; else {_BROWN3}"
                raise malformed(places[index], "has k1 alone, as of the Division model, which is not supported", hint)
            camera = camera_of_values(intrinsics, stored_size(image), places[index], fits)
            frames.append(Frame(name, camera, poses[index], image=image))
    notes = (*found.notes, *lost, *fits.notes())
    return Capture(tuple(frames), missing=found.missing, kind="reality_capture", notes=notes)


def _table(path: Path) -> tuple[list[str], np.ndarray, list[str], tuple[str, ...]]:
    """Return the images' names, their numbers (images, 15) as of `_NUMBERS`, their places in the file, and notes.

    Those whose numbers are not finite are left out, and noted.
    """
    lines = read_text(path, _EXPECTED).splitlines()
    start = next((index for index, line in enumerate(lines) if line.lower().startswith(("#name,", "name,"))), None)
    if start is None:
        raise malformed(path, "has no header line #name,x,y,alt,...", _EXPECTED)
    header = [word.strip().lower() for word in lines[start].lstrip("#").split(",")]
    columns = {}
    for key, spellings in _COLUMNS.items():
        found = [header.index(word) for word in spellings if word in header]
        if not found:
            raise malformed(f"{path}: line {start + 1}", f"has no column {' or '.join(spellings)}", _EXPECTED)
        columns[key] = found[0]
    names, rows, places, lost = [], [], [], list[tuple[str, UserError]]()
    for index, line in enumerate(lines[start + 1 :], start=start + 2):
        if not line.strip():
            continue
        where = f"{path}: line {index}"
        words = _cells(line, where)
        if len(words) != len(header):
            raise malformed(where, f"has {len(words)} columns", f"expected {len(header)}, as in the file's first line")
        name = name_of(words[columns["name"]], where)
        try:
            rows.append(numbers([words[columns[key]] for key in _NUMBERS], len(_NUMBERS), where))
        except NotFiniteError as error:
            lost.append((name, error))
            continue
        names.append(name)
        places.append(where)
    notes = left_out(lost, len(names) + len(lost))
    if not rows:
        raise malformed(path, "lists no images with a pose", _EXPECTED)
    return names, np.array(rows), places, notes


def _cells(line: str, where: str) -> list[str]:
    """Return the cells of a line, in which a name with a comma is quoted."""
    if '"' not in line:
        return line.split(",")
    try:
        return next(csv.reader([line], strict=True))
    except (csv.Error, StopIteration) as error:
        raise malformed(where, f"is not a valid line of a table ({error})", _EXPECTED) from error


def camera_of_values(value: Mapping[str, float], size: tuple[int, int], where: str, fits: Fits) -> Camera:
    """Return the camera of a photo with these intrinsics, as in the columns of the table.

    Args:
        value: f in mm on a frame 36 mm long, px, py, k1, ..., k4, t1 and t2; where the file has them, skew as a
            fraction of the longer side, and aspect, fy over fx.
    """
    scale = max(size)
    focal = value["f"] / 36 * scale
    centre = (size[0] / 2 + value["px"] * scale, size[1] / 2 + value["py"] * scale)
    terms = Terms(
        radial=(value["k1"], value["k2"], value["k3"], value["k4"]),
        tangential=(value["t2"], value["t1"]),
        skew=value.get("skew", 0.0) * scale,
    )
    return fits.brown(size, (focal, focal * value.get("aspect", 1.0)), centre, terms=terms, where=where)


def find_reality_capture(path: Path) -> Path | None:
    """Find a file .csv, or the only one in a folder that begins with the header of such a table."""
    return by_suffix(".csv")(path) or only_file(path, "*.csv", "#name,")


TABLE = Format("reality-capture", "RealityScan, RealityCapture", find_reality_capture, parse_reality_capture)


_XMP_EXPECTED = "expected an XMP file that RealityScan exported"
_NAMESPACE = b"capturingreality.com/ns/xcr"
_SUFFIX = ".xmp"
_UNDISTORTED = ("none", "perspective")
_BROWN = ("brown3", "brown3t2", "brown4", "brown4t2")


def parse_realityscan_xmp(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the cameras of the photos in a folder, in the coordinates that they were exported in; the unit is arbitrary.

    Files of other programs or with intrinsics only give no frame, nor do those in the coordinates of another component.
    The files do not give the size of the photos, so these are measured.
    """
    scenes, without = dict[str, list[tuple[Path, dict[str, str]]]](), []
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() == _SUFFIX and _NAMESPACE in path.read_bytes():
            value = _values(path)
            has_pose = {"Rotation", "Position"} <= set(value)
            (scenes.setdefault(_component(value), []) if has_pose else without).append((path, value))
    if not scenes:
        raise malformed(folder, "its XMP files have no poses", "align the photos, and export XMP with poses")
    posed = max(scenes.values(), key=len)
    without += chain.from_iterable(scene for scene in scenes.values() if scene is not posed)
    found = find_photos([path.stem for path, _ in posed], [folder], given=given.images).required(folder)
    fits, poses, frames = Fits(), FramePoses(), []
    for (path, value), image in zip(posed, found.paths, strict=True):
        if image is not None:
            camera = _camera(value, stored_size(image), str(path), fits)
            pose = poses.read(image.name, f"{path}: Rotation", partial(_pose, value, str(path)))
            if pose is not None:
                frames.append(Frame(image.name, camera, pose, image=image))
    notes = [*found.notes, *poses.notes(), *fits.notes()]
    if without:
        names = listed([path.name for path, _ in without])
        notes.append(f"{several(len(without), 'XMP file')} without a pose in the scene left out: {names}")
    return Capture(tuple(frames), missing=found.missing, kind="realityscan-xmp", notes=tuple(notes))


def _component(value: dict[str, str]) -> str:
    """Return the component whose coordinates the pose is in, or nothing where these are absolute."""
    return value.get("ComponentId", "") if value.get("Coordinates") in ("relative", "rigid") else ""


def _values(path: Path) -> dict[str, str]:
    """Return the texts of attributes and elements of RealityScan's namespace, by their names without its prefix."""
    elements = list(read_xml(path, _XMP_EXPECTED).iter())
    prefixes = {
        key.removeprefix("xmlns:")
        for element in elements
        for key, address in element.attrib.items()
        if key.startswith("xmlns:") and _NAMESPACE.decode() in address
    }
    found = {}
    for element in elements:
        for key, text in (*element.attrib.items(), (element.tag, element.text or "")):
            prefix, _, name = key.partition(":")
            if prefix in prefixes:
                found[name] = text.strip()
    return found


def _pose(value: dict[str, str], where: str) -> np.ndarray:
    rotation = matrix_of(value["Rotation"].split(), 3, 3, f"{where}: Rotation")
    position = np.array(numbers(value["Position"].split(), 3, f"{where}: Position"))
    return np.column_stack([rotation.T, position])


def _camera(value: dict[str, str], size: tuple[int, int], where: str, fits: Fits) -> Camera:
    def number(key: str, default: Any) -> float:
        return numbers(value.get(key, default).split(), 1, f"{where}: {key}")[0]

    projection = value.get("ProjectionModel", "perspective")
    if projection.lower() not in ("perspective", "pinhole"):
        raise malformed(where, f"ProjectionModel is {shown(projection)}", "only perspective pictures are supported")
    words = value.get("DistortionCoeficients", "0 0 0 0 0 0").split()
    terms = dict(zip(_TERMS, numbers(words, 6, f"{where}: DistortionCoeficients"), strict=True))
    model = value.get("DistortionModel", "none").lower()
    if model in _UNDISTORTED:
        terms = dict.fromkeys(_TERMS, 0.0)
    elif model not in _BROWN and any(terms.values()):
        raise malformed(where, f"DistortionModel is {shown(model)}, which is not supported", _BROWN3)
    intrinsics = {
        "f": number("FocalLength35mm", ""),
        "px": number("PrincipalPointU", "0"),
        "py": number("PrincipalPointV", "0"),
        "skew": number("Skew", "0"),
        "aspect": number("AspectRatio", "1"),
        **terms,
    }
    return camera_of_values(intrinsics, size, where, fits)


def find_realityscan_xmp(path: Path) -> Path | None:
    """Find a folder with an XMP file of RealityScan, given the folder, its parent where it is images/, or a file."""
    if path.is_file():
        return path.parent if path.suffix.lower() == _SUFFIX and _NAMESPACE in path.read_bytes() else None
    return next((folder for folder in (path, path / "images") if _has_sidecar(folder)), None)


def _has_sidecar(folder: Path) -> bool:
    files = (path for path in folder.iterdir() if path.suffix.lower() == _SUFFIX) if folder.is_dir() else ()
    return any(_NAMESPACE in path.read_bytes() for path in files if path.is_file())


XMP = Format("realityscan-xmp", "RealityScan, RealityCapture", find_realityscan_xmp, parse_realityscan_xmp)
