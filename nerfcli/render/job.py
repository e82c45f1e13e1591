"""A job: which views of which field to render; and whether a folder already holds the result."""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

from nerfcli.atomic import read_json
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.render.coverage import DepthMap
from nerfcli.render.depth_errors import DepthErrors
from nerfcli.render.files.film import check_encoders
from nerfcli.render.outputs import ExportSettings
from nerfcli.version import __version__

DESCRIPTION = "render.json"
_IN_WORDS = {"levels": "16-bit levels", "video": "videos"}


def file_names(frames: Sequence[Frame]) -> list[str]:
    """Return the frames' names without suffix, with subfolders; the suffix stays where names would be the same.

    ".." in a name ("../images") is replaced by "up", so that nothing is written outside the export.
    """
    names = ["/".join("up" if part == ".." else part for part in PurePosixPath(frame.name).parts) for frame in frames]
    stems = [str(PurePosixPath(name).with_suffix("")) for name in names]
    taken = Counter([*stems, *names])
    # A name without a suffix is its own stem, and counts twice.
    return [stem if taken[stem] == 1 + (stem == name) else name for stem, name in zip(stems, names, strict=True)]


def describe_frames(frames: Sequence[Frame]) -> list[dict[str, Any]]:
    """Return files, cameras and poses of the pictures, as stored in render.json."""
    return [
        {"file": name, "camera": frame.camera.to_json(), "world_from_cam": frame.world_from_cam.tolist()}
        for frame, name in zip(frames, file_names(frames), strict=True)
    ]


def with_suffix(stem: Path, suffix: str) -> Path:
    """Add a suffix to a name; an existing suffix is kept, since it distinguishes a.jpg from a.png."""
    return stem.with_name(stem.name + suffix)


@dataclass(frozen=True)
class RenderJob:
    """Views, settings and provenance of a rendering job.

    Args:
        frames: cameras and poses in the scene's frame.
        provenance: all else that determines the pictures, such as the run and the hash of its field; plain values.
        photo_depths: depth maps of the training photos, if `ExportSettings.needs_visibility`; the provenance names the
            photos.
        depth_errors: measured depth errors of the field, if `ExportSettings.needs_errors`.
    """

    frames: tuple[Frame, ...]
    settings: ExportSettings
    provenance: dict[str, Any]
    photo_depths: tuple[DepthMap, ...] = ()
    depth_errors: DepthErrors | None = None

    @cached_property
    def names(self) -> list[str]:
        """File names of the frames, without suffix."""
        return file_names(self.frames)

    def rays(self, index: int) -> int:
        """Return the number of rays of a frame."""
        camera = self.frames[index].camera
        return camera.width * camera.height

    def key(self) -> dict[str, Any]:
        """Return everything that determines the rendered numbers, as plain values."""
        return {
            "nerfcli": __version__,
            "settings": self.settings.pixel_settings(),
            "frames": describe_frames(self.frames),
            **self.provenance,
        }

    @cached_property
    def digest(self) -> str:
        """Twelve hexadecimal digits that differ where the rendered numbers may differ."""
        text = json.dumps(self.key(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def results(self, folder: Path) -> list[Path]:
        """Return the paths to show: the videos if there are any, else the folders of the outputs."""
        video = self.settings.video
        if video is None:
            return [folder / output for output in (*self.settings.outputs, *self.settings.folders_of_formats)]
        return [folder / f"{output}.{form}" for form in video.formats for output in self.settings.outputs]

    def check(self) -> None:
        """Refuse a job that would fail only after the last picture is rendered.

        Raises:
            UserError: an encoder is missing, or a video would have pictures of different sizes.
        """
        if self.settings.video is None:
            return
        check_encoders(self.settings.video.formats)
        sizes = sorted({frame.camera.size for frame in self.frames})
        if len(sizes) > 1:
            listed = ", ".join(f"{width}x{height}" for width, height in sizes[:4])
            raise UserError(
                f"the views have {len(sizes)} different sizes ({listed}), which cannot be combined in a video",
                "remove the video options, or choose cameras of a single size",
            )

    def is_held_by(self, folder: Path) -> bool:
        """Return whether the finished folder already holds this job, pictures and presentation.

        It is also False if the folder holds the same pictures and nothing would be replaced, as when videos are added.

        Raises:
            UserError: it holds another job.
        """
        made = _made(folder)
        if made is None:
            return False
        wanted = self.key()
        del wanted["nerfcli"]
        depth, there = wanted["settings"]["depth"], made.get("settings", {}).get("depth")
        if self.settings.measured and depth != there and isinstance(there, dict):
            names = [name for name in {**depth, **there} if there.get(name) != depth.get(name)]
            differing = [f"{name} {there.get(name)}, not {depth.get(name)}" for name in names]
            raise UserError(
                f"{folder} contains depth with another definition: {', '.join(differing)}",
                "choose another folder with -o, or add --overwrite to replace the whole folder",
            )
        if any(made.get(key) != value for key, value in wanted.items()):
            raise UserError(f"{folder} exists", "add --overwrite to replace it, or choose another folder with -o")
        presentation = self.settings.of_presentation()
        differing = [key for key, value in presentation.items() if made.get(key) != value]
        if not differing:
            return True
        if self.shares_pictures_with(folder) and all(made.get(key) is None for key in differing):
            return False
        raise UserError(
            f"{folder} contains the same pictures with different {' and '.join(_IN_WORDS[key] for key in differing)}",
            "add --overwrite to write them again from the pictures, which are kept, or choose another folder with -o",
        )

    def shares_pictures_with(self, folder: Path) -> bool:
        """Return whether a finished folder holds the same pictures, with other 16-bit files or videos."""
        try:
            made = _made(folder)
        except UserError:  # a damaged description cannot be compared; everything is rendered again
            return False
        if made is None or "files" not in made:
            return False
        presentation = self.settings.of_presentation()
        return all(made.get(key) == value for key, value in self.key().items()) and any(
            made.get(key) != value for key, value in presentation.items()
        )


def _made(folder: Path) -> dict[str, Any] | None:
    """Return the description of a finished folder; None if there is none."""
    if not (folder / DESCRIPTION).exists():
        return None
    hint = "add --overwrite to render again, or choose another folder with -o"
    return read_json(folder / DESCRIPTION, needed=("settings",), hint=hint)


def refuse_foreign(folder: Path) -> None:
    """Refuse a path that is taken by something other than an export.

    Raises:
        UserError: it is a file, or a folder with other contents.
    """
    if folder.is_file() or (folder.is_dir() and not (folder / DESCRIPTION).exists() and any(folder.iterdir())):
        raise UserError(f"{folder} exists and does not contain renders", "choose another folder with -o")
