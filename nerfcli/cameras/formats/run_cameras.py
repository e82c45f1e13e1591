"""The cameras of a run of nerfcli: those that its field was trained with, refined where training refined them."""

from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.fields import read_json_object
from nerfcli.cameras.frame import Capture, Frame
from nerfcli.errors import UserError

CAMERAS = "cameras.json"
_SPLITS = ("train", "test")


def find_run(path: Path) -> Path | None:
    """RUN/cameras.json of a run, or of a file of that name in one."""
    file = path if path.is_file() and path.name == CAMERAS else path / CAMERAS
    return file if file.is_file() and (file.parent / "config.json").is_file() else None


def parse_run(path: Path) -> Capture:
    """The frames of RUN/cameras.json, training photos first; without points, which a run has none of.

    Raises:
        UserError: it is damaged.
    """
    content = read_json_object(path)
    try:
        frames = tuple(
            Frame(
                name=str(entry["name"]),
                camera=Camera.from_json(entry["camera"]),
                world_from_cam=np.array(entry["world_from_cam"], dtype=np.float64).reshape(4, 4),
                image=None if entry["image"] is None else path.parent / entry["image"],
                mask=None if entry["mask"] is None else path.parent / entry["mask"],
                split=split,
            )
            for split in _SPLITS
            for entry in content[split]
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} holds no cameras of a run: {type(error).__name__} {error}", "give the folder of a run"
        ) from error
    return Capture(frames, np.zeros((0, 3)), (), None, "run")
