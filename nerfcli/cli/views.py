"""The views that `nerfcli render --cameras` names: those of the run, a path through or around them, or of a file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nerfcli.atomic import cannot_write
from nerfcli.cli.console import Console
from nerfcli.errors import UserError

if TYPE_CHECKING:
    from nerfcli.cameras.camera import Camera
    from nerfcli.cameras.frame import Frame

PATHS = ("orbit", "ellipse", "spiral", "interpolate")
# Formats whose folders `nerfcli train` takes.
SCENES = ("nerfcli", "colmap", "transforms", "blender", "llff")


@dataclass(frozen=True)
class Views:
    """Which views of a run to see.

    Args:
        cameras: test, train, a path, or a file or folder of cameras.
        count: of the views of a path.
        through: names of photos, with commas between them, that a path is made from; all training photos if None.
        nerfstudio_frame: dataparser_transforms.json of the nerfstudio run in whose world the file's cameras are.
        max_size: of the longer side of the pictures, in pixels; as trained if None.
    """

    cameras: str
    count: int
    through: str | None = None
    nerfstudio_frame: Path | None = None
    max_size: int | None = None

    @property
    def name(self) -> str:
        """A name for files of these views."""
        return self.cameras if self.cameras in ("test", "train", *PATHS) else Path(self.cameras).absolute().stem


def chosen_frames(run: Path, views: Views, *, depth_hint: float) -> "list[Frame]":
    """The frames of a run that are to be seen.

    Args:
        run: the folder that train wrote.
        views: which.
        depth_hint: how far away the scene's middle is, for paths around it where the optical axes do not say.

    Raises:
        UserError: no such cameras, or an option that makes no sense with them.
    """
    from nerfcli.cameras import paths
    from nerfcli.cameras.names import frames_named
    from nerfcli.train.photos import downscaled_camera
    from nerfcli.train.run_folder import read_cameras, read_config

    cameras, through = views.cameras, views.through
    if through is not None and cameras not in PATHS:
        raise UserError(f"--through does not fit --cameras {cameras}", f"it is for {', '.join(PATHS)}", exit_code=2)
    if views.nerfstudio_frame is not None and cameras in ("test", "train", *PATHS):
        raise UserError(f"--nerfstudio-frame does not fit --cameras {cameras}", "it is for a file", exit_code=2)
    sets = read_cameras(run)
    factor = read_config(run)["settings"]["downscale"]
    known = sets["train"]
    if through is not None:
        known = frames_named([*sets["train"], *sets["test"]], through.split(","))
    if cameras in ("test", "train"):
        chosen = sets[cameras]
        if not chosen:
            raise UserError(f"{run} has no {cameras} cameras", f"choose --cameras train, {', '.join(PATHS)}")
    elif cameras == "interpolate":
        chosen = paths.interpolate(known, count=views.count)
    elif cameras in PATHS:
        path = {"orbit": paths.orbit, "ellipse": paths.ellipse, "spiral": paths.spiral}[cameras]
        chosen = path(known, count=views.count, depth_hint=depth_hint)
    else:
        chosen = _frames_of(Path(cameras), views.nerfstudio_frame)
        factor = 1
    chosen = [replace(frame, camera=downscaled_camera(frame.camera, factor)) for frame in chosen]
    if views.max_size is None:
        return chosen
    return [replace(frame, camera=_within(frame.camera, views.max_size)) for frame in chosen]


def write_frames(frames: "Sequence[Frame]", target: Path, *, fps: float, overwrite: bool, console: Console) -> None:
    """Write views into a folder: cameras.json, a transforms.json, and camera_path.json for nerfstudio's viewer.

    Raises:
        UserError: one of them exists, or cannot be written.
    """
    import numpy as np

    from nerfcli.cameras.formats.camera_path import losses_camera_path, write_camera_path
    from nerfcli.cameras.formats.transforms import write_transforms
    from nerfcli.cameras.frame import Capture

    views = tuple(replace(frame, image=None, mask=None, split=None) for frame in frames)
    capture = Capture(views, np.zeros((0, 3)), (), None, "camera-path")
    listed, path = target / "cameras.json", target / "camera_path.json"
    if there := [file for file in (listed, path) if file.exists() and not overwrite]:
        raise UserError(f"{there[0]} exists", "add --overwrite to replace it, or choose another place with -o")
    for loss in losses_camera_path(capture):
        console.warn(f"{path.name} cannot hold {loss}; {listed.name} does")
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(target, error) from error
    write_transforms(capture, listed)
    write_camera_path(capture, path, fps=fps)


def _frames_of(path: Path, nerfstudio_frame: Path | None) -> "tuple[Frame, ...]":
    """The cameras of a scene, fitted to its photos, or of any file or folder that `nerfcli convert` reads."""
    from nerfcli import scene as scenes
    from nerfcli.cameras.formats.camera_path import read_normalisation
    from nerfcli.convert.formats import Given, recognise

    if not path.exists():
        raise UserError(
            f"no cameras called {path}",
            f"choose test, train, {', '.join(PATHS)}, or a file or folder of cameras that nerfcli convert reads",
        )
    form, found = recognise(path)
    assert form.parse is not None
    if path.is_dir() and form.name in SCENES:
        frames = scenes.load(path).frames
    else:
        frames = form.parse(found, Given()).frames
    if nerfstudio_frame is None:
        return frames
    world_from_nerfstudio = read_normalisation(nerfstudio_frame).inverse()
    return tuple(replace(f, world_from_cam=world_from_nerfstudio.apply_pose(f.world_from_cam)) for f in frames)


def _within(camera: "Camera", max_size: int) -> "Camera":
    """The camera of the picture made smaller, if need be, until its longer side fits."""
    from nerfcli.train.photos import downscaled_camera

    return downscaled_camera(camera, max(1.0, max(camera.width, camera.height) / max_size))
