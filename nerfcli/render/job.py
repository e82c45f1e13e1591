"""A rendering job: which views of which field, its outputs and file formats; and whether a folder holds the result."""

import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

from nerfcli import __version__
from nerfcli.atomic import read_json, write_json
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.output import Output
from nerfcli.render import depth_errors
from nerfcli.render.coverage import DepthMap
from nerfcli.render.depth import MEDIAN, DepthRequest, effective_floor
from nerfcli.render.depth_errors import DepthErrors
from nerfcli.render.files.depth_meta import CONVENTION_OF, QUANTITIES, DepthMeta
from nerfcli.render.files.file_facts import RENDERS
from nerfcli.render.files.film import ENCODERS, check_encoders
from nerfcli.render.pictures import Renderable

OUTPUTS = ("rgb", "depth", "opacity", *CONVENTION_OF)
# Measured outputs, which are stored as floats, with previews in false colours.
MEASURED = QUANTITIES
# A file in format exr holds all requested outputs of a view.
FLOAT_FORMATS = ("tiff", "exr", "npy")
FORMATS = (*FLOAT_FORMATS, "png16")
EXR_FOLDER, LEVELS_FOLDER = "exr", "depth16"
# Background of pictures with alpha: their colours are then premultiplied and contain no background.
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class VideoSettings:
    """Videos of each output in some of `render.files.film.ENCODERS`, with `fps` frames per second."""

    formats: tuple[str, ...] = ("mp4",)
    fps: float = 24.0


@dataclass(frozen=True)
class RenderSettings:
    """Settings of a rendering.

    Args:
        outputs: some of `OUTPUTS`.
        depth: the definition of depth, if "depth" is among the outputs.
        formats: some of `FORMATS`, for measured outputs. 16-bit levels are computed from float files, which are kept.
        step: length of the steps along rays, relative to those of the training.
        rgba: colours without the background, with the opacity as straight alpha.
        check_accuracy: measure the error of every picture, instead of the first and the last.
    """

    outputs: tuple[str, ...]
    depth: DepthRequest
    formats: tuple[str, ...] = ("tiff",)
    video: VideoSettings | None = None
    step: float = 1.0
    rgba: bool = False
    check_accuracy: bool = False

    @property
    def measured(self) -> tuple[str, ...]:
        """The outputs that are measured, in the order of `MEASURED`."""
        return tuple(output for output in MEASURED if output in self.outputs)

    @property
    def needs_visibility(self) -> bool:
        """True if coverage and parallax of the surface are needed."""
        wanted = {"coverage", "parallax"} & set(self.outputs)
        return bool(wanted or self.depth.min_views or self.depth.min_parallax_deg or self.needs_errors)

    @property
    def needs_errors(self) -> bool:
        """True if the measured errors of depth are needed."""
        return bool({"lower", "upper", "confidence"} & set(self.outputs))

    @property
    def float_formats(self) -> tuple[str, ...]:
        """The formats of floats: at least one, because previews and levels are made from them."""
        return tuple(name for name in FLOAT_FORMATS if name in self.formats) or FLOAT_FORMATS[:1]

    @property
    def folders_of_formats(self) -> tuple[str, ...]:
        """Folders of files that hold all requested outputs of a view, and of 16-bit levels."""
        exr = bool(self.measured) and "exr" in self.float_formats
        return (*([EXR_FOLDER] if exr else []), *([LEVELS_FOLDER] if self.in_levels else []))

    @property
    def in_levels(self) -> bool:
        """True if depth is also written as 16-bit levels."""
        return "png16" in self.formats and "depth" in self.outputs

    def pixel_settings(self) -> dict[str, Any]:
        """Return the settings that determine the rendered numbers and their files, as plain values."""
        settings = asdict(self)
        del settings["video"]
        return settings | {"outputs": list(self.outputs), "formats": list(self.float_formats)}

    def of_presentation(self) -> dict[str, Any]:
        """Return the settings that determine the previews and videos made from these files, as plain values."""
        video = None if self.video is None else asdict(self.video) | {"formats": list(self.video.formats)}
        return {"levels": self.in_levels or None, "video": video}


def depth_meta(model: Renderable, request: DepthRequest) -> DepthMeta:
    """Return the definition of the depth that `request` asks for."""
    return DepthMeta(
        convention=request.convention,
        axis=request.axis,
        unit=model.unit,
        unit_source=model.unit_source,
        opacity_floor=effective_floor(request),
        background_distance=request.background_distance if request.convention == "background" else None,
        min_views=request.min_views,
        min_parallax_deg=request.min_parallax_deg,
    )


def meaning_of(meta: DepthMeta, request: DepthRequest, output: str) -> DepthMeta:
    """Return the definition of a measured output of a picture whose depth is defined by `meta`."""
    level, tolerance = depth_errors.LEVEL, depth_errors.TOLERANCE
    number = {"lower": level, "upper": level, "confidence": tolerance}.get(output)
    convention = None if number is None else f"{output}:{number:g}"
    return meta.of(output, opacity_floor=floor_of(request, output), convention=convention)


def floor_of(request: DepthRequest, output: str) -> float:
    """Return the opacity below which a pixel has no value in a measured output."""
    match output:
        case "depth":
            return effective_floor(request)
        case "spread":
            return request.min_opacity
    return max(request.min_opacity, MEDIAN)  # all others need the median, too


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


def with_suffix(stem: Path, suffix: str) -> Path:
    """Add a suffix to a name; an existing suffix is kept, since it distinguishes a.jpg from a.png."""
    return stem.with_name(stem.name + suffix)


@dataclass(frozen=True)
class RenderJob:
    """Views, settings and provenance of a rendering job.

    Args:
        provenance: all else that determines the pictures, such as the run and the hash of its field; plain values.
        photo_depths: depth maps of the training photos, if `RenderSettings.needs_visibility`; the provenance names the
            photos.
        depth_errors: measured depth errors of the field, if `RenderSettings.needs_errors`.
    """

    frames: tuple[Frame, ...]
    settings: RenderSettings
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
        frames = [
            {"file": name, "camera": frame.camera.to_json(), "world_from_cam": frame.world_from_cam.tolist()}
            for frame, name in zip(self.frames, self.names, strict=True)
        ]
        settings = self.settings.pixel_settings()
        return {"nerfcli": __version__, "settings": settings, "frames": frames, **self.provenance}

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

    def remove_other_presentation(self, folder: Path) -> None:
        """Remove videos and 16-bit levels of a finished folder that are not wanted.

        The description first: until others are complete, it names none.
        """
        write_json(folder / RENDERS, {**_made(folder), **dict.fromkeys(self.settings.of_presentation())})
        if not self.settings.in_levels:
            shutil.rmtree(folder / LEVELS_FOLDER, ignore_errors=True)
        wanted = self.results(folder) if self.settings.video else []
        for path in (folder / f"{output}.{form}" for output in OUTPUTS for form in ENCODERS):
            if path not in wanted:
                path.unlink(missing_ok=True)

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

    def is_kept_in(self, folder: Path, output: Output) -> bool:
        """Return whether the finished folder holds this job, pictures and presentation, and stays.

        Also False if it holds the same pictures, and only videos or levels have to be added.

        Raises:
            UserError: it holds something else that may not be replaced.
        """
        if folder.is_file() or (folder.is_dir() and not (folder / RENDERS).exists() and any(folder.iterdir())):
            raise UserError(f"{folder} exists and does not contain renders", "choose another folder with -o")
        if output.overwrite or not (folder / RENDERS).exists():
            return False
        made = _made(folder)
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
        output.keeps(folder, lambda: all(made.get(key) == value for key, value in wanted.items()))
        presentation = self.settings.of_presentation()
        differing = [key for key, value in presentation.items() if made.get(key) != value]
        if not differing:
            return True
        if self.facts_in(folder) is not None and all(made.get(key) is None for key in differing):
            return False
        raise UserError(
            f"{folder} contains the same pictures with different {' and '.join(_IN_WORDS[key] for key in differing)}",
            "add --overwrite to write them again from the pictures, which are kept, or choose another folder with -o",
        )

    def facts_in(self, folder: Path) -> dict[str, Any] | None:
        """Return the facts about the frames of a finished folder with the same pictures and other videos or levels."""
        if not (folder / RENDERS).exists():
            return None
        try:
            made = _made(folder)
        except UserError:  # a damaged description cannot be compared; everything is rendered again
            return None
        same = all(made.get(key) == value for key, value in self.key().items())
        presentation = self.settings.of_presentation()
        return made["facts"] if same and any(made.get(key) != value for key, value in presentation.items()) else None


def _made(folder: Path) -> dict[str, Any]:
    """Return the description of a finished folder."""
    hint = "add --overwrite to render again, or choose another folder with -o"
    return read_json(folder / RENDERS, needed=("settings", "facts"), hint=hint)
