"""Reference pictures of up to three cameras, rendered by the kernels, for the page to check the visitor's device."""

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
FRACTION = 0.25
# Maps of the proof after the colour, in this order; see `compare` in check.js.
MAPS = (
    *("opacity", "conditional", "median", "max-weight", "moment", "background", "quantile"),
    *("spread", "disagreement"),
)


@dataclass(frozen=True)
class Proof:
    """Reference pictures for the page.

    Args:
        description: cameras and maps, plain values.
        expected: float32, by camera, then map, then row; depths along the optical axis in scene units, NaN where
            undefined.
    """

    description: dict[str, Any]
    expected: np.ndarray


def make_proof(model: Model, frames: Sequence[Frame]) -> Proof:
    """Render the proof of a model: small pinhole pictures of a few frames, spread evenly.

    Args:
        frames: pinhole frames, at least one.
    """
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, CAMERAS).astype(int))]
    small = [Frame(frame.name, _small(frame.camera), frame.world_from_cam) for frame in chosen]
    columns = [values for frame in small for values in _maps(model, frame)]
    description = {
        "width": WIDTH,
        "height": HEIGHT,
        "share": FRACTION,
        "maps": list(MAPS),
        "cameras": [view_of(frame) for frame in small],
    }
    return Proof(description, np.concatenate(columns).astype("<f4"))


def _small(camera: Camera) -> Camera:
    """Return a 64 x 48 pinhole camera with the view cropped to that aspect ratio."""
    scale = max(WIDTH / camera.width, HEIGHT / camera.height)
    return Camera.pinhole(WIDTH, HEIGHT, camera.focal_px * scale)


def _maps(model: Model, frame: Frame) -> list[np.ndarray]:
    """Render the colour and `MAPS` of one camera as `nerfcli render` does, each flattened."""
    farthest = model.marching.far / model.training_from_scene.scale
    pictures = {}
    for name in ("conditional", "max-weight", "moment", "background", "quantile"):
        convention = f"quantile:{FRACTION}" if name == "quantile" else name
        request = DepthRequest(convention, "z", background_distance=farthest)
        pictures[name] = render_picture(model, frame, background=model.background, depth=request)
    first = pictures["conditional"]
    maps = {name: getattr(first, name) for name in ("opacity", "median", "spread", "disagreement")}
    maps |= {name: picture.depth for name, picture in pictures.items()}
    return [first.rgb.reshape(-1), *(np.asarray(maps[name]).reshape(-1) for name in MAPS)]
