"""The views to render of a run: its own, a path through or around them, or those of a file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from nerfcli import scene as scenes
from nerfcli.atomic import cannot_write
from nerfcli.cameras import paths
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.camera_path import losses_camera_path, read_normalisation, read_path, write_camera_path
from nerfcli.cameras.formats.transforms import write_transforms
from nerfcli.cameras.frame import Capture, Frame
from nerfcli.cameras.frame_names import frames_named
from nerfcli.cameras.framing import Window, cropped, equirectangular, sized, with_lens
from nerfcli.convert.finding import find_camera_path
from nerfcli.convert.formats import Given, recognise
from nerfcli.errors import UserError
from nerfcli.photos.loading import downscaled_camera
from nerfcli.runs.run import Run
from nerfcli.workflows.notices import Notify, warn_python

PATHS = ("orbit", "ellipse", "spiral", "interpolate")
# From this field of view on, a lens sees behind the camera.
BEHIND_FROM_DEG = 180.0
# What `write_frames` writes.
_FRAME_FILES = ("cameras.json", "camera_path.json")
# Formats whose folders `nerfcli train` takes.
SCENES = ("nerfcli", "colmap", "transforms", "blender", "llff")


@dataclass(frozen=True)
class Look:
    """Size, lens and crop of the pictures, where they differ from training or from the file of cameras.

    Args:
        width, height: in pixels; with one of them the other follows, and with both the picture is cut, never stretched.
        lens: "pinhole", "fisheye" or "equirectangular" instead of the camera's own.
        fov_deg: of that lens, between the left and the right edge.
        crop: X,Y,WIDTH,HEIGHT of the part to render, in pixels of the picture that the others give.
    """

    width: int | None = None
    height: int | None = None
    lens: str | None = None
    fov_deg: float | None = None
    crop: tuple[int, int, int, int] | None = None

    @property
    def words(self) -> list[str]:
        """For the names of folders, so that pictures of two kinds do not meet."""
        size = [] if self.width is None and self.height is None else [f"{self.width or ''}x{self.height or ''}"]
        lens = [] if self.lens is None else [self.lens + ("" if self.fov_deg is None else f"{self.fov_deg:g}")]
        return [*size, *lens, *([] if self.crop is None else ["crop", *map(str, self.crop)])]

    def of(self, camera: Camera) -> Camera:
        """Return the camera for such a picture in place of another one.

        Raises:
            UserError: a part outside of the picture, or a size or an angle that the lens does not have.
        """
        if self.lens == "equirectangular" and self.fov_deg is None and (self.width or self.height):
            width = self.width or 2 * (self.height or 0)
            camera = equirectangular(width, self.height or width // 2)
        else:
            camera = sized(camera, self.width, self.height)
            if self.lens is not None:
                camera = with_lens(camera, self.lens, self.fov_deg)
        return camera if self.crop is None else cropped(camera, Window(*self.crop))


@dataclass(frozen=True)
class Views:
    """Views of a run to render.

    Args:
        cameras: test, train, a path, or a file or folder of cameras.
        count: of the views of a path.
        through: names of photos, with commas between them, that a path is made from; all training photos if None.
        nerfstudio_frame: dataparser_transforms.json of the nerfstudio run in whose world the file's cameras are.
        max_size: of the longer side of the pictures, in pixels; as trained if None.
        look: size, lens and part of the pictures.
    """

    cameras: str
    count: int = 60
    through: str | None = None
    nerfstudio_frame: Path | None = None
    max_size: int | None = None
    look: Look = Look()

    @property
    def name(self) -> str:
        """A name for files of these views."""
        name = self.cameras if self.cameras in ("test", "train", *PATHS) else Path(self.cameras).absolute().stem
        return "-".join([name, *self.look.words])


def chosen_frames(run: Run, views: Views, *, depth_hint: float) -> list[Frame]:
    """Return the frames of a run that are to be seen.

    Args:
        run: the run.
        views: which.
        depth_hint: how far away the scene's middle is, for paths around it where the optical axes do not say.

    Raises:
        UserError: no such cameras, or an option that makes no sense with them.
    """
    cameras, through = views.cameras, views.through
    if through is not None and cameras not in PATHS:
        raise UserError(
            f"--through cannot be used with --cameras {cameras}", f"it works with {', '.join(PATHS)}", exit_code=2
        )
    if views.nerfstudio_frame is not None and cameras in ("test", "train", *PATHS):
        raise UserError(
            f"--nerfstudio-frame cannot be used with --cameras {cameras}",
            "it works with a file of cameras",
            exit_code=2,
        )
    sets, factor = run.cameras, run.config.downscale
    known = sets.train
    if through is not None:
        known = frames_named([*sets.train, *sets.test], through.split(","))
    if cameras in ("test", "train"):
        chosen = sets.test if cameras == "test" else sets.train
        if not chosen:
            raise UserError(f"{run.path} has no {cameras} cameras", f"use --cameras train, {', '.join(PATHS)}")
    elif cameras == "interpolate":
        chosen = paths.interpolate(known, count=views.count)
    elif cameras in PATHS:
        path = {"orbit": paths.orbit, "ellipse": paths.ellipse, "spiral": paths.spiral}[cameras]
        chosen = path(known, count=views.count, depth_hint=depth_hint)
    else:
        chosen = _frames_of(Path(cameras), views.nerfstudio_frame)
        factor = 1
    chosen = [replace(frame, camera=downscaled_camera(frame.camera, factor)) for frame in chosen]
    if views.max_size is not None:
        chosen = [replace(frame, camera=_within(frame.camera, views.max_size)) for frame in chosen]
    # Frames that share a camera share the new one too, and with it its rays.
    look = lru_cache(views.look.of)
    return [replace(frame, camera=look(frame.camera)) for frame in chosen]


def refuse_z_all_around(frames: Sequence[Frame], *, notify: Notify) -> None:
    """z is the distance along the optical axis, and half of a picture of all directions lies behind the camera.

    Raises:
        UserError: a picture is equirectangular. Lenses that see a little behind are only reported.
    """
    if any(frame.camera.is_spherical for frame in frames):
        raise UserError(
            "--depth-axis z cannot be used for equirectangular pictures: half of their directions are behind the "
            "camera",
            "use --depth-axis ray, the distance along each ray",
            exit_code=2,
        )
    if any(max(camera.fov_deg) > BEHIND_FROM_DEG for camera in {frame.camera for frame in frames}):
        notify("pixels 90 degrees or more off the optical axis have no z (NaN); use --depth-axis ray for them")


def file_fps(cameras: str) -> float | None:
    """Return the frame rate that a nerfstudio camera path gives; None of anything else."""
    path = Path(cameras)
    found = find_camera_path(path) if path.is_file() else None
    return None if found is None else read_path(found).fps


def write_frames(
    frames: Sequence[Frame], target: Path, *, fps: float, overwrite: bool = False, warn: Notify = warn_python
) -> None:
    """Write views into a folder: cameras.json, a transforms.json, and camera_path.json for nerfstudio's viewer.

    Raises:
        UserError: one of them exists, or cannot be written.
    """
    views = tuple(replace(frame, image=None, mask=None, split=None) for frame in frames)
    capture = Capture(views, np.zeros((0, 3)), (), None, "camera-path")
    refuse_frames(target, overwrite=overwrite)
    listed, path = (target / name for name in _FRAME_FILES)
    for loss in losses_camera_path(capture):
        warn(f"{path.name} cannot hold {loss}; use {listed.name} instead")
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(target, error) from error
    write_transforms(capture, listed)
    write_camera_path(capture, path, fps=fps)


def refuse_frames(target: Path, *, overwrite: bool) -> None:
    """Refuse a folder with what `write_frames` writes.

    Raises:
        UserError: one of the files exists.
    """
    if there := [target / name for name in _FRAME_FILES if (target / name).exists() and not overwrite]:
        raise UserError(f"{there[0]} exists", "add --overwrite to replace it, or choose another folder with -o")


def _frames_of(path: Path, nerfstudio_frame: Path | None) -> tuple[Frame, ...]:
    """Return the cameras of a scene, fitted to its photos, or of any file or folder that `nerfcli convert` reads."""
    if not path.exists():
        raise UserError(
            f"no cameras found at {path}",
            f"give test, train, {', '.join(PATHS)}, or a file or folder of cameras that nerfcli convert reads",
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


def _within(camera: Camera, max_size: int) -> Camera:
    """Return the camera of the picture made smaller, if need be, until its longer side fits."""
    return downscaled_camera(camera, max(1.0, max(camera.width, camera.height) / max_size))
