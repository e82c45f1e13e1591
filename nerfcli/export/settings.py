"""What an export shall hold: which pictures, in which files, and which videos of them."""

from dataclasses import asdict, dataclass
from typing import Any

from nerfcli.media.depth import DepthMeta
from nerfcli.render.depth import DepthRequest, effective_floor
from nerfcli.render.model import Model

OUTPUTS = ("rgb", "depth", "opacity")
# Those that are measured: floats on disk, and pictures in colours to look at.
MEASURED = ("depth",)
LAYOUTS = ("separate", "side-by-side")
DIRECTIONS = ("forward", "reverse", "ping-pong")


@dataclass(frozen=True)
class VideoSettings:
    """Which videos to make of the pictures.

    Args:
        formats: some of `media.video.FORMATS`; a video in each.
        layout: one of `LAYOUTS`: a video of each output, or all outputs in one.
        direction: one of `DIRECTIONS`; "ping-pong" goes back without showing the ends twice, so that it loops evenly.
        fps: frames per second.
        crf: constant quality, 0 is best; the format's own if None.
        plays: times the clip is shown; 0 is for ever, in a gif only. None: for ever in a gif, else once.
    """

    formats: tuple[str, ...] = ("mp4",)
    layout: str = "separate"
    direction: str = "forward"
    fps: float = 24.0
    crf: int | None = None
    plays: int | None = None


@dataclass(frozen=True)
class ExportSettings:
    """What to write.

    Args:
        outputs: some of `OUTPUTS`.
        depth: which depth, where "depth" is among the outputs.
        npy: depth as .npy beside the TIFF.
        colour_map: of what is measured, one of `media.colour_maps.COLOUR_MAPS`.
        video: which videos; None for none.
    """

    outputs: tuple[str, ...]
    depth: DepthRequest
    npy: bool = False
    colour_map: str = "turbo"
    video: VideoSettings | None = None

    def of_pictures(self) -> dict[str, Any]:
        """Plain values of what decides over the rendered numbers and their files."""
        settings = asdict(self)
        del settings["colour_map"], settings["video"]
        return settings | {"outputs": list(self.outputs)}

    def of_presentation(self) -> dict[str, Any]:
        """Plain values of what decides over the previews and videos that are made of these files."""
        video = None if self.video is None else asdict(self.video) | {"formats": list(self.video.formats)}
        return {"colour_map": self.colour_map, "video": video}


def depth_meta(model: Model, request: DepthRequest) -> DepthMeta:
    """The meaning of the depth files that `request` makes."""
    return DepthMeta(
        convention=request.convention,
        axis=request.axis,
        unit=model.unit,
        opacity_floor=effective_floor(request),
        background_distance=request.background_distance if request.convention == "background" else None,
    )
