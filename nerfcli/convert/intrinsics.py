"""One camera out of a file, for captures whose format has no cameras."""

from pathlib import Path

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.colmap_text import cameras_from_text
from nerfcli.cameras.formats.fields import read_json_object
from nerfcli.convert.formats import Given, recognise
from nerfcli.errors import UserError


def read_intrinsics(path: Path) -> Camera:
    """The camera in a file: as JSON {"model", "width", "height", "params"}, COLMAP's cameras.txt, or any capture.

    Raises:
        UserError: no camera, several different ones, or a damaged file.
    """
    if path.is_file() and path.suffix.lower() == ".json":
        content = read_json_object(path)
        if "params" in content:
            try:
                return Camera.from_json(content)
            except UserError as error:
                raise UserError(f"{path}: {error.message}", error.hint) from error
    if path.is_file() and path.name == "cameras.txt":
        try:
            cameras = set(cameras_from_text(path.read_bytes()).values())
        except (ValueError, KeyError) as error:
            raise UserError(f"{path} is damaged: {error}", "expected COLMAP's cameras.txt") from error
    else:
        form, found = recognise(path)
        if form.parse is None or form.name in ("tum", "kitti"):
            raise UserError(f"{path} has no cameras", "give a file of intrinsics, such as COLMAP's cameras.txt")
        cameras = {frame.camera for frame in form.parse(found, Given()).frames}
    if len(cameras) != 1:
        raise UserError(f"{path} has {len(cameras)} different cameras", "give a file with the one that took all frames")
    return cameras.pop()
