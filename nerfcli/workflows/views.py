"""Views of a run to render: its own cameras, a path through or around them, or the cameras of a file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from nerfcli.cameras import paths
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame, frames_named
from nerfcli.cameras.framing import cropped, equirectangular, sized, with_lens
from nerfcli.captures.formats.camera_path import find_camera_path, read_path
from nerfcli.captures.formats.registry import recognise
from nerfcli.captures.loading import with_photos_on_disk
from nerfcli.errors import UserError
from nerfcli.notices import Notify
from nerfcli.photos.loading import downscaled_camera
from nerfcli.render.coverage import small_frame
from nerfcli.render.depth import DepthRequest
from nerfcli.training.runs.run import Run

PATHS = ("orbit", "ellipse", "spiral", "interpolate")


@dataclass(frozen=True)
class PictureOptions:
    """Size, lens and crop of the pictures, where they differ from training or from the file of cameras.

    Args:
        width, height: in pixels; if only one is given, the other follows from it; with both, the picture is cropped,
            never stretched.
        lens: "pinhole", "fisheye" or "equirectangular" instead of the camera's own.
        fov_deg: of that lens, between the left and the right edge.
        crop: X,Y,WIDTH,HEIGHT of the part to render, in pixels of the picture after the other settings.
    """

    width: int | None = None
    height: int | None = None
    lens: str | None = None
    fov_deg: float | None = None
    crop: tuple[int, int, int, int] | None = None

    @property
    def words(self) -> list[str]:
        """Parts of the name of a folder, so that pictures of different looks do not share one."""
        size = [] if self.width is None and self.height is None else [f"{self.width or ''}x{self.height or ''}"]
        lens = [] if self.lens is None else [self.lens + ("" if self.fov_deg is None else f"{self.fov_deg:g}")]
        return [*size, *lens, *([] if self.crop is None else ["crop", *map(str, self.crop)])]

    def of(self, camera: Camera) -> Camera:
        """Return a camera with this size, lens and crop."""
        if self.lens == "equirectangular" and self.fov_deg is None and (self.width or self.height):
            width = self.width or 2 * (self.height or 0)
            camera = equirectangular(width, self.height or width // 2)
        else:
            camera = sized(camera, self.width, self.height)
            if self.lens is not None:
                camera = with_lens(camera, self.lens, self.fov_deg)
        return camera if self.crop is None else cropped(camera, *self.crop)


@dataclass(frozen=True)
class Views:
    """Views of a run to render.

    Args:
        cameras: test, train, a path, or a file or folder of cameras.
        count: number of views of a path.
        through: comma-separated names of the photos that a path goes through or around; None for all training photos.
        max_size: maximum longer side of the pictures, in pixels; None for no maximum.
        look: size, lens and crop of the pictures.
        part: render only these of the views, for a later call to complete; None for all.
    """

    cameras: str
    count: int = 60
    through: str | None = None
    max_size: int | None = None
    look: PictureOptions = PictureOptions()
    part: slice | None = None

    @property
    def name(self) -> str:
        """Name of these views for folders and messages."""
        name = self.cameras if self.cameras in ("test", "train", *PATHS) else Path(self.cameras).absolute().stem
        return "-".join([name, *self.look.words])


def chosen_frames(run: Run, views: Views, *, depth_hint: float) -> list[Frame]:
    """Return the frames to render.

    Args:
        depth_hint: distance to the scene's centre, for paths around it if the optical axes do not determine it.
    """
    cameras, through = views.cameras, views.through
    if through is not None and cameras not in PATHS:
        hint = f"it works with {', '.join(PATHS)}"
        raise UserError(f"--through cannot be used with --cameras {cameras}", hint, exit_code=2)
    sets, factor = run.cameras, run.config.downscale
    keyframes = sets.train
    if through is not None:
        keyframes = frames_named([*sets.train, *sets.test], [name.strip() for name in through.split(",")])
    if cameras in ("test", "train"):
        chosen = sets.test if cameras == "test" else sets.train
        if not chosen:
            raise UserError(f"{run.path} has no {cameras} cameras", f"use --cameras train, {', '.join(PATHS)}")
    elif cameras == "interpolate":
        chosen = paths.interpolate(keyframes, count=views.count)
    elif cameras in PATHS:
        path = {"ellipse": paths.ellipse, "orbit": paths.orbit, "spiral": paths.spiral}[cameras]
        chosen = path(keyframes, count=views.count, depth_hint=depth_hint)
    else:
        return frames_of_file(views)
    return _presented([replace(frame, camera=downscaled_camera(frame.camera, factor)) for frame in chosen], views)


def frames_of_file(views: Views) -> list[Frame]:
    """Return the frames of a file or folder of cameras: in a folder, those of the photos there, rescaled to them."""
    path = Path(views.cameras)
    if not path.exists():
        hint = f"give test, train, {', '.join(PATHS)}, or a file or folder of cameras that nerfcli convert reads"
        raise UserError(f"no cameras found at {path}", hint)
    form, found = recognise(path)
    capture = form.parse(found)
    if path.is_dir() and form.name != "run" and any(frame.has_photo for frame in capture.frames):
        capture = with_photos_on_disk(path, form, found, capture)
    return _presented(capture.frames, views)


def _presented(chosen: Sequence[Frame], views: Views) -> list[Frame]:
    """Return frames with the size, lens and crop of the views."""
    if views.max_size is not None:
        chosen = [small_frame(frame, views.max_size) for frame in chosen]
    # Frames that share a camera share the new one too, and with it its rays.
    look = lru_cache(views.look.of)
    return [replace(frame, camera=look(frame.camera)) for frame in chosen]


def usual_axis(run: Run, views: Views) -> str:
    """Return the usual axis of depth: "z", but "ray" for pictures of all directions, half of which have no z.

    These are the views of photos that are panoramas; pictures along a path are not, unless their lens is chosen so. The
    cameras of a file are not looked at.
    """
    if views.look.lens is not None:
        return "ray" if views.look.lens == "equirectangular" else "z"
    photos = {"test": run.cameras.test, "train": run.cameras.train}.get(views.cameras, [])
    return "ray" if any(frame.camera.is_spherical for frame in photos) else "z"


def usual_depth(run: Run, views: Views) -> DepthRequest:
    """Return the depth that is rendered unless another one is wanted: conditional, along `usual_axis`."""
    return DepthRequest(convention="conditional", axis=usual_axis(run, views))


def refuse_z_of_panoramas(frames: Sequence[Frame], *, notify: Notify) -> None:
    """Refuse depth along the optical axis, z, for pictures of all directions: half of them is behind the camera.

    Raises:
        UserError: a picture is equirectangular. For other lenses that see behind the camera, only a note is shown.
    """
    if any(frame.camera.is_spherical for frame in frames):
        raise UserError(
            "--depth-axis z cannot be used for equirectangular pictures: half of their directions are behind the "
            "camera",
            "use --depth-axis ray, the distance along each ray",
            exit_code=2,
        )
    # A lens with a larger field of view sees behind the camera.
    if any(max(camera.fov_deg) > 180.0 for camera in {frame.camera for frame in frames}):
        notify("pixels 90 degrees or more off the optical axis have no z (NaN); use --depth-axis ray for them")


def file_fps(cameras: str) -> float | None:
    """Return the frame rate of a nerfstudio camera path; None for anything else."""
    path = Path(cameras)
    found = find_camera_path(path) if path.is_file() else None
    return None if found is None else read_path(found).fps
