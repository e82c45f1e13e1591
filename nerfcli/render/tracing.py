"""Rays of a camera through the centres of its pixels, and tracing them: colour, distribution of depth, error.

Ray of pixel p:  origin = s R c + t,  direction = R R_cam bearing(p), with the camera's centre c and the similarity
(s, R, t) from the scene to the training frame. Directions have unit norm, so that distances along rays are lengths and
density times length is an optical depth.

Two approximations save time. A ray ends where little light is left (the early stop), and the colours of samples with
negligible weights are taken as grey instead of evaluated. Together they change a colour by at most the tolerance;
`RaysSeen.truncation_error` bounds the change of each colour. The bound concerns the rendering of the field with its
steps, not the field.
"""

import functools
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.kernels import March, Rays, RaysSeen, TraceOptions
from nerfcli.kernels.interface import UNSEEN
from nerfcli.render.trained_field import Marching, TrainedField


@dataclass(frozen=True)
class PictureRays:
    """Rays of pixels of one picture, row by row.

    Args:
        origin: (3,) the camera's centre, training frame.
        directions: (N, 3) unit.
        valid: (N,) bool; False where the lens model cannot be inverted.
        cosines: (N,) of the angle between each ray and the optical axis: z = distance * cosine.
        cones: (N,) footprint of each ray per distance: the width of a pixel.
    """

    origin: Tensor
    directions: Tensor
    valid: Tensor
    cosines: Tensor
    cones: Tensor


def pixel_rays(
    frame: Frame, training_from_scene: Similarity, *, pixels: np.ndarray, device: torch.device
) -> PictureRays:
    """Return the rays of pixels (N,), numbered row by row; computed in float64, the result is in float32."""
    return _turned(frame, training_from_scene, *_bearings(frame.camera, pixels, device))


def successive_rays(
    frame: Frame, training_from_scene: Similarity, *, pixels: range, device: torch.device
) -> PictureRays:
    """Return `pixel_rays`; bearings are cached for further pictures of the same camera."""
    return _turned(frame, training_from_scene, *_bearings_of_range(frame.camera, pixels, device))


def _turned(frame: Frame, training_from_scene: Similarity, bearings: Tensor, valid: Tensor) -> PictureRays:
    """Return the rays of bearings (N, 3), float64, in the axes of the camera."""
    world_from_cam = torch.from_numpy(training_from_scene.apply_pose(frame.world_from_cam)).to(bearings.device)
    # Not a matrix product, whose rounding depends on the number of rows.
    columns = world_from_cam[:3, :3].T
    directions = bearings[:, :1] * columns[0] + bearings[:, 1:2] * columns[1] + bearings[:, 2:] * columns[2]
    return PictureRays(
        origin=world_from_cam[:3, 3].float(),
        directions=directions.float(),
        valid=valid,
        cosines=bearings[:, 2].float(),
        cones=torch.full((len(bearings),), 1.0 / frame.camera.focal_px, device=bearings.device),
    )


def _bearings(camera: Camera, pixels: np.ndarray, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the bearings (N, 3) float64 and whether each exists, (N,) bool."""
    corners = np.stack([pixels % camera.width, pixels // camera.width], axis=-1)
    bearings, valid = camera.bearings(corners + 0.5)
    return torch.from_numpy(bearings).to(device), torch.from_numpy(valid).to(device)


@functools.lru_cache(maxsize=8)  # 2 million rays, 25 bytes each
def _bearings_of_range(camera: Camera, pixels: range, device: torch.device) -> tuple[Tensor, Tensor]:
    return _bearings(camera, np.arange(pixels.start, pixels.stop), device)


# The default: a quarter of a grey level.
TOLERANCE = 1 / 1020
# Fraction of the tolerance for the early stop. Surfaces end rays at once, so a deep stop costs little.
STOP_FRACTION = 0.1


def deepest(tolerance: float) -> float:
    """Return the optical depth at which rays stop."""
    return -math.log(STOP_FRACTION * tolerance)


def render_rays(
    model: TrainedField,
    origins: Tensor,
    directions: Tensor,
    *,
    background: Tensor,
    cuts: Tensor | None = None,
    fractions: tuple[float, ...] = (),
    tolerance: float = TOLERANCE,
    cones: Tensor | None = None,
    keep_intervals: bool = True,
) -> RaysSeen:
    """March rays through the model. The result of a ray does not depend on the other rays.

    Args:
        origins, directions: (R, 3) in the training frame, unit directions.
        cuts: (S + 1,) distances at which all rays are cut; by default those of pictures, see `uniform_cuts`.
        tolerance: bound on the truncation error of a colour, > 0.
        cones: (R,) footprint of each ray per distance, see `kernels.Rays`; None for lines.
    """
    field, cuts = model.field, uniform_cuts(model.marching).to(directions) if cuts is None else cuts
    edges = torch.cat([cuts, cuts[-1:]])  # the last edge is not used, because there is no jitter
    rays = Rays(origins, directions, torch.zeros_like(directions[:, 0]), cones)
    march = March(edges, model.open_cells, model.contraction, deepest(tolerance), distances=model.distances)
    # All negligible samples of a ray together use at most the rest of the tolerance.
    negligible = (1.0 - STOP_FRACTION) * tolerance / UNSEEN
    options = TraceOptions(fractions, negligible, keep_intervals)
    return field.backend.trace_rays(rays, march, field.medium(), options, background=background)


@lru_cache(maxsize=4)
def uniform_cuts(marching: Marching) -> Tensor:
    """Return the distances (S + 1,) float64 at which pictures cut all rays: the midpoints of the training's steps."""
    edges = marching.edges()
    return edges[:-1] + 0.5 * edges.diff()
