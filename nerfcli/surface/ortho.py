"""A field seen from straight above by parallel rays: colours and heights on a grid, as maps need them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import up_direction, views_of
from nerfcli.errors import UserError
from nerfcli.render.model import Model
from nerfcli.render.tracing import TOLERANCE, render_rays
from nerfcli.render.visibility import DepthMap, sees
from nerfcli.surface.views import DepthView

# Most pixels of a map, and of the longer side if the size of a pixel is not given.
MOST_PIXELS, MOST_SIDE = 2**26, 8192
# Number of photos that must see a place. On 38 photos of flat ground by a drone, 36 % of the heights that two photos
# saw were more than 1.5 m too low, 2.5 % of those that three saw, and 0.01 % with four.
SEEN = 3
_BLOCK = 2**16
# Cosines: cameras look down if their mean view is this close to -z, and z is up if it is this close to the up
# direction of cameras that look ahead.
_DOWN, _UP = math.cos(math.radians(45)), math.cos(math.radians(20))


@dataclass(frozen=True)
class Ortho:
    """A map of a scene, north up: row 0 has the largest y.

    Args:
        corner: (x, y) of the outer corner of the top left pixel, scene units.
        pixel_size: side of a pixel, scene units.
        rgba: (H, W, 4) uint8 sRGB; alpha is 0 where fewer than three photos see the surface, else 255.
        heights: (H, W) float32, z at which half of the light from above ends; NaN where alpha is 0.
    """

    corner: tuple[float, float]
    pixel_size: float
    rgba: np.ndarray
    heights: np.ndarray


def check_upright(frames: Sequence[Frame]) -> None:
    """Refuse a scene whose z axis does not point up.

    Raises:
        UserError: the cameras look down along another axis, or stand upright along another one.
    """
    view, up = views_of(frames).mean(axis=0), up_direction(frames)
    if -view[2] < _DOWN and up[2] < _UP:
        raise UserError(
            "the z axis of the scene does not point up, as its cameras stand",
            "first make a scene with nerfcli convert SCENE NEW --to nerfcli --georeference gps (or a file of control "
            "points), or with --world-up z, and train on it",
        )


def typical_depth(views: Sequence[DepthView]) -> float:
    """Return the median over photos of their median depth, scene units.

    Raises:
        UserError: no photo sees a surface.
    """
    depths = [float(np.nanmedian(view.depth)) for view in views if np.isfinite(view.depth).any()]
    if not depths:
        raise UserError("no photo sees a surface", "train longer, or check the run with nerfcli report RUN")
    return float(np.median(depths))


def automatic_pixel(frames: Sequence[Frame], factor: int, depth: float, box: tuple[float, ...]) -> float:
    """Return the size of a pixel: that of the photos at a depth, or larger if the map had too many pixels.

    Args:
        factor: by which photos were reduced for the training.
    """
    focal = float(np.median([frame.camera.focal_px for frame in frames])) / factor
    return max(depth / focal, max(box[3] - box[0], box[4] - box[1]) / MOST_SIDE)


@torch.no_grad()
def ortho_of(
    model: Model,
    views: Sequence[DepthMap],
    box: tuple[float, ...],
    pixel_size: float,
    *,
    height_above: float,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> Ortho:
    """Render a map of a box; what is above the box is left out.

    Args:
        views: depths of the photos, which tell what they see.
        box: x0, y0, z0, x1, y1, z1 in the scene's frame.
        pixel_size: scene units.
        height_above: typical height of the photos above the surface, scene units.

    Raises:
        UserError: it would have too many pixels.
    """
    width, height = (max(1, math.ceil(round((box[i + 3] - box[i]) / pixel_size, 6))) for i in (0, 1))
    if width * height > MOST_PIXELS:
        least = math.sqrt((box[3] - box[0]) * (box[4] - box[1]) / MOST_PIXELS)
        raise UserError(
            f"pixels of {pixel_size:.4g} make a map of {width}x{height}; at most {MOST_PIXELS} pixels are supported",
            f"use a smaller --box, or a --voxel-size of at least {1.01 * least:.2g}",
        )
    rgba = np.zeros((height * width, 4), np.uint8)
    heights = np.full(height * width, np.nan, np.float32)
    for first in range(0, height * width, _BLOCK):
        index = np.arange(first, min(first + _BLOCK, height * width))
        places = np.stack(
            [
                box[0] + pixel_size * (index % width + 0.5),
                box[4] - pixel_size * (index // width + 0.5),
                np.full(len(index), box[5]),
            ],
            axis=1,
        )
        colours, depth = _from_above(model, places, reach=box[5] - box[2], height=height_above)
        places[:, 2] -= depth
        hit = np.flatnonzero(np.isfinite(depth))
        photos = np.zeros(len(index), np.int64)
        for view in views:
            photos[hit] += sees(view, places[hit])
        shown = photos >= SEEN
        rgba[index[shown]] = np.column_stack([colours, np.full(len(index), 255, np.uint8)])[shown]
        heights[index[shown]] = places[shown, 2]
        on_progress((index[-1] + 1) / (height * width))
    return Ortho((box[0], box[4]), pixel_size, rgba.reshape(height, width, 4), heights.reshape(height, width))


def _from_above(model: Model, places: np.ndarray, *, reach: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours (N, 3) uint8 below places (N, 3) at the top of a box, and how far below (N,) the surface is.

    A distance is NaN where less than half of the light ends within `reach`. Rays are cut as finely as those of photos
    taken from `height`.
    """
    similarity, marching = model.training_from_scene, model.marching
    down = np.array([0.0, 0.0, -1.0])
    origins = torch.from_numpy(similarity.apply(places)).float().to(model.device)
    towards = torch.from_numpy(similarity.rotation @ down).float().to(model.device).expand_as(origins).contiguous()
    length = similarity.scale * reach
    step = max(marching.shortest_step, marching.growth * similarity.scale * height)
    seen = render_rays(
        model,
        origins,
        towards,
        cuts=torch.linspace(0.0, length, max(2, math.ceil(length / step)) + 1, device=model.device),
        background=torch.zeros(3, device=model.device),
        fractions=(0.5,),
        tolerance=TOLERANCE,
        keep_intervals=False,
    )
    depth = seen.ends.quantiles[:, 0] / similarity.scale
    colours = seen.rgb / seen.ends.opacity[:, None].clamp_min(1e-9)
    colours = (255 * colours.clamp(0.0, 1.0)).round().to(torch.uint8)
    return colours.cpu().numpy(), depth.cpu().numpy()
