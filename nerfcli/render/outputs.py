"""Settings of an export: outputs, file formats, videos."""

from dataclasses import asdict, dataclass
from typing import Any

from nerfcli.render import depth_errors
from nerfcli.render.depth import MEDIAN, DepthRequest, effective_floor
from nerfcli.render.files.depth_pictures import CONVENTION_OF, QUANTITIES, DepthMeta
from nerfcli.render.renderable import Renderable

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
    """Settings of the videos.

    Args:
        formats: some of `render.files.film.ENCODERS`; a video of each output in each.
        fps: frames per second.
    """

    formats: tuple[str, ...] = ("mp4",)
    fps: float = 24.0


@dataclass(frozen=True)
class ExportSettings:
    """Settings of an export.

    Args:
        outputs: some of `OUTPUTS`.
        depth: the definition of depth, if "depth" is among the outputs.
        formats: some of `FORMATS`, for measured outputs. 16-bit levels are computed from float files, which are kept.
        step: length of the steps along rays, relative to those of the training.
        rgba: colours without the background, with the opacity as straight alpha.
    """

    outputs: tuple[str, ...]
    depth: DepthRequest
    formats: tuple[str, ...] = ("tiff",)
    video: VideoSettings | None = None
    step: float = 1.0
    rgba: bool = False

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
        for name in ("min_views", "min_parallax_deg"):
            if not settings["depth"][name]:  # as in folders that were written before these settings existed
                del settings["depth"][name]
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
