"""Small pictures of three cameras by the kernels, for a page to compare with what a visitor's device draws."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.viewer.pictures import view_of

WIDTH, HEIGHT = 64, 48
CAMERAS = 3
SHARE = 0.25
# Of the proof, besides the colour, in this order; see `compare` in check.js.
MAPS = (
    *("opacity", "conditional", "median", "max-weight", "moment", "background", "quantile"),
    *("spread", "disagreement"),
)


@dataclass(frozen=True)
class Proof:
    """Pictures that the page is compared with.

    Args:
        description: cameras and maps, plain values.
        expected: float32, camera by camera, map by map, row by row; depths along the optical axis in scene units, NaN
            where undefined.
    """

    description: dict[str, Any]
    expected: np.ndarray


def make_proof(model: Model, frames: Sequence[Frame]) -> Proof:
    """Render the proof of a model: some of the frames as small pinhole pictures with half of their focal length's view.

    Args:
        model: of the page.
        frames: pinhole ones, at least one.
    """
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, CAMERAS).astype(int))]
    small = [Frame(frame.name, _small(frame.camera), frame.world_from_cam) for frame in chosen]
    columns = [values for frame in small for values in _maps(model, frame)]
    description = {
        "width": WIDTH,
        "height": HEIGHT,
        "share": SHARE,
        "maps": list(MAPS),
        "cameras": [view_of(frame) for frame in small],
    }
    return Proof(description, np.concatenate(columns).astype("<f4"))


def _small(camera: Camera) -> Camera:
    """Return a picture of 64 x 48 that shows as much as fits into it."""
    scale = max(WIDTH / camera.width, HEIGHT / camera.height)
    return Camera.pinhole(WIDTH, HEIGHT, camera.focal_px * scale)


def _maps(model: Model, frame: Frame) -> list[np.ndarray]:
    """Return the picture of one camera, pixel by pixel inside a map: as `nerfcli render` makes it."""
    farthest = model.marching.far / model.training_from_scene.scale
    pictures = {}
    for name in MAPS[1:-2]:
        convention = f"quantile:{SHARE}" if name == "quantile" else name
        request = DepthRequest(convention, "z", background_distance=farthest)
        pictures[name] = render_picture(model, frame, background=model.background, depth=request)
    first = pictures["conditional"]
    maps = {"opacity": first.opacity, "spread": first.spread, "disagreement": first.disagreement}
    maps |= {name: picture.depth for name, picture in pictures.items()}
    return [first.rgb.reshape(-1), *(np.asarray(maps[name]).reshape(-1) for name in MAPS)]
