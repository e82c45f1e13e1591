"""What an export shall hold, and what its depth files mean."""

from dataclasses import asdict, dataclass
from typing import Any

from nerfcli.media.depth import DepthMeta
from nerfcli.render.depth import DepthRequest, effective_floor
from nerfcli.render.model import Model

OUTPUTS = ("rgb", "depth", "opacity")


@dataclass(frozen=True)
class ExportSettings:
    """What to write.

    Args:
        outputs: some of `OUTPUTS`.
        depth: which depth, where "depth" is among the outputs.
        npy: depth as .npy beside the TIFF.
        video: an MP4 of each output.
        fps: frames per second of the videos.
    """

    outputs: tuple[str, ...]
    depth: DepthRequest
    npy: bool
    video: bool
    fps: float

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "outputs": list(self.outputs)}


def depth_meta(model: Model, request: DepthRequest) -> DepthMeta:
    """The meaning of the depth files that `request` makes."""
    return DepthMeta(
        convention=request.convention,
        axis=request.axis,
        unit=model.unit,
        opacity_floor=effective_floor(request),
        background_distance=request.background_distance if request.convention == "background" else None,
    )
