"""Whole pictures of a trained model: colour, opacity and any of the five depths, tile by tile."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.cameras.frame import Frame
from nerfcli.render import depth as depth_of_rays
from nerfcli.render.model import Model
from nerfcli.render.rays import frame_rays

# Colour is asked for only where the weight of a sample can show: forty of these make one grey level.
NEGLIGIBLE_WEIGHT = 1e-4
# Rays end where a hundred-thousandth of the light is left, far less than a grey level.
DEEPEST = 11.5
RAYS_PER_TILE = 4096


@dataclass(frozen=True)
class DepthRequest:
    """Which depth to render.

    Args:
        convention: one of `depth.CONVENTIONS`.
        axis: "ray" for the distance along the ray, "z" for that along the optical axis.
        opacity_floor: rays that are not more opaque than this have no conditional or max-weight depth.
        background_distance: distance along the ray that the background convention counts for what passes, in the
            scene's unit; needed by that convention only.
    """

    convention: str
    axis: str
    opacity_floor: float = 0.5
    background_distance: float | None = None


@dataclass(frozen=True)
class Picture:
    """What was seen from one frame, in NumPy.

    Args:
        rgb: (H, W, 3) float32 sRGB in [0, 1], composited on the background.
        opacity: (H, W) float32 in [0, 1].
        depth: (H, W) float32 in the scene's unit, NaN where undefined; None when not asked for.
        valid: (H, W) bool; False where the lens has no ray (rgb is then the background, opacity 0).
    """

    rgb: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray | None
    valid: np.ndarray


@torch.no_grad()
def render_picture(
    model: Model,
    frame: Frame,
    *,
    background: tuple[float, float, float],
    depth: DepthRequest | None = None,
    on_tile: Callable[[int], None] | None = None,
) -> Picture:
    """Render one frame.

    Args:
        model: the trained model.
        frame: camera and pose in the scene's frame.
        background: sRGB behind everything.
        depth: which depth to compute along with the colour.
        on_tile: called with the number of rays after each tile.
    """
    rays = frame_rays(frame, model.training_from_scene, model.device)
    behind = rays.directions.new_tensor(background)
    columns = []
    for directions in rays.directions.split(RAYS_PER_TILE):
        origins = rays.origin.expand_as(directions)
        columns.append(render_rays(model, origins, directions, background=behind, depth=depth))
        if on_tile is not None:
            on_tile(len(directions))
    rgb, opacity, distance = (torch.cat(column) for column in zip(*columns, strict=True))
    rgb[~rays.valid] = behind
    opacity[~rays.valid] = 0.0
    shape = (rays.height, rays.width)
    picture_depth = None
    if depth is not None:
        distance = distance / model.training_from_scene.scale
        distance = distance * rays.cosines if depth.axis == "z" else distance
        distance[~rays.valid] = torch.nan
        picture_depth = distance.reshape(shape).cpu().numpy()
    return Picture(
        rgb=rgb.clamp(0.0, 1.0).reshape(*shape, 3).cpu().numpy(),
        opacity=opacity.reshape(shape).cpu().numpy(),
        depth=picture_depth,
        valid=rays.valid.reshape(shape).cpu().numpy(),
    )


def render_rays(
    model: Model, origins: Tensor, directions: Tensor, *, background: Tensor, depth: DepthRequest | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (R, 3) on `background` (3,), opacity (R,), and distance (R,) in the training frame, NaN if not asked for.

    Args:
        model: the trained model.
        origins, directions: (R, 3) in the training frame, unit directions.
        background: (3,) sRGB.
        depth: which depth; its axis is the caller's business.
    """
    starts, ends, density, encoded, _, offsets = kernels.visible_samples(
        origins,
        directions,
        model.marching.edges().to(directions),
        jitter=torch.full_like(directions[:, 0], 0.5),
        occupied=model.occupied,
        unbounded=model.field.settings.unbounded,
        table=model.field.table,
        resolutions=model.field.settings.resolutions,
        weights=tuple(model.field.weights),
        deepest=DEEPEST,
    )
    weights, _ = kernels.interval_weights(density, ends - starts, offsets)
    seen = (weights > NEGLIGIBLE_WEIGHT).nonzero()[:, 0]
    rgb = density.new_zeros(len(density), 3)
    rays = kernels.ray_indices(offsets)[seen]
    rgb[seen] = model.field.radiance_of_encoded(encoded[seen], directions, rays)[1]
    colour, transmittance, _ = kernels.composite(
        density, rgb, ends - starts, offsets=offsets, background=background.expand(len(origins), 3)
    )
    if depth is None:
        return colour, 1.0 - transmittance, torch.full_like(transmittance, torch.nan)
    distance = _distance(depth, model, density=density, starts=starts, ends=ends, offsets=offsets)
    return colour, 1.0 - transmittance, distance


def _distance(
    request: DepthRequest, model: Model, *, density: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor
) -> Tensor:
    """The requested depth along each ray, in the training frame."""
    if request.convention == "median":
        return depth_of_rays.median(density, starts, ends, offsets=offsets)
    weights, transmittance = kernels.interval_weights(density, ends - starts, offsets)
    means = depth_of_rays.interval_means(density, starts, ends)
    floor = request.opacity_floor
    match request.convention:
        case "moment":
            return depth_of_rays.moment(weights, means, offsets)
        case "conditional":
            return depth_of_rays.conditional(weights, means, offsets=offsets, opacity_floor=floor)
        case "max-weight":
            return depth_of_rays.max_weight(weights, means, offsets=offsets, opacity_floor=floor)
        case "background":
            if request.background_distance is None:
                raise ValueError("the background convention needs a background distance")
            return depth_of_rays.background_filled(
                weights,
                means,
                offsets=offsets,
                transmittance=transmittance,
                background_distance=request.background_distance * model.training_from_scene.scale,
            )
    raise ValueError(f"unknown depth convention {request.convention!r}")
