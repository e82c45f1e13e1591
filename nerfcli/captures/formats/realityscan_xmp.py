"""RealityScan's and RealityCapture's XMP files, one beside each photo (File > Export > XMP, or Metadata); read only.

IMG_1.xmp belongs to IMG_1.jpg. Values are attributes or elements with the namespace xcr: Rotation is cam_from_world,
row by row, with OpenCV axes, and Position the camera's centre; FocalLength35mm, PrincipalPointU and V, AspectRatio and
DistortionCoeficients (k1, k2, k3, k4, t1, t2) are those of the table, see `reality_capture`. A model without tangential
terms, or with three radial ones, has zeros for the others.
Source: Epic, "RealityCapture XMP Camera Math"; RealityScan's help, "XMP alignment" (names and values);
Fraunhofer-IIS/camorph, model RealityCapture (names of the models of distortion).
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import malformed, matrix_of, numbers, read_xml, shown
from nerfcli.captures.formats.format import Format
from nerfcli.captures.formats.lens_fits import Fits
from nerfcli.captures.formats.limits import FramePoses
from nerfcli.captures.formats.photo_names import find_photos
from nerfcli.captures.formats.reality_capture import camera_of_values
from nerfcli.captures.orientation import stored_size
from nerfcli.captures.stored_pixels import measure
from nerfcli.errors import listed, several

_EXPECTED = "expected an XMP file that RealityScan exported"
_NAMESPACE = b"capturingreality.com/ns/xcr"
_SUFFIX = ".xmp"
_MODELS = ("perspective", "brown3", "brown3t2", "brown4", "brown4t2")
_TERMS = ("k1", "k2", "k3", "k4", "t1", "t2")


def parse_realityscan_xmp(folder: Path, *, images: Path | None = None) -> Capture:
    """Read the cameras of the photos in a folder, in the coordinates that they were exported in; the unit is arbitrary.

    Files of other programs, or with intrinsics only, and those with coordinates relative to a camera rig give no frame.
    The files do not give the size of the photos, so these are measured.

    Args:
        images: the folder of the photos; by default that of the files.

    Raises:
        UserError: a file is damaged (file and field are named), has a lens that no COLMAP model holds, or none of the
            photos is on disk.
    """
    posed, without = [], []
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() == _SUFFIX and _NAMESPACE in path.read_bytes():
            value = _values(path)
            has_pose = {"Rotation", "Position"} <= set(value) and value.get("Coordinates") not in ("relative", "rigid")
            (posed if has_pose else without).append((path, value))
    if not posed:
        raise malformed(str(folder), "its XMP files have no poses", "align the photos, and export XMP with poses")
    found = find_photos([path.stem for path, _ in posed], [folder], given=images)
    found = found.required(str(folder), "they give the sizes of the pictures")
    fits, poses, frames = Fits(), FramePoses(), []
    for (path, value), image in zip(posed, found.paths, strict=True):
        if image is not None:
            camera = _camera(value, stored_size(image, measure), str(path), fits)
            pose = poses.read(image.name, f"{path}: Rotation", partial(_pose, value, str(path)))
            if pose is not None:
                frames.append(Frame(image.name, camera, pose, image=image))
    notes = [*found.notes, *poses.notes(), *fits.notes()]
    if without:
        names = listed([path.name for path, _ in without])
        notes.append(f"{several(len(without), 'XMP file')} without a pose in the scene left out: {names}")
    return Capture(tuple(frames), missing=found.missing, kind="realityscan-xmp", notes=tuple(notes))


def _values(path: Path) -> dict[str, str]:
    """Return the texts of attributes and elements of RealityScan's namespace, by their names without its prefix."""
    elements = list(read_xml(path, _EXPECTED).iter())
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
    model = value.get("DistortionModel", "perspective").lower()
    if model not in _MODELS and any(terms.values()):
        raise malformed(
            where,
            f"DistortionModel is {shown(model)}, which is not supported",
            "set Alignment Settings > Advanced > Distortion model to Brown3, align, and export again",
        )
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


FORMAT = Format(
    "realityscan-xmp",
    "RealityScan, RealityCapture",
    ".xmp",
    find_realityscan_xmp,
    lambda path, given: parse_realityscan_xmp(path, images=given.images),
)
