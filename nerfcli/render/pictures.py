"""Whole pictures of a trained model, tile by tile: colour, opacity, depth and their uncertainty."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.frame import Frame
from nerfcli.errors import NON_FINITE, UserError, several
from nerfcli.field.background import Background, colours_behind
from nerfcli.kernels import RayTermination
from nerfcli.render.depth import DepthRequest, disagreement, fractions, median, requested, spread
from nerfcli.render.tracing import TOLERANCE, PictureRays, render_rays, successive_rays
from nerfcli.render.trained_field import TrainedField

RAYS_PER_TILE = 2**14
# Rays and their background are computed in blocks of this many, so that their last bits do not depend on the tile.
RAYS_PER_BLOCK = 2**18


@dataclass(frozen=True)
class RenderedPicture:
    """Rendering of one frame: NumPy float32, lengths in the scene's unit, NaN where undefined.

    Args:
        rgb: (H, W, 3) sRGB in [0, 1], composited on the background; on black, it is premultiplied by the opacity.
        opacity: (H, W) in [0, 1].
        truncation_error: (H, W) bound on the truncation error of each channel of rgb; the tolerance at most.
        valid: (H, W) bool; False where the lens has no ray (rgb is then the background, opacity 0).
        depth: (H, W) as requested; None when not requested.
        spread: (H, W) standard deviation of where light ends, along the axis of depth; None without depth.
        disagreement: (H, W) |median - conditional| along that axis; None without depth.
        median: (H, W) distance along that axis at which half of all light is absorbed; None without depth.
        coverage, parallax: (H, W) for the points at `median`, see `render.coverage`; None unless an export adds them.
        lower, upper: (H, W) bounds of an interval of depth, see `depth_errors`; None unless an export adds them.
        confidence: (H, W) fraction of depths within a tolerance, see `depth_errors`; None unless an export adds it.
    """

    rgb: np.ndarray
    opacity: np.ndarray
    truncation_error: np.ndarray
    valid: np.ndarray
    depth: np.ndarray | None = None
    spread: np.ndarray | None = None
    disagreement: np.ndarray | None = None
    median: np.ndarray | None = None
    coverage: np.ndarray | None = None
    parallax: np.ndarray | None = None
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None
    confidence: np.ndarray | None = None


@torch.no_grad()
def render_picture(
    model: TrainedField,
    frame: Frame,
    *,
    background: Background,
    depth: DepthRequest | None = None,
    tolerance: float = TOLERANCE,
    on_tile: Callable[[int], None] = lambda rays: None,
) -> RenderedPicture:
    """Render one frame; the result is bit-identical for any tile size and number of threads.

    Args:
        tolerance: largest truncation error of a colour channel, in (0, 1]; see `tracing`.

    Raises:
        UserError: the rendering has numbers that are not finite.
    """
    if not 0.0 < tolerance <= 1.0:
        raise ValueError(f"need 0 < tolerance <= 1, got {tolerance}")
    width, height = frame.camera.width, frame.camera.height
    columns: list[tuple[Tensor, ...]] = []
    tile = rays_per_tile(model)
    for first in range(0, width * height, RAYS_PER_BLOCK):
        chosen = range(first, min(first + RAYS_PER_BLOCK, width * height))
        rays = successive_rays(frame, model.training_from_scene, pixels=chosen, device=model.device)
        behind = colours_behind(background, rays.directions)
        for begin in range(0, len(chosen), tile):
            part = slice(begin, min(begin + tile, len(chosen)))
            columns.append(_render_tile(model, rays, part, background=behind, depth=depth, tolerance=tolerance))
            on_tile(part.stop - part.start)
    rgb, opacity, error, valid, *distances = (
        torch.cat(column).reshape(height, width, *column[0].shape[1:]).cpu().numpy()
        for column in zip(*columns, strict=True)
    )
    _refuse_non_finite(frame, {"rgb": rgb, "opacity": opacity, "truncation error": error})
    return RenderedPicture(rgb, opacity, error, valid, *distances)


def rays_per_tile(model: TrainedField) -> int:
    """Return the number of rays rendered at a time on the device of a model."""
    if model.device.type != "cuda":
        return RAYS_PER_TILE
    total = torch.cuda.get_device_properties(model.device).total_memory
    # An eighth of the memory is enough even if every step of the rays, of 110 bytes, is in an occupied cell.
    fitting = int(total / 8 / (110 * len(model.marching.edges())))
    return min(2**16, max(RAYS_PER_TILE, fitting))


def _refuse_non_finite(frame: Frame, maps: dict[str, np.ndarray]) -> None:
    for name, values in maps.items():
        if not np.isfinite(values).all():
            bad = ~np.isfinite(values.reshape(*values.shape[:2], -1)).all(-1)
            y, x = np.argwhere(bad)[0]
            raise UserError(
                f"{name} of {frame.name} is not finite at {several(int(bad.sum()), 'pixel')}, such as ({x}, {y})",
                "the field overflows there: train again with --overwrite and another --seed, and please report this",
                NON_FINITE,
            )


def straight_rgba(picture: RenderedPicture) -> np.ndarray:
    """Return sRGB with straight alpha (H, W, 4) float32 of a picture rendered on black; 0 where opacity is 0."""
    alpha = picture.opacity[..., None]
    colour = np.divide(picture.rgb, alpha, out=np.zeros_like(picture.rgb), where=alpha > 0)
    return np.concatenate([np.minimum(colour, 1.0), alpha], axis=-1)


def _render_tile(
    model: TrainedField,
    rays: PictureRays,
    part: slice,
    *,
    background: Tensor,
    depth: DepthRequest | None,
    tolerance: float,
) -> tuple[Tensor, ...]:
    """Render the pixels of some rays: colour, opacity, truncation error, validity; if requested, depth, spread,
    disagreement and median.
    """
    directions, valid, behind = rays.directions[part], rays.valid[part], background[part]
    seen = render_rays(
        model,
        rays.origin.expand_as(directions),
        directions,
        background=behind,
        fractions=fractions(depth) if depth is not None else (),
        tolerance=tolerance,
        cones=rays.cones[part],
        keep_intervals=False,
    )
    opacity = torch.where(valid, seen.ends.opacity, 0.0)
    colours = (
        torch.where(valid[:, None], seen.rgb, behind).clamp(0.0, 1.0),
        opacity,
        torch.where(valid, seen.truncation_error, 0.0),
        valid,
    )
    if depth is None:
        return colours
    ends, scale = seen.ends._replace(opacity=opacity), model.training_from_scene.scale
    return *colours, *depth_maps_of(depth, ends, cosines=rays.cosines[part], unit=scale, valid=valid)


def depth_maps_of(
    depth: DepthRequest, ends: RayTermination, *, cosines: Tensor, unit: float, valid: Tensor
) -> tuple[Tensor, ...]:
    """Return the requested depth, spread, disagreement and median (R,), NaN where undefined.

    Args:
        ends: where the light of the rays ends, as distances along them.
        unit: length of a unit of the maps, in that of the distances.
    """
    if depth.convention == "background" and depth.background_distance is None:
        raise ValueError("the background convention needs a background distance")
    # There is no z behind the camera.
    factor, ahead = torch.full_like(cosines, 1.0 / unit), torch.ones_like(valid)
    if depth.axis == "z":
        ahead = cosines > 0
        factor = torch.where(ahead, cosines, 1.0) / unit
    ends = ends._replace(
        mean=ends.mean * factor,
        spread=ends.spread * factor,
        peak=ends.peak * factor,
        quantiles=ends.quantiles * factor[:, None],
    )
    distances = requested(depth, ends, background_distance=(depth.background_distance or 0.0) * unit * factor)
    maps = (distances, spread(depth, ends), disagreement(depth, ends), median(depth, ends))
    return tuple(torch.where(valid & ahead, values, torch.nan) for values in maps)


class Renderable(Protocol):
    """A model of a scene, in the scene's frame; `Model` and `splats.render.SplatScene` are such."""

    @property
    def background(self) -> Background:
        """SRGB behind everything, for pictures without alpha."""

    @property
    def unit(self) -> str:
        """Unit of length, "arbitrary" or "metre"."""

    @property
    def unit_source(self) -> str | None:
        """How the metre is known; None where unknown."""

    @property
    def thread_safe(self) -> bool:
        """Whether several threads may render it at the same time."""

    def render(
        self,
        frame: Frame,
        *,
        background: Background,
        depth: DepthRequest | None = None,
        on_tile: Callable[[int], None] = lambda rays: None,
    ) -> RenderedPicture:
        """Render a frame; see `render_picture`."""

    def measured_error(self, frame: Frame, *, depth: DepthRequest | None) -> dict[str, float]:
        """Return numbers on the accuracy of the rendering; see `accuracy`."""
