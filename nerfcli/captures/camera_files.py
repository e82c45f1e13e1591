"""Cameras from a file: one, for captures whose format has none, or those of a whole capture, for its photos."""

from pathlib import Path

from nerfcli.cameras.camera import Camera
from nerfcli.captures.calibration import Calibration
from nerfcli.captures.formats.colmap import read_cameras
from nerfcli.captures.formats.fields import read_json_object
from nerfcli.captures.formats.finding import find_json, named
from nerfcli.captures.formats.registry import UserInputs, recognise
from nerfcli.captures.formats.scene_folder import MODEL_FOLDER, SCENE_FILE
from nerfcli.captures.stored_pixels import UPRIGHT
from nerfcli.errors import UserError

_CAMERAS_FILES = ("cameras.bin", "cameras.txt")


def read_intrinsics(path: Path) -> Camera:
    """Read the camera in a file, see `read_calibration`.

    Raises:
        UserError: there is no camera, there are several different ones, or the file is damaged.
    """
    cameras = read_calibration(path).cameras
    if len(cameras) != 1:
        raise UserError(
            f"{path} has {len(cameras)} different cameras", "give a file with the single camera of all frames"
        )
    return cameras[0]


def read_calibration(path: Path, *, images: Path | None = None) -> Calibration:
    """Read the cameras in a file or folder.

    It may be JSON {"model", "width", "height", "params"}, COLMAP's cameras.txt or cameras.bin, or any capture.

    Args:
        images: the folder of the photos, for formats whose files do not state the photos' sizes.

    Raises:
        UserError: there is no camera, or the file is damaged.
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
