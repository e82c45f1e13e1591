"""Known intrinsics: read from a file of cameras, and assigned to photos by name, else by size."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.colmap import read_cameras
from nerfcli.captures.formats.fields import read_json_object
from nerfcli.captures.formats.format import UserInputs, find_json, named
from nerfcli.captures.formats.registry import recognise
from nerfcli.captures.formats.scene_folder import MODEL_FOLDER, SCENE_FILE
from nerfcli.captures.orientation import UPRIGHT, Picture, fit_to_picture
from nerfcli.errors import UserError

_SIZES_SHOWN = 4


@dataclass(frozen=True)
class Calibration:
    """The cameras of a calibration file.

    Args:
        path: the file, or the folder that was named.
        cameras: the distinct cameras, in the order of the file.
        of_image: index of each image's camera, by the image's name as the file lists it, with forward slashes.
        upright: True if the cameras refer to upright pictures, False if to the stored pixels; see
            `captures.orientation`.
    """

    path: Path
    cameras: tuple[Camera, ...]
    of_image: Mapping[str, int]
    upright: bool = False

    @property
    def key(self) -> str:
        """Hash of the content, independent of the file's location."""
        content = [[camera.to_json() for camera in self.cameras], sorted(self.of_image.items()), self.upright]
        return hashlib.blake2b(json.dumps(content).encode(), digest_size=16).hexdigest()

    def to_json(self) -> dict[str, str]:
        """Return {"file", "key"}, the record of the calibration that a scene keeps."""
        return {"file": str(self.path.absolute()), "key": self.key}


@dataclass(frozen=True)
class PhotoCalibration:
    """Camera of an upright photo, the index of the camera in the file, and whether the photo was found by name."""

    camera: Camera
    number: int
    by_name: bool


def calibrated(calibration: Calibration, pictures: Sequence[Picture]) -> tuple[PhotoCalibration, ...]:
    """Return the camera of each photo, turned and rescaled to its upright picture.

    Photos are matched to the file's images by name, without folders unless several images have the same name. A photo
    that is not listed gets the only camera of its size, upright or as stored, or else the only one of its aspect ratio.

    Raises:
        UserError: a photo has no camera in the file, or several, or another aspect ratio than its camera.
    """
    listed: dict[str, dict[str, int]] = {}
    for name, number in calibration.of_image.items():
        listed.setdefault(name.replace("\\", "/").rpartition("/")[2], {})[name] = number
    return tuple(_of_picture(calibration, picture, listed.get(picture.path.name, {})) for picture in pictures)


def _of_picture(calibration: Calibration, picture: Picture, same_name: Mapping[str, int]) -> PhotoCalibration:
    """Return the camera of a photo; `same_name` are the listed images of its name and the indices of their cameras."""
    path = picture.path.absolute().as_posix()
    same_folder = {number for name, number in same_name.items() if path.endswith(f"/{name}") and "/" in name}
    listed = same_folder or set(same_name.values())
    if len(listed) > 1:
        what = f"{calibration.path} lists {len(listed)} images called {picture.path.name}, with different cameras"
        raise UserError(what, "give a file that lists only the cameras of these photos")
    if listed:
        number = next(iter(listed))
        return PhotoCalibration(_fitted(calibration, number, picture), number, by_name=True)
    fitting = [n for n in range(len(calibration.cameras)) if _fits(calibration, n, picture)]
    of_size = [n for n in fitting if set(calibration.cameras[n].size) == set(picture.size)]
    fitting = of_size or fitting
    if len(fitting) == 1:
        return PhotoCalibration(_fitted(calibration, fitting[0], picture), fitting[0], by_name=False)
    what = f"photo {picture.path.name} of {picture.width}x{picture.height}"
    if fitting:
        raise UserError(
            f"{calibration.path} does not list {what}, and {len(fitting)} of its cameras have that size",
            "give a file that lists the photos by name, or one with a single camera of this size",
        )
    listed_sizes = list(dict.fromkeys(f"{camera.width}x{camera.height}" for camera in calibration.cameras))
    more = f" and {len(listed_sizes) - _SIZES_SHOWN} more" if len(listed_sizes) > _SIZES_SHOWN else ""
    raise UserError(
        f"{calibration.path} has no camera for {what}: it does not list it, and its cameras are for "
        f"{', '.join(listed_sizes[:_SIZES_SHOWN])}{more}",
        "intrinsics are for a particular aspect ratio; give the intrinsics of these photos, or remove --intrinsics",
    )


def _fits(calibration: Calibration, number: int, picture: Picture) -> bool:
    """Return whether a camera has the aspect ratio of a picture, upright or as stored."""
    shapes = {picture.size} if calibration.upright else {picture.size, picture.stored_size}
    return any(calibration.cameras[number].has_shape(*shape) for shape in shapes)


def _fitted(calibration: Calibration, number: int, picture: Picture) -> Camera:
    picture = replace(picture, orientation=1) if calibration.upright else picture
    return fit_to_picture(calibration.cameras[number], np.eye(4), picture)[0]


_CAMERAS_FILES = ("cameras.bin", "cameras.txt")


def read_intrinsics(path: Path) -> Camera:
    """Read the camera in a file, see `read_calibration`."""
    cameras = read_calibration(path).cameras
    if len(cameras) != 1:
        hint = "give a file with the single camera of all frames"
        raise UserError(f"{path} has {len(cameras)} different cameras", hint)
    return cameras[0]


def read_calibration(path: Path, *, images: Path | None = None) -> Calibration:
    """Read the cameras in a file or folder.

    It may be JSON {"model", "width", "height", "params"}, COLMAP's cameras.txt or cameras.bin, or any capture.

    Args:
        images: the folder of the photos, for formats whose files do not state the photos' sizes.
    """
    content = read_json_object(path) if path.is_file() and find_json(path, opening="{", name="") else {}
    if "params" in content:
        try:
            return Calibration(path, (Camera.from_json(content),), {})
        except UserError as error:
            raise UserError(f"{path}: {error.message}", error.hint) from error
    cameras_file = path if path.name in _CAMERAS_FILES else named(*_CAMERAS_FILES)(path)
    if cameras_file is not None and cameras_file.is_file():
        cameras, of_image = read_cameras(cameras_file)
        upright = _is_own(cameras_file.parent)
    else:
        form, found = recognise(path)
        if "cameras" in form.lacks:
            raise _no_cameras(path)
        # Cameras of scenes and runs of nerfcli are for upright pictures; the capture says so.
        capture = form.parse(found, UserInputs(images=images))
        cameras = {index: frame.camera for index, frame in enumerate(capture.frames)}
        of_image = {frame.name: index for index, frame in enumerate(capture.frames)}
        upright = capture.pixels == UPRIGHT
    if not cameras:
        raise _no_cameras(path)
    different = tuple(dict.fromkeys(cameras.values()))
    numbers = {camera: number for number, camera in enumerate(different)}
    return Calibration(path, different, {name: numbers[cameras[key]] for name, key in of_image.items()}, upright)


def _no_cameras(path: Path) -> UserError:
    return UserError(f"{path} has no cameras", "give a file of intrinsics, such as COLMAP's cameras.txt")


def _is_own(model_dir: Path) -> bool:
    """Return whether a model belongs to a scene that nerfcli wrote."""
    return (model_dir.resolve().parent.parent / SCENE_FILE).is_file() and model_dir.resolve().match(MODEL_FOLDER)
